"""Search for the stiffest wall that is stable on nearly all devices that agree with the records of one device.

A wall (K, B) is safe on a device if it is stable and so are all softer walls with the same B, because users raise K
from below.
For a rigid device, the lines of constant K and of constant B intersect the stable set in intervals
(docs/theory/one-lobe.md). The search bisects K; for each K, the ends of the stable intervals of B determine the B that
is stable on most devices.

With a velocity filter, the lines of constant B are computed on a grid of frequencies (`zwidth.fitting.required_wall`).
Eigenvalues then decide the stability of the wall on every device.

A log also bounds undetected resonances. The wall must be stable for all responses within the radius of the fitted
response (docs/theory/measured.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.fitting.device_estimate import DeviceEstimate, DimensionlessDevice
from zwidth.fitting.required_wall import CriticalController, GridLimits, find_highest
from zwidth.loops.linear.held import DiscreteChain, add_input_delay
from zwidth.loops.rigid.normalization import device_status
from zwidth.parts.chain import Body, Chain, Resonance
from zwidth.parts.circle import circle_points
from zwidth.parts.state_space import StateSpace, connect_in_series, realize_estimate
from zwidth.parts.velocity import BackwardDifference, Estimate
from zwidth.scenes.tolerances import compute_stiffness_quantile
from zwidth.scenes.variants import RigidVariants
from zwidth.simulation.flow import flow
from zwidth.words.quantities import SI_RANGE
from zwidth.words.showing import compact_repr
from zwidth.words.status import Status

_SAMPLES = 8000  # largest number of random devices
_SEARCHED = 5  # number of random devices for a search, in multiples of ``LinearLoop.draws``
_CONFIRMED = 2  # the same to confirm a wall
_ACCURACY = 1e-3  # relative accuracy of K
_NEGLIGIBLE = 1e-4  # K below this ratio to K_max of the devices counts as 0
_BELOW = 1e-9  # relative distance of K below the limit of the active device
# Frequency grid, in rad per sample.
_SLOWEST = 1e-4  # lowest frequency
_SLOW = 60  # number of low frequencies on a logarithmic grid, for slow loops
_EVEN = 400  # number of frequencies on an even grid
_EVEN_PER_PERIOD = 40  # further frequencies on this grid per period of delay
_FARTHEST = (20.0, 1.5)  # largest delay of a device in periods: a constant, and a factor of the estimated delay
# Confirmation of a wall by eigenvalues.
_SOFTER = (1.0, 0.5, 0.1)  # checked stiffnesses, relative to K
_MAX_CONTRADICTED = 2e-3  # largest share of devices for which eigenvalues may contradict the grid of frequencies


@compact_repr(resonance="Hz")
class SafeWall(NamedTuple):
    """A wall that is stable on nearly all devices that agree with the records; NaN if the status is not OK."""

    stiffness: float  # K in N/m
    virtual_damping: float  # B in N s/m
    share: float  # proportion of the random devices on which the wall is stable
    status: int  # code of `zwidth.Status`
    resonance: float = np.nan  # frequency in Hz of the undetected resonance that limits the wall; NaN if none does


_UNDECIDED = SafeWall(np.nan, np.nan, np.nan, int(Status.UNDECIDED))


def find_safe_wall(fit: DeviceEstimate, reliability: float, rigid: bool) -> SafeWall:
    """Return the wall that `zwidth.DeviceFit.safe_wall` describes."""
    scene, usual = fit.nominal, _CONFIRMED if fit.is_structured else _SEARCHED
    count = min(_SAMPLES, usual * scene.loop.draws)
    drawn = fit.draw(count)
    if drawn is None:
        return _UNDECIDED
    if fit.is_structured:
        return _find_structured_wall(fit, reliability, rigid, drawn)
    filtered = scene.velocity != BackwardDifference()
    devices = (
        _SearchedDevices(drawn, fit) if filtered else _RigidDevices(scene, dict(zip(fit.numbers, drawn.T, strict=True)))
    )
    most = np.inf if rigid or fit.damping_tried is None else fit.damping_tried
    (stiffness, virtual_damping), resonance = devices.find(reliability, most), np.nan
    if virtual_damping == most:
        # A resonance may lower the stability limit near the largest measured B without changing the measured walls.
        stiffness = min(stiffness, fit.bound_measured_stiffness(reliability))
    if not rigid and fit.response_scene is not None and not is_stable_with_resonances(fit, stiffness, virtual_damping):
        # The theory of measured responses guarantees nothing for walls with B < 0 beyond those with B = 0.
        top = fit.response_scene.max_stiffness(negative_damping=False)
        resonance, virtual_damping = float(top.frequency), float(top.virtual_damping)
        is_stable = top.status == Status.OK
        stiffness = min(float(top.stiffness), devices.limit(virtual_damping, reliability)) if is_stable else 0.0
    if stiffness == 0:
        return SafeWall(0.0, 0.0, 1.0, int(Status.OK), resonance)
    stiffness *= 1.0 - _BELOW
    share = devices.share(stiffness, virtual_damping)
    if share < reliability - max(_MAX_CONTRADICTED, 1.0 / count):
        return _UNDECIDED
    return SafeWall(stiffness, virtual_damping, share, int(Status.OK), resonance)


def _find_structured_wall(fit: DeviceEstimate, reliability: float, rigid: bool, drawn: np.ndarray) -> SafeWall:
    """Return the safe wall for a device with a lag or resonances.

    The wall is stable for all responses within a radius that covers the uncertainty of the fitted parameters and,
    unless ``rigid``, one undetected resonance. The random devices confirm the wall by eigenvalues.

    Args:
        fit: the fit.
        reliability: required proportion of devices.
        rigid: assume that the device has no undetected resonances.
        drawn: parameters of random devices, one row per device.
    """
    scene = fit.build_response_scene(reliability, not rigid)
    if scene is None:
        return _UNDECIDED
    top = scene.max_stiffness(negative_damping=False)
    if top.status != Status.OK:
        return SafeWall(0.0, 0.0, 1.0, int(Status.OK), float(top.frequency))
    wall = float(top.stiffness), float(top.virtual_damping)
    share = float(_are_stable(fit, drawn, *wall).mean())
    if share < reliability - 1.0 / np.sqrt(len(drawn)):
        return _UNDECIDED
    return SafeWall(*wall, share, int(Status.OK), np.nan if rigid else float(top.frequency))


def is_stable_with_resonances(fit: DeviceEstimate, stiffness: float, virtual_damping: float) -> bool:
    """Return whether a wall, and every softer one with the same B, is stable for all undetected resonances."""
    if fit.damping_tried is not None and virtual_damping > fit.damping_tried:
        return False
    scene = fit.response_scene
    if scene is None or stiffness == 0:
        return True
    alpha, beta = scene.normalize_walls(stiffness, virtual_damping)
    return scene.loop.is_connected(float(alpha), float(beta))


class _RigidDevices(RigidVariants):
    """Random rigid devices with the backward difference: stability by closed forms."""

    def find(self, reliability: float, most: float) -> tuple[float, float]:
        """Return K and B of the stiffest wall with B <= ``most``; both 0 if no wall is stable on enough devices."""
        low, high, damping = 0.0, compute_stiffness_quantile(self.stiffest()[0], reliability), 0.0
        least = _NEGLIGIBLE * high
        while high > max((1.0 + _ACCURACY) * low, least):
            stiffness = 0.5 * (low + high)
            trial = self._find_best_damping(stiffness)
            limit = self.limit(trial, reliability)
            if limit > low:
                low, damping = limit, trial
            if limit < stiffness:
                high = stiffness
        if damping > most:
            low, damping = self.limit(most, reliability), most
        return (low, damping) if low > least else (0.0, 0.0)

    def limit(self, virtual_damping: float, reliability: float) -> float:
        """Return the K up to which all walls with this B are stable on the required proportion of devices."""
        return compute_stiffness_quantile(self.find_stiffness_limits(np.array([virtual_damping]))[:, 0], reliability)

    def _find_best_damping(self, stiffness: float) -> float:
        """Return the middle of the interval of B in which this stiffness is stable on most devices."""
        sides = [self.find_damping_limits(stiffness, side) for side in ("lower", "upper")]
        valid = np.isfinite(sides[0]) & np.isfinite(sides[1])
        ends = np.concatenate([side[valid] for side in sides])
        if not ends.size:
            return 0.0
        order = np.argsort(ends, kind="stable")
        # The number of stable devices increases at each lower end and decreases at each upper end.
        count = np.cumsum(np.repeat([1, -1], valid.sum())[order])
        first = int(np.argmax(count))
        return float(0.5 * (ends[order][first] + ends[order][first + 1]))

    def share(self, stiffness: float, virtual_damping: float) -> float:
        """Return the proportion of devices on which the wall, and therefore every softer one, is stable."""
        return float(self.labels(stiffness, virtual_damping).mean())


class _SearchedDevices:
    """Random rigid devices with a velocity filter: stability from a grid of frequencies, for B >= 0."""

    def __init__(self, drawn: np.ndarray, fit: DeviceEstimate) -> None:
        """Compute the critical controllers of the devices; ``drawn`` has their parameters, one row per device."""
        period, scene = fit.period, fit.nominal
        with np.errstate(all="ignore"):
            rate, d = drawn[:, 0] / period, drawn[:, 2] / period
            valid = device_status(drawn[:, 1] / rate, d) == Status.OK
        valid &= (drawn[:, 0] > SI_RANGE[0]) & (drawn[:, 0] < SI_RANGE[1]) & (d < _FARTHEST[0] + _FARTHEST[1] * scene.d)
        # Devices out of range count as unstable.
        self.unstable_limits = np.zeros(np.count_nonzero(~valid))
        drawn, d, rate = drawn[valid], d[valid], rate[valid]
        self.fit, self.drawn = fit, drawn
        even = np.linspace(0.0, np.pi, int(_EVEN + _EVEN_PER_PERIOD * d.max(initial=0.0)))[1:]
        points = circle_points(np.concatenate([np.geomspace(_SLOWEST, even[0], _SLOW)[:-1], even]))
        with np.errstate(all="ignore"):
            velocity = scene.velocity.estimate(period).jet(points).value[None] / period
            controller = CriticalController(*fit.normalize(drawn[..., None])[1:3])
            critical = controller.evaluate_rigid(points).value * (rate / period)[:, None]
            # Remove the rounding errors of the imaginary parts at z = -1.
            critical[:, -1], velocity[:, -1] = np.real(critical[:, -1]), np.real(velocity[:, -1])
            self.limits = GridLimits(critical, velocity)

    def find(self, reliability: float, most: float) -> tuple[float, float]:
        """Return K and B of the stiffest wall with B <= ``most``; both 0 if no wall is stable on enough devices."""
        ends = self.limits.damping_limits
        top = self._take_quantile(ends, reliability)
        if not np.isfinite(top):
            top = float(np.max(ends, where=np.isfinite(ends), initial=0.0))
        top = np.array([min(top, most)])
        limits, dampings = find_highest(lambda tried: np.array([self.limit(tried[0], reliability)]), top)
        return (float(limits[0]), float(dampings[0])) if limits[0] > 0 else (0.0, 0.0)

    def limit(self, virtual_damping: float, reliability: float) -> float:
        """Return the K up to which all walls with this B are stable on the required proportion of devices."""
        return self._take_quantile(self.limits.limit_stiffness(np.array([virtual_damping])), reliability)

    def share(self, stiffness: float, virtual_damping: float) -> float:
        """Return the proportion of devices on which the wall and the checked softer ones are stable, by eigenvalues."""
        stable = _are_stable(self.fit, self.drawn, stiffness, virtual_damping)
        return float(stable.sum()) / (stable.size + self.unstable_limits.size)

    def _take_quantile(self, limits: np.ndarray, reliability: float) -> float:
        """Return the limit that the required proportion of all devices reaches, including those out of range."""
        return compute_stiffness_quantile(np.concatenate([limits, self.unstable_limits]), reliability)


def _are_stable(fit: DeviceEstimate, drawn: np.ndarray, stiffness: float, virtual_damping: float) -> np.ndarray:
    """Return a mask of the devices on which a wall, and softer ones with the same B, are stable, by eigenvalues."""
    estimate, devices = fit.velocity.estimate(fit.period), fit.normalize(drawn)
    A, B, _ = (np.moveaxis(part, -1, 0) for part in _build_chain(devices, estimate).realize())
    n_delay, f = np.floor(devices.d).astype(int), realize_estimate(estimate)
    rate, size = np.concatenate([A, B[..., None]], -1), B.shape[-1]
    times = np.stack([np.ones_like(devices.d), n_delay + 1.0 - devices.d], -1)
    moved = flow(rate, np.zeros((len(A), size + 1, size + 1)), times).change
    parts = moved[:, 0, :, :size], moved[:, 0, :, size], moved[:, 1, :, size]
    stable = np.zeros(len(drawn), bool)
    # Devices with the same integer delay have closed loops of the same order.
    for n in np.unique(n_delay):
        group = n_delay == n
        plant = add_input_delay(DiscreteChain(*(part[group] for part in parts)), int(n))
        alpha, beta = (
            wall / devices.mass[group, None, None] for wall in (stiffness * fit.period**2, virtual_damping * fit.period)
        )
        loops = (
            connect_in_series(StateSpace(f.A, f.B, beta * f.C, softer * alpha + beta * f.D), plant)
            for softer in _SOFTER
        )
        radii = [np.abs(np.linalg.eigvals(loop.A - loop.B @ loop.C)).max(-1) for loop in loops]
        stable[group] = np.max(radii, 0) < 1.0
    return stable


def _build_chain(devices: DimensionlessDevice, estimate: Estimate) -> Chain:
    """Return the mass, the modes and the actuator lag of all devices, as arrays over the devices."""
    modes = tuple(Resonance(frequency, ratio, 1.0 / mass_ratio) for frequency, ratio, mass_ratio in devices.modes)
    lag = 1.0 / devices.lag[0] if devices.lag else None
    if len(devices.lag) == 2:
        lag = Resonance(lag, devices.lag[1], devices.lag[0] ** 2)
    return Chain((Body(1.0, devices.delta, 0.0),), (), modes, lag, 0, devices.d, 0, estimate)
