"""What follows the force in the residuals of a fit and no rigid device explains: lags and resonances.

A pole that the model lacks leaves in the positions the force, filtered by it. So the residuals are compared with the
forces filtered by a bank of poles, each cleared of what the numbers of the model explain as well (a score test). That
sees far less than the spread of the residuals shows, below the step of the encoder too.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import circle
from zwidth.fitting.output_error import FittedModel
from zwidth.loops.linear.margins import open_loop_response
from zwidth.scenes.scene import Scene

# Frequencies of the bank over the sampling rate, how far apart, and the damping ratios; the last one is a real pole.
_LOWEST, _HIGHEST, _APART, _RATIOS = 0.005, 0.48, 1.06, (0.03, 0.2, 1.0)
# What the model explains of a filtered force but for this share is its own.
_OWN = 1e-6
# So many poles are tried, the likeliest first: an encoder errs alike in neighboring samples, which may look like one.
_TRIED = 3
# So many of the first samples of each log are looked at.
_LOOKED = 20_000
# A resonance shows surely whose size is so many standard errors beyond what chance explains; the one that is asked for.
_SURELY, _RINGING = 2.0, _RATIOS[0]


class HiddenPole(NamedTuple):
    """The pole that the residuals show: its frequency in turns a period, NaN where chance explains as much.

    ``rings`` tells a resonance from a lag. Up to the frequency ``seen_to`` resonances would show that are large enough
    to make a wall unstable; 0 where none would.
    """

    frequency: float
    rings: bool
    seen_to: float


def find_hidden(best: FittedModel, scene: Scene, stiffness: float, virtual_damping: float) -> HiddenPole:
    """Look for the pole whose filtered force explains most of the residuals; ``seen_to`` is for the given wall.

    Schwarz's criterion with the numbers that the pole adds, two rates and two sizes; one of each of a real pole.
    """
    best = _glimpse(best)
    basis, _ = np.linalg.qr(best.columns[0][:, best.columns[0].any(0)])
    rest = best.model.weigh(best.residuals)
    rest = rest - basis @ (basis.T @ rest)
    total, chance, found, shown = float(rest @ rest), 2.0 * np.log(best.count), [], []
    turns = np.geomspace(_LOWEST, _HIGHEST, 1 + round(np.log(_HIGHEST / _LOWEST) / np.log(_APART)))
    alpha, beta = scene.normalize_walls(stiffness, virtual_damping)
    loop = open_loop_response(scene.loop.roots, alpha, beta, circle(2.0 * np.pi * turns)).value
    # A mode that moves as the whole mass does changes the loop at its resonance by the loop over twice its damping.
    harmful = 2.0 * _RINGING * np.abs(1.0 + 1.0 / loop)
    for frequency, size in zip(turns.tolist(), harmful.tolist(), strict=True):
        for ratio in _RATIOS:
            columns, mode = _filter_forces(best, frequency, ratio)
            cleared = best.model.weigh(columns)
            cleared = cleared - basis @ (basis.T @ cleared)
            if ratio == _RINGING:
                clear = size * float(np.linalg.norm(cleared @ mode)) / np.sqrt(best.variance * best.excess)
                shown.append(clear > np.sqrt(2.0 * chance) + _SURELY)
            if np.linalg.norm(cleared, axis=0).min() <= _OWN * np.linalg.norm(columns, axis=0).max():
                continue
            cleared, _ = np.linalg.qr(cleared)
            along = cleared.T @ rest
            found.append((float(along @ along), frequency, ratio, cleared, along))
    first = shown.index(True) if any(shown) else len(shown)
    seen = np.logical_and.accumulate(shown[first:])
    seen_to = float(turns[first:][seen].max(initial=0.0))
    for explained, frequency, ratio, cleared, along in sorted(found, key=lambda one: -one[0])[:_TRIED]:
        # In squares of standard errors, of errors as kindred as the encoder's and as the sums of neighbors are.
        errors = best.noise.spread(best.model.weigh(cleared))
        known = float(along @ np.linalg.solve(errors, along))
        white = best.count * np.log(total / (total - explained)) if explained < total else np.inf
        if min(known, white) > along.size * chance:
            return HiddenPole(frequency, ratio < 1.0, seen_to)
    return HiddenPole(np.nan, False, seen_to)


def _glimpse(best: FittedModel) -> FittedModel:
    """The same device on the beginnings of its logs, where these are long."""
    if max(log.position.size for log in best.model.logs) <= _LOOKED:
        return best
    part = replace(best, model=best.model.begin(_LOOKED), rivals=())
    part = replace(part, squares=float(part.residuals @ part.residuals))
    return replace(part, model=replace(part.model, noise=part.noise)) if best.model.noise is not None else part


def _filter_forces(best: FittedModel, frequency: float, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """What a pole makes of all forces, at the positions: real and imaginary part where it rings, else one column.

    And how much of each a mode of that pole adds to the positions that moves as the whole mass does.
    """
    from scipy.signal import lfilter

    w = 2.0 * np.pi * frequency
    rate = w * (-ratio + 1j * np.sqrt(1.0 - ratio**2)) if ratio < 1.0 else -w
    whole, parts = int(best.theta[2]), []
    for log in best.model.logs:
        late = lfilter([0.0, 1.0], [1.0, -np.exp(rate)], log.force)[log.skip - whole :]
        late = late[: log.position.size]
        parts.append(np.stack([np.real(late), np.imag(late)] if ratio < 1.0 else [late], -1))
    # The force is held for a period.
    size = complex(best.theta[0] / w * (np.exp(rate) - 1.0) / rate)
    return np.concatenate(parts), np.array([size.imag, size.real])
