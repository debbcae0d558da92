"""Search for the stiffest wall that is stable on nearly all devices that agree with the records of one device.

A wall of stiffness K and damping B is *safe* on a device if this wall and all softer walls with the same B are stable,
because users raise K from below. The devices are random, drawn from the distribution of the estimate. The *required
proportion* (reliability) is the proportion of devices on which the wall must be safe. Three methods are used:

- For rigid devices with the backward difference, lines of constant K and of constant B intersect the stable set in
  intervals (docs/theory/one-lobe.md). The search bisects K; for each K, the ends of the stable intervals of B determine
  the B that is stable on most devices.
- For rigid devices with a velocity filter, the stability limits are computed on a grid of frequencies
  (`zwidth.identification.grid_limits`). The eigenvalues of the closed loop confirm the wall on every device.
- For devices with a lag or resonances, and for undetected resonances, the wall must be stable for all responses within
  the radius of the fitted response (docs/theory/measured.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.analysis.ensemble import RigidVariants
from zwidth.analysis.tolerances import compute_stiffness_quantile
from zwidth.core.status import Status
from zwidth.identification.device_estimate import DeviceEstimate, DimensionlessDevice
from zwidth.identification.grid_limits import GridLimits, find_highest
from zwidth.model.circle_functions import circle_points
from zwidth.model.estimate import Estimate
from zwidth.model.mechanism import Body, Chain, Resonance
from zwidth.model.state_space import StateSpace, connect_in_series, realize_estimate
from zwidth.model.velocity import BackwardDifference
from zwidth.plant.sampled_plant import sample_parts
from zwidth.plant.sampled_states import SampledStates, sample_states
from zwidth.stability.rigid.normalization import device_status
from zwidth.units.display import compact_repr
from zwidth.units.quantities import SI_RANGE

_SAMPLES = 8000  # largest number of random devices
# Numbers of random devices, in multiples of ``LinearLoop.draws``, a number that is smaller for loops that are slow to
# compute.
_SEARCHED = 5  # devices used to search for the wall
_CONFIRMED = 2  # devices used only to confirm a wall
_ACCURACY = 1e-3  # relative accuracy of K at which the bisection ends
_NEGLIGIBLE = 1e-4  # K relative to the K_max of the devices below which no wall is reported
_BELOW = 1e-9  # relative reduction of K, so that the device that limits the wall is not exactly on its boundary
# Frequency grid, in rad per sample: logarithmic at low frequencies, uniform above.
_SLOWEST = 1e-4  # lowest frequency of the grid
_SLOW = 60  # number of frequencies of the logarithmic part, which slow loops require
_EVEN = 400  # number of frequencies of the uniform part
_EVEN_PER_PERIOD = 40  # additional number of frequencies of the uniform part per sampling period of delay
# Coefficients (a, b) of the largest delay of a random device, a + b times the estimated delay, in sampling periods.
# Devices with larger delays count as unstable.
_FARTHEST = (20.0, 1.5)
# Constants of the confirmation of a wall by eigenvalues.
_SOFTER = (1.0, 0.5, 0.1)  # stiffnesses of the checked walls, relative to K
# Largest accepted difference between the required proportion of devices and the proportion on which eigenvalues confirm
# the wall. It is not 0, because the stability limits on the grid of frequencies have errors.
_MAX_CONTRADICTED = 2e-3


@compact_repr(resonance="Hz")
class SafeWall(NamedTuple):
    """A wall that is stable on nearly all devices that agree with the records.

    All numbers are NaN if the status is not OK.
    """

    stiffness: float  # stiffness K of the wall, N/m
    virtual_damping: float  # damping B of the wall, N s/m
    share: float  # proportion of the random devices on which the wall is stable
    status: int  # code of `zwidth.Status`
    resonance: float = np.nan  # frequency in Hz of the undetected resonance that limits the wall; NaN if none does


_UNDECIDED = SafeWall(np.nan, np.nan, np.nan, int(Status.UNDECIDED))


def find_safe_wall(fit: DeviceEstimate, reliability: float, rigid: bool) -> SafeWall:
    """Search for the safe wall of an estimated device, for a required proportion of devices.

    Args:
        fit: the estimate.
        reliability: required proportion of devices.
        rigid: assume that the device has no undetected resonances.
    """
    scene, usual = fit.nominal, _CONFIRMED if fit.is_structured else _SEARCHED
    count = min(_SAMPLES, usual * scene.loop.draws)
    drawn = fit.draw(count)
    if drawn is None:
        return _UNDECIDED
    if fit.is_structured:
        return _find_structured_wall(fit, reliability, rigid, drawn)
    filtered = scene.velocity != BackwardDifference()
    devices = (
        _SearchedDevices(drawn, fit)
        if filtered
        else _RigidDevices(scene, dict(zip(fit.parameter_names, drawn.T, strict=True)))
    )
    most = np.inf if rigid or fit.measured_damping is None else fit.measured_damping
    (stiffness, virtual_damping), resonance = devices.find(reliability, most), np.nan
    if virtual_damping == most:
        # Limit K to a lower confidence limit of the K measured at this B, because an undetected resonance may lower the
        # stability limit next to the measured walls without changing the measured ones.
        stiffness = min(stiffness, fit.bound_measured_stiffness(reliability))
    if not rigid and fit.response_scene is not None and not is_stable_with_resonances(fit, stiffness, virtual_damping):
        # Exclude B < 0, because walls with B < 0 are not certified by the theory of measured responses.
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
    """Search for the safe wall of a device with an actuator lag or resonances.

    The wall is stable for all responses within a radius that covers the uncertainty of the fitted parameters and,
    unless ``rigid``, one undetected resonance. The random devices confirm the wall by eigenvalues.

    Args:
        fit: the estimate.
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
    """Return whether a wall and all softer walls with the same B are stable with every undetected resonance."""
    if fit.measured_damping is not None and virtual_damping > fit.measured_damping:
        return False
    scene = fit.response_scene
    if scene is None or stiffness == 0:
        return True
    alpha, beta = scene.normalize_walls(stiffness, virtual_damping)
    return scene.loop.is_connected(float(alpha), float(beta))


class _RigidDevices(RigidVariants):
    """Random rigid devices with the backward difference, whose stability limits have closed forms."""

    def find(self, reliability: float, most: float) -> tuple[float, float]:
        """Search for the stiffest wall with B <= ``most`` that is safe on the required proportion of devices.

        Returns:
            K and B; both 0 if no wall is stable on enough devices.
        """
        low, high, damping = 0.0, compute_stiffness_quantile(self.stiffest(True)[0], reliability), 0.0
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
        """Return the K up to which walls with the given B are safe on the required proportion of devices."""
        return compute_stiffness_quantile(self.find_stiffness_limits(np.array([virtual_damping]))[:, 0], reliability)

    def _find_best_damping(self, stiffness: float) -> float:
        """Return the middle of the interval of B in which walls of a given stiffness are stable on most devices."""
        sides = [self.find_damping_limits(stiffness, side) for side in ("lower", "upper")]
        valid = np.isfinite(sides[0]) & np.isfinite(sides[1])
        ends = np.concatenate([side[valid] for side in sides])
        if not ends.size:
            return 0.0
        order = np.argsort(ends, kind="stable")
        # Count the stable devices along B: their number increases at each lower end of an interval of stable B, and
        # decreases at each upper end.
        count = np.cumsum(np.repeat([1, -1], valid.sum())[order])
        first = int(np.argmax(count))
        return float(0.5 * (ends[order][first] + ends[order][first + 1]))

    def share(self, stiffness: float, virtual_damping: float) -> float:
        """Return the proportion of devices on which a wall is stable, and therefore safe."""
        return float(self.labels(stiffness, virtual_damping).mean())


class _SearchedDevices:
    """Random rigid devices with a velocity filter, whose stability limits are computed on a frequency grid (B >= 0)."""

    def __init__(self, drawn: np.ndarray, fit: DeviceEstimate) -> None:
        """Compute the critical controllers of the devices on the frequency grid.

        Args:
            drawn: parameters of random devices, one row per device.
            fit: the estimate.
        """
        period, scene = fit.period, fit.nominal
        with np.errstate(all="ignore"):
            rate, d = drawn[:, 0] / period, drawn[:, 2] / period
            valid = device_status(drawn[:, 1] / rate, d) == Status.OK
        valid &= (drawn[:, 0] > SI_RANGE[0]) & (drawn[:, 0] < SI_RANGE[1]) & (d < _FARTHEST[0] + _FARTHEST[1] * scene.d)
        # Count devices with parameters out of range as unstable, with a stability limit of 0.
        self.unstable_limits = np.zeros(np.count_nonzero(~valid))
        drawn, d, rate = drawn[valid], d[valid], rate[valid]
        self.fit, self.drawn = fit, drawn
        even = np.linspace(0.0, np.pi, int(_EVEN + _EVEN_PER_PERIOD * d.max(initial=0.0)))[1:]
        points = circle_points(np.concatenate([np.geomspace(_SLOWEST, even[0], _SLOW)[:-1], even]))
        with np.errstate(all="ignore"):
            velocity = scene.velocity.estimate(period).jet(points).value[None] / period
            plant = sample_parts(*fit.normalize(drawn[..., None])[1:3])
            critical = plant.controller(points) * (rate / period)[:, None]
            # Set the imaginary parts at z = -1 to 0, because they are only rounding errors.
            critical[:, -1], velocity[:, -1] = np.real(critical[:, -1]), np.real(velocity[:, -1])
            self.limits = GridLimits(critical, velocity)

    def find(self, reliability: float, most: float) -> tuple[float, float]:
        """Search for the stiffest wall with B <= ``most`` that is safe on the required proportion of devices.

        Returns:
            K and B; both 0 if no wall is stable on enough devices.
        """
        ends = self.limits.damping_limits
        top = self._take_quantile(ends, reliability)
        if not np.isfinite(top):
            top = float(np.max(ends, where=np.isfinite(ends), initial=0.0))
        top = np.array([min(top, most)])
        limits, dampings = find_highest(lambda tried: np.array([self.limit(tried[0], reliability)]), top)
        return (float(limits[0]), float(dampings[0])) if limits[0] > 0 else (0.0, 0.0)

    def limit(self, virtual_damping: float, reliability: float) -> float:
        """Return the K up to which walls with the given B are safe on the required proportion of devices."""
        return self._take_quantile(self.limits.limit_stiffness(np.array([virtual_damping])), reliability)

    def share(self, stiffness: float, virtual_damping: float) -> float:
        """Return the proportion of devices on which a wall and two softer ones are stable, by eigenvalues."""
        stable = _are_stable(self.fit, self.drawn, stiffness, virtual_damping)
        return float(stable.sum()) / (stable.size + self.unstable_limits.size)

    def _take_quantile(self, limits: np.ndarray, reliability: float) -> float:
        """Return the quantile of ``limits`` that the required proportion of devices reaches or exceeds.

        Args:
            limits: stability limits of the devices in range; those of the other devices are 0.
            reliability: required proportion of devices.
        """
        return compute_stiffness_quantile(np.concatenate([limits, self.unstable_limits]), reliability)


def _are_stable(fit: DeviceEstimate, drawn: np.ndarray, stiffness: float, virtual_damping: float) -> np.ndarray:
    """Test by the eigenvalues of the closed loop whether a wall and two softer ones are stable on random devices.

    Args:
        fit: the estimate.
        drawn: parameters of the devices, one row per device.
        stiffness: K in N/m; the factors of `_SOFTER` yield the softer walls.
        virtual_damping: B in N s/m.

    Returns:
        A mask of the devices on which all these walls are stable.
    """
    estimate, devices = fit.velocity.estimate(fit.period), fit.normalize(drawn)
    states, f = sample_states(_build_chain(devices, estimate)), realize_estimate(estimate)
    stable = np.zeros(len(drawn), bool)
    # Group the devices by the integer delay, because only closed loops of the same order form a batch.
    for n in np.unique(states.n_delay):
        group = states.n_delay == n
        plant = SampledStates._make((*(part[group] for part in states[:3]), n)).realize()
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
    """Convert dimensionless devices with a common velocity estimate to a batch of open loops (`Chain`)."""
    modes = tuple(Resonance(frequency, ratio, 1.0 / mass_ratio) for frequency, ratio, mass_ratio in devices.modes)
    lag = 1.0 / devices.lag[0] if devices.lag else None
    if len(devices.lag) == 2:
        lag = Resonance(lag, devices.lag[1], devices.lag[0] ** 2)
    return Chain((Body(1.0, devices.delta, 0.0),), (), modes, lag, 0, devices.d, np.floor(devices.d), estimate)
