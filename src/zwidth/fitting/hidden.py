"""What follows the force in the residuals of a fit and no rigid device explains: lags and resonances.

A pole that the model lacks leaves in the positions the force, filtered by it. So the residuals are compared with the
forces filtered by a bank of poles, each cleared of what the numbers of the model explain as well (a score test). That
sees far less than the spread of the residuals shows, below the step of the encoder too. What it would not see may be
in the device nevertheless: how large, at most, is the radius in which the true response lies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from zwidth.fitting.output_error import FittedModel
from zwidth.loops.measured.curve import LEAST_DAMPING_RATIO
from zwidth.parts.measured import MeasuredDevice
from zwidth.scenes.scene import Scene

# Frequencies of the bank over the sampling rate; damping ratios with the steps of their frequencies, the last one that
# of a real pole. Resonances of the first two and all between are those that may hide.
_LOWEST, _HIGHEST, _APART = 0.005, 0.49, {LEAST_DAMPING_RATIO: 1.01, 0.03: 1.06, 0.2: 1.06, 1.0: 1.06}
_RINGING = 2
# What the model explains of a filtered force but for this share is its own.
_OWN = 1e-6
# So many poles are tried, the likeliest first and so far apart: an encoder errs alike in neighboring samples, which may
# look like one.
_TRIED, _ELSEWHERE = 3, 1.1
# So many of the first samples of each log are looked at, and so many numbers at once.
_LOOKED, _AT_ONCE = 20_000, 4_000_000
# A resonance may be larger than the residuals say by so many standard errors; these are those of frequencies so near.
_SURELY, _NEAR = 4.0, 15
# Of the response: its lowest line, how many there are below the bank, and by what its delay turns it between two lines.
_FIRST, _BELOW, _TURN = 2e-4, 40, 0.3


class HiddenPole(NamedTuple):
    """The pole that the residuals show: its frequency in turns a period, and whether it rings, as no lag does."""

    frequency: float
    rings: bool


@dataclass(frozen=True)
class PoleBank:
    """Poles of one damping ratio and what the residuals say of them, in standard errors of white noise."""

    ratio: float
    frequency: np.ndarray
    explained: np.ndarray  # squares of the residuals that each pole explains
    whole: np.ndarray  # what a mode of each would leave that moves as the whole mass does

    @property
    def rates(self) -> npt.NDArray[np.complex128]:
        """Poles of the continuous device, in periods."""
        w, ratio = 2.0 * np.pi * self.frequency, self.ratio
        return np.asarray(w * complex(-ratio, np.sqrt(1.0 - ratio**2)), np.complex128)

    def bound_modes(self) -> np.ndarray:
        """How much more than the whole mass a mode of each pole may move, at most."""
        near = np.convolve(
            np.pad(self.explained, _NEAR, "edge"), np.full(2 * _NEAR + 1, 1.0 / (2 * _NEAR + 1)), "valid"
        )
        with np.errstate(divide="ignore"):
            return (np.sqrt(self.explained) + _SURELY * np.sqrt(np.maximum(0.5 * near, 1.0))) / self.whole


def find_hidden(best: FittedModel) -> tuple[HiddenPole | None, list[PoleBank]]:
    """Look for the pole whose filtered force explains most of the residuals; None where chance explains as much.

    Schwarz's criterion with the numbers that the pole adds, two rates and two sizes; one of each of a real pole.
    """
    best = _glimpse(best)
    basis, _ = np.linalg.qr(best.columns[0][:, best.columns[0].any(0)])
    rest = best.model.weigh(best.residuals)
    rest = rest - basis @ (basis.T @ rest)
    noise = best.variance * best.excess
    banks = [_test(best, basis, rest, ratio, noise) for ratio in _APART]
    tried: list[float] = []
    total, chance = float(rest @ rest), 2.0 * np.log(best.count)
    found = [(e, f, bank.ratio) for bank in banks for e, f in zip(bank.explained * noise, bank.frequency, strict=True)]
    for explained, frequency, ratio in sorted(found, reverse=True):
        if any(max(frequency / other, other / frequency) < _ELSEWHERE for other in tried):
            continue
        tried.append(frequency)
        cleared = _filter_forces(best, np.array([frequency]), ratio)
        cleared, _ = np.linalg.qr(cleared - basis @ (basis.T @ cleared))
        along = cleared.T @ rest
        # In squares of standard errors, of errors as kindred as the encoder's and as the sums of neighbors are.
        errors = best.noise.spread(best.model.weigh(cleared))
        known = float(along @ np.linalg.solve(errors, along))
        white = best.count * np.log(total / (total - explained)) if explained < total else np.inf
        if min(known, white) > along.size * chance:
            return HiddenPole(float(frequency), ratio < 1.0), banks
        if len(tried) == _TRIED:
            break
    return None, banks


def respond_as_fitted(best: FittedModel, scene: Scene, banks: list[PoleBank]) -> MeasuredDevice:
    """The response of a fitted device, with the radius by which a resonance may move it that the log does not show."""
    period = scene.timing.period
    even = np.arange(1.0, 2.0 * np.pi * _HIGHEST * (1.0 + scene.d) / _TURN) * _TURN / (2.0 * np.pi * (1.0 + scene.d))
    below = np.geomspace(_FIRST, _LOWEST, _BELOW)[:-1]
    lines = np.unique(np.concatenate([below, even[even > _LOWEST], banks[0].frequency]))
    response = scene.frequency_response(1.0, 0.0, lines / period)
    radius, z = np.zeros(lines.size), np.exp(2j * np.pi * lines)[:, None]
    for bank in banks[:_RINGING]:
        poles, size = np.exp(bank.rates), _size_modes(best, bank)
        moved = size / (z - poles) - size.conj() / (z - poles.conj())
        radius = np.maximum(radius, np.max(0.5 * np.abs(moved) * bank.bound_modes(), axis=1))
    return MeasuredDevice(lines / period, response, radius)


def _glimpse(best: FittedModel) -> FittedModel:
    """The same device on the beginnings of its logs, where these are long."""
    if max(log.position.size for log in best.model.logs) <= _LOOKED:
        return best
    part = replace(best, model=best.model.begin(_LOOKED), rivals=())
    part = replace(part, squares=float(part.residuals @ part.residuals))
    return replace(part, model=replace(part.model, noise=part.noise)) if best.model.noise is not None else part


def _test(best: FittedModel, basis: np.ndarray, rest: np.ndarray, ratio: float, noise: float) -> PoleBank:
    """Compare the residuals with the forces filtered by poles of one damping ratio."""
    frequency = np.geomspace(_LOWEST, _HIGHEST, 1 + round(np.log(_HIGHEST / _LOWEST) / np.log(_APART[ratio])))
    bank = PoleBank(ratio, frequency, np.zeros(frequency.size), np.zeros(frequency.size))
    sizes, count = _size_modes(best, bank), max(1, _AT_ONCE // (2 * rest.size))
    for first in range(0, frequency.size, count):
        part = slice(first, first + count)
        columns = _filter_forces(best, frequency[part], ratio)
        raw = np.linalg.norm(columns, axis=0)
        cleared = columns - basis @ (basis.T @ columns)
        each = (-1, 1 if ratio == 1.0 else 2)
        cleared = cleared.reshape(rest.size, *each)
        own = np.linalg.norm(cleared, axis=0).min(-1) <= _OWN * raw.reshape(each).max(-1)
        square, along = np.einsum("nki,nkj->kij", cleared, cleared), np.einsum("nki,n->ki", cleared, rest)
        by = np.linalg.pinv(square, rcond=_OWN**2, hermitian=True)
        bank.explained[part] = np.where(own, 0.0, np.einsum("ki,kij,kj->k", along, by, along)) / noise
        mode = np.stack([sizes.imag, sizes.real], -1)[part, : each[1]]
        bank.whole[part] = np.sqrt(np.einsum("ki,kij,kj->k", mode, square, mode) / noise)
    return bank


def _filter_forces(best: FittedModel, frequency: np.ndarray, ratio: float) -> np.ndarray:
    """What poles make of all forces, at the positions: real and imaginary part side by side, or one of a real pole."""
    from scipy.signal import lfilter

    bank, ends = PoleBank(ratio, frequency, frequency, frequency), [0]
    for log in best.model.logs:
        ends.append(ends[-1] + log.position.size)
    parts = 1 if ratio == 1.0 else 2
    columns, whole = np.empty((ends[-1], frequency.size * parts)), int(best.theta[2])
    for k, pole in enumerate(np.exp(bank.rates)):
        for log, start, end in zip(best.model.logs, ends, ends[1:], strict=False):
            late = np.asarray(lfilter([0.0, 1.0], [1.0, -pole], log.force), np.complex128)[log.skip - whole :][
                : end - start
            ]
            columns[start:end, k * parts] = late.real
            if parts == 2:
                columns[start:end, 2 * k + 1] = late.imag
    return best.model.weigh(columns)


def _size_modes(best: FittedModel, bank: PoleBank) -> npt.NDArray[np.complex128]:
    """Of a mode of each pole that moves as the whole mass does, under a force that is held for a period."""
    return best.theta[0] / (2.0 * np.pi * bank.frequency) * (np.exp(bank.rates) - 1.0) / bank.rates
