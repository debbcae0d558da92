"""What follows the force in the residuals of a fit and no rigid device explains: lags and resonances.

A pole that the model lacks leaves in the positions the force, filtered by it. So the residuals are compared with the
forces filtered by a bank of poles, each cleared of what the numbers of the model explain as well (a score test). That
sees far less than the spread of the residuals shows, below the step of the encoder too. What it would not see may be
in the device nevertheless: how large, at most, is the radius in which the true response lies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from zwidth.fitting.moving import recur
from zwidth.fitting.output_error import FittedModel
from zwidth.fitting.required_wall import DeviceRows, RequiredWall
from zwidth.fitting.structure import Recordings
from zwidth.parts.actuator import Actuator
from zwidth.parts.circle import circle
from zwidth.parts.measured import MeasuredDevice
from zwidth.scenes.measured_curve import LEAST_DAMPING_RATIO
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
_LOOKED, _AT_ONCE = 20_000, 400_000
# A resonance may be larger than the residuals say by so many standard errors; these are those of frequencies so near.
_SURELY, _NEAR = 4.0, 15
# Of the response: its lowest line, how many there are below the bank, and by what its delay turns it between two lines,
# of a band and where lines are drawn between them.
_FIRST, _BELOW, _TURN, _LITTLE = 2e-4, 40, 0.3, 0.06
# Resonances that a device is as likely to have as not: frequencies over the sampling rate; what they move beside the
# whole mass, those beyond nodes less often; and how many of them are drawn.
_MODES, _SHARES, _BEYOND_NODES, _DRAWN = (0.03, 0.4), np.geomspace(1.0 / 30.0, 1.0, 9), 0.3, 200
# Lags that are looked for, in periods, as long as the delay and this at least.
_SHORTEST, _LONGEST, _LONGEST_LAG, _LAGS = 0.03, 0.05, 3.0, 40
# Beside a resonance, in half-widths; steps of theta's differences.
_BESIDE, _STEP = np.sinh(np.linspace(-4.0, 4.0, 61)), 1e-6


class HiddenLag(NamedTuple):
    """The longest lag of an amplifier that a log does not tell from a delay, both in s, and K_max with it in N/m."""

    time_constant: float
    delay: float
    stiffness_max: float


class HiddenResonances(NamedTuple):
    """How likely one resonance more is against none, and K_max with it over that without, for equally likely ones."""

    odds: float
    stiffness_max: np.ndarray


class HiddenPole(NamedTuple):
    """The pole that the residuals show: its frequency in turns a period, and whether it rings, as no lag does.

    Or one that explains as well as the lag ``instead`` of which it may be there.
    """

    frequency: float
    rings: bool
    instead: bool = False


@dataclass(frozen=True)
class PoleBank:
    """Poles of one damping ratio and what the residuals say of them, in standard errors of white noise."""

    ratio: float
    frequency: np.ndarray
    explained: np.ndarray  # squares of the residuals that each pole explains
    whole: np.ndarray  # what a mode of each would leave that moves as the whole mass does
    toward: np.ndarray  # how much of the residuals is such as that mode would leave
    kindred: np.ndarray  # how many times as large its errors are, as kindred as the encoder's
    absorbed: np.ndarray  # by how much it would move each number of theta

    def bound_modes(self) -> np.ndarray:
        """How much more than the whole mass a mode of each pole may move, at most."""
        near = np.convolve(
            np.pad(self.explained, _NEAR, "edge"), np.full(2 * _NEAR + 1, 1.0 / (2 * _NEAR + 1)), "valid"
        )
        with np.errstate(divide="ignore"):
            return (np.sqrt(self.explained) + _SURELY * np.sqrt(np.maximum(0.5 * near, 1.0))) / self.whole


def find_hidden(best: FittedModel) -> tuple[HiddenPole | None, list[PoleBank]]:
    """Look for the pole whose filtered force explains most of the residuals; None where chance explains as much."""
    # Schwarz's criterion with the numbers that the pole adds, two rates and two sizes; one of each of a real pole.
    best = _glimpse(best)
    basis, rest = best.inverse.basis, best.model.weigh(best.residuals)
    rest = rest - basis @ (basis.T @ rest)
    noise = best.variance * best.excess
    banks = [_test(best, basis, rest, ratio, noise) for ratio in _APART]
    total, chance = float(rest @ rest), 2.0 * np.log(best.count)
    for share, frequency, ratio in islice(list_likeliest(banks, _ELSEWHERE), _TRIED):
        explained = share * noise
        cleared = _filter_forces(best, _lay_poles(ratio, np.array([frequency])))[..., 0].T
        cleared, _ = np.linalg.qr(cleared - basis @ (basis.T @ cleared))
        along = cleared.T @ rest
        # In squares of standard errors, of errors as kindred as the encoder's and as the sums of neighbors are.
        errors = best.noise.spread(best.model.weigh(cleared))
        known = float(along @ np.linalg.solve(errors, along))
        white = best.count * np.log(total / (total - explained)) if explained < total else np.inf
        if min(known, white) > along.size * chance:
            return HiddenPole(float(frequency), ratio < 1.0), banks
    return None, banks


def list_likeliest(banks: list[PoleBank], apart: float) -> Iterator[tuple[float, float, float]]:
    """What each pole explains, its frequency and damping ratio, the likeliest first, frequencies so far apart."""
    found = [(e, f, bank.ratio) for bank in banks for e, f in zip(bank.explained, bank.frequency, strict=True)]
    told: list[float] = []
    for explained, frequency, ratio in sorted(found, reverse=True):
        if all(max(frequency / other, other / frequency) >= apart for other in told):
            told.append(frequency)
            yield explained, frequency, ratio


@dataclass(frozen=True)
class LagTest:
    """Lags of an amplifier in periods, in place of as much delay, and what the residuals say of them."""

    lag: np.ndarray
    whole: np.ndarray  # what each would leave, in standard errors
    toward: np.ndarray  # what of that is left
    theta: np.ndarray  # the device's numbers with it, a column each


def look_for_lags(best: FittedModel) -> LagTest:
    """Compare the residuals with what lags of first order would leave that were taken for a delay."""
    best = _glimpse(best)
    lags = np.geomspace(_SHORTEST, max(_LONGEST, min(_LONGEST_LAG, best.theta[2])), _LAGS)
    # Of the mass alone: what resonances add turns hardly.
    (g, delta, d), model = best.theta[:3], Recordings(best.model.logs, lag=1)
    thetas = [np.pad([g, delta, d - lag, lag], (0, model.size - 4)) for lag in lags]
    columns = [[model.add_parts(theta, k).position for k in range(len(model.logs))] for theta in thetas]
    columns = best.model.weigh(np.stack([np.concatenate(column) for column in columns], -1))
    absorbed = best.inverse.matrix @ columns
    left, rest = columns - best.columns[0] @ absorbed, best.model.weigh(best.residuals)
    whole = np.linalg.norm(left, axis=0)
    # Of errors as kindred as the encoder's, where these are larger.
    kindred = best.noise.spread_each(best.model.weigh(left)) / whole**2
    error = np.sqrt(np.maximum(kindred, best.variance) * best.excess)
    moved = best.theta[:, None] - absorbed / best.columns[1][:, None]
    moved[2] -= lags
    return LagTest(lags, whole / error, left.T @ rest / whole / error, moved)


def bound_lag(best: FittedModel, test: LagTest | None, scene: Scene, reach: float) -> HiddenLag | None:
    """The longest lag, a first-order one of the amplifier, with which the log goes as well; None where it shows all."""
    # The delay is less by the lag and has to remain.
    if test is None:
        return None
    period = scene.timing.period
    may = (test.whole - test.toward <= reach) & (test.theta[1] >= 0) & (test.theta[2] >= 0)
    count = int(np.argmin(np.append(may, False)))
    if not count:
        return None
    lag = float(test.lag[count - 1] * period)
    # What a lag moves of resonances is small, and may be more than there is.
    theta = np.clip(test.theta[:, count - 1], *best.model.bounds())
    there = best.model.normalize(theta, period).to_scene(period, scene.velocity, scene.unit_system)
    there = replace(there, device=replace(there.device, actuator=Actuator(time_constant=lag)))
    return HiddenLag(lag, float(there.timing.delay), float(there.max_stiffness().stiffness))


def respond_as_fitted(best: FittedModel, scene: Scene, banks: list[PoleBank]) -> MeasuredDevice:
    """The response of a fitted device, with the radius by which a resonance may move it that the log does not show."""
    # What such a resonance moves the other numbers by, they have been found with.
    lines = np.unique(np.concatenate([_lay_lines(scene, _TURN), banks[0].frequency]))
    response, slopes = _respond(best, scene.timing.period, lines)
    radius = np.zeros(lines.size)
    for bank in banks[:_RINGING]:
        moved = (
            _add_modes(best, lines, bank.frequency[:, None], bank.ratio)
            - bank.absorbed[: best.model.parts.stop].T @ slopes.T
        )
        radius = np.maximum(radius, np.max(np.abs(moved) * bank.bound_modes()[:, None], 0))
    return MeasuredDevice(lines / scene.timing.period, response, radius, scene.unit_system.rotary)


def weigh_resonances(best: FittedModel, scene: Scene, banks: list[PoleBank]) -> HiddenResonances | None:
    """What one resonance more may make of K_max, as likely as none before the log; None where no damper helps."""
    banks, period = banks[:-1], scene.timing.period
    odds, drawn, share = _draw_modes(banks)
    # The first one is none, to compare with.
    which, share = np.append(drawn[0], drawn), np.append(0.0, share)[:, None]
    poles = [[bank.frequency, np.full_like(bank.frequency, bank.ratio)] for bank in banks]
    frequency, ratio = np.concatenate(poles, 1)[:, which, None]
    absorbed = np.concatenate([bank.absorbed[: best.model.parts.stop] for bank in banks], 1)[:, which].T[..., None]
    # Every resonance has lines of its own, within its width.
    beside = np.clip(frequency * (1.0 + ratio * _BESIDE[::2]), _FIRST, _HIGHEST)
    all_lines = _lay_lines(scene, _LITTLE)[None], beside
    responses, count = [], len(which)
    for lines in all_lines:
        response, slopes = _respond(best, period, lines)
        responses.append(response + share * (_add_modes(best, lines, frequency, ratio) - (slopes @ absorbed)[..., 0]))
    lines = np.concatenate([np.broadcast_to(all_lines[0], (count, all_lines[0].size)), all_lines[1]], -1)
    order = np.argsort(lines, -1)
    lines, response = (np.take_along_axis(each, order, -1) for each in (lines, np.concatenate(responses, -1)))
    velocity = scene.velocity.estimate(period).jet(circle(2.0 * np.pi * lines)).value
    own, *others = DeviceRows(-1.0 / response, velocity / period).stiffest()
    return HiddenResonances(odds, np.array(others) / own) if own > 0 else None


def _lay_lines(scene: Scene, turn: float) -> np.ndarray:
    """Lines over the sampling rate between which the delay turns a fitted response by no more."""
    even = np.arange(1.0, 2.0 * np.pi * _HIGHEST * (1.0 + scene.d) / turn) * turn / (2.0 * np.pi * (1.0 + scene.d))
    below = np.geomspace(_FIRST, _LOWEST, _BELOW)[:-1]
    widths = [(mode.frequency * scene.timing.period, mode.damping_ratio * _BESIDE) for mode in scene.device.modes]
    lines = np.concatenate([below, even[even > _LOWEST], *[middle * (1.0 + width) for middle, width in widths]])
    return lines[(lines >= _FIRST) & (lines <= _HIGHEST)]


def _add_modes(best: FittedModel, lines: np.ndarray, frequency: np.ndarray, ratio: Any) -> np.ndarray:
    """What modes that move as the whole mass does add to its response."""
    (g, delta, d), mode = best.theta[:3], (2.0 * np.pi * frequency, ratio, np.sqrt(1.0 - ratio**2))
    return g * RequiredWall(delta, d, (), [mode]).add(circle(2.0 * np.pi * lines)).value


def _draw_modes(banks: list[PoleBank]) -> tuple[float, np.ndarray, np.ndarray]:
    """How likely a mode is against none after the log, if it was as likely before; equally likely poles and shares."""
    inside = [(bank.frequency >= _MODES[0]) & (bank.frequency <= _MODES[1]) for bank in banks]
    before = np.concatenate([each / each.sum() for each in inside]) / len(banks)
    chance = np.repeat([1.0 - _BEYOND_NODES, _BEYOND_NODES], _SHARES.size) / _SHARES.size
    whole, toward = (
        np.concatenate([getattr(bank, name) / bank.kindred for bank in banks]) for name in ("whole", "toward")
    )
    shares = np.concatenate([_SHARES, -_SHARES])
    left = np.outer(whole, shares)
    reached = np.cumsum(np.outer(before, chance) * np.exp(toward[:, None] * left - 0.5 * left**2))
    drawn = np.searchsorted(reached, reached[-1] * (np.arange(_DRAWN) + 0.5) / _DRAWN)
    return float(reached[-1]), drawn // shares.size, shares[drawn % shares.size]


def _respond(best: FittedModel, period: float, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The response at lines, and its derivatives in the first numbers of theta, along the last axis."""
    at = circle(2.0 * np.pi * lines.ravel())

    def answer(theta: np.ndarray) -> np.ndarray:
        wall = RequiredWall(*best.model.normalize(theta, period)[1:])
        return (-theta[0] / wall.jet(at).value).reshape(lines.shape)

    count, response = best.model.parts.stop, answer(best.theta)
    steps = _STEP * np.maximum(np.abs(best.theta[:count]), [1e-3 if k in (1, 2) else 0.0 for k in range(count)])
    moved = [answer(best.theta + step * unit) for step, unit in zip(steps, np.eye(count, best.theta.size), strict=True)]
    return response, (np.stack(moved, -1) - response[..., None]) / steps


def _glimpse(best: FittedModel) -> FittedModel:
    """The same device on the beginnings of its logs, where these are long."""
    if max(log.position.size for log in best.model.logs) <= _LOOKED:
        return best
    part = replace(best, model=best.model.begin(_LOOKED), rivals=())
    part = replace(part, squares=float(part.residuals @ part.residuals))
    return replace(part, model=replace(part.model, noise=part.noise)) if best.model.noise is not None else part


def _test(best: FittedModel, basis: np.ndarray, rest: np.ndarray, ratio: float, noise: float) -> PoleBank:
    """Compare the residuals with the forces filtered by poles of one damping ratio."""
    # A mode of each pole that moves as the whole mass does: what the pole makes of the forces, and of the last one,
    # which moves it for less than a period.
    frequency = np.geomspace(_LOWEST, _HIGHEST, 1 + round(np.log(_HIGHEST / _LOWEST) / np.log(_APART[ratio])))
    bank = PoleBank(
        ratio, frequency, *np.zeros((4, frequency.size)), absorbed=np.zeros((best.theta.size, frequency.size))
    )
    poles = _lay_poles(ratio, frequency)
    unit, late = best.theta[0] / np.abs(poles) / poles, np.exp(-(best.theta[2] % 1.0) * poles)
    size, late = unit * np.expm1(poles) * late, (unit * (1.0 - late)).imag
    last = _filter_forces(best, np.array([-np.inf]))[0]
    last_shares = basis.T @ last
    last_cleared, numbers = last - basis @ last_shares, best.inverse.matrix @ basis / best.columns[1][:, None]
    modes = np.array([size.real] if ratio == 1.0 else [size.imag, size.real])
    count = max(1, _AT_ONCE // (2 * rest.size))
    for first in range(0, frequency.size, count):
        part = slice(first, first + count)
        columns, mode = _filter_forces(best, poles[part]), modes[:, part]
        shares = basis.T @ columns
        cleared = columns - basis @ shares
        own = np.linalg.norm(cleared, axis=1).min(0) <= _OWN * np.linalg.norm(columns, axis=1).max(0)
        square = np.array([[np.sum(one * other, 0) for other in cleared] for one in cleared]).T
        along, by = (rest @ cleared).T, np.linalg.pinv(square, rcond=_OWN**2, hermitian=True)
        bank.explained[part] = np.where(own, 0.0, np.einsum("ki,kij,kj->k", along, by, along)) / noise
        left = np.sum(cleared * mode[:, None], 0) - last_cleared * late[part]
        size = np.linalg.norm(left, axis=0)
        bank.whole[part], size = size / np.sqrt(noise), np.where(own | (size == 0), np.inf, size)
        bank.toward[part] = rest @ left / size / np.sqrt(noise)
        errors = best.noise.spread_each(best.model.weigh(left)) * best.excess
        bank.kindred[part] = np.sqrt(np.maximum(errors / size**2 / noise, 1.0))
        bank.absorbed[:, part] = numbers @ (np.sum(shares * mode[:, None], 0) - last_shares * late[part])
    return bank


def _lay_poles(ratio: float, frequency: np.ndarray) -> Any:
    """Poles of a damping ratio, real ones as such."""
    return 2.0 * np.pi * frequency * (-1.0 if ratio == 1.0 else complex(-ratio, np.sqrt(1.0 - ratio**2)))


def _filter_forces(best: FittedModel, poles: np.ndarray) -> np.ndarray:
    """What poles make of all forces, at the positions, a column each; imaginary parts behind the real ones."""
    whole, logs = int(best.theta[2]), best.model.logs
    found = [
        [recur(turn, np.append(0.0, log.force[:-1]))[log.skip - whole :][: log.position.size] for log in logs]
        for turn in np.exp(poles).tolist()
    ]
    late: Any = np.array([np.concatenate(each) for each in found])
    parts = [late.real, late.imag] if np.iscomplexobj(late) else [late]
    return np.array([best.model.weigh(part.T) for part in parts])
