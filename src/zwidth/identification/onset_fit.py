"""Fit a rigid device to walls at the onset of instability, each measured by its stiffness K, damping B and frequency f.

`identification.onset_search` finds the device by least squares; this module checks the measured walls and the fit, and
proposes the wall to measure next. The unknowns are ``theta = (ln m, delta, d)``: the logarithm of the mass m, the
damping delta = b T/m, and the delay d = t_d/T, with the sampling period T (`identification.onset_model`). K_max is the
largest stable K.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.device_estimate import differentiate, differentiate_stiffness_max
from zwidth.identification.device_fit import (
    BEYOND,
    MASS_OPEN,
    VAGUE,
    AlternativeDevice,
    DeviceFit,
    NextMeasurement,
    check_period_unit,
)
from zwidth.identification.fit_report import format_alternative
from zwidth.identification.onset_model import Onsets
from zwidth.identification.onset_search import (
    AS_GOOD,
    EXACT,
    Candidate,
    RigidFit,
    are_on_boundary,
    find_device,
    is_rank_deficient,
    weight_derivatives,
)
from zwidth.model.checks import check_number, find_kind, read_texts
from zwidth.model.velocity import BackwardDifference, Velocity
from zwidth.units.formatting import plain, with_unit
from zwidth.units.parsing import read_share
from zwidth.units.unit_system import SYSTEMS, UnitSystem

CHANCE = 0.003  # significance level of the chi-square test that refuses walls as not those of a rigid device
ROUGH = 0.1  # largest accepted relative standard deviation of K and f if it is estimated from the residuals
ANGLES = 240  # number of frequencies on the stability boundary that are candidates for the next measurement
SAME = 1e-6  # relative difference of two values of B below which they count as equal


class BuzzPoint(NamedTuple):
    """A wall at the onset of instability.

    Args:
        stiffness: K in N/m at the onset of instability, reached by raising K at this B.
        virtual_damping: B in N s/m.
        frequency: frequency f of the oscillation at the onset, in Hz.
    """

    stiffness: float
    virtual_damping: float
    frequency: float


def fit_buzz(
    points: Iterable[Any],
    *,
    period: Any,
    velocity: Velocity | None = None,
    noise: float | str | tuple[float | str, float | str] | None = None,
    rotary: bool | None = None,
) -> DeviceFit:
    """Fit mass, damping and delay of a rigid device to walls at the onset of instability.

    At ``z = e^(j 2 pi f T)`` each wall gives two real equations, ``K + B F(z)/T = (m/T^2) q(z)`` with ``q = -1/G``, the
    closed form of `zwidth.boundary`. Two walls of different damping determine m, b and t_d. More walls are fitted by
    least squares of the relative errors of K and f; B is assumed exact. If the residuals exceed the noise, the device
    is not rigid and the walls are refused; `zwidth.fit_log` can then fit an actuator lag and resonances. A lag or a
    resonance with an effect below the noise hardly changes the onset at the measured values of B, but it may change
    K_max at a larger B. Therefore the B of a safe wall never exceeds the largest measured B.

    Args:
        points: walls, each (K in N/m, B in N s/m, f in Hz) or a `zwidth.BuzzPoint`; K > 0, 0 < f < 1/(2 T). At least
            two dampings. Texts with units, such as "0.4 N m/rad", are allowed.
        period: T in s.
        velocity: the velocity estimate; the backward difference by default.
        noise: relative standard deviation of K and f, as 0.02 or "2%", or one for each. By default it is equal for both
            and estimated from the residuals, which is inaccurate for two or three walls; identical walls then count
            once.
        rotary: True if K is in N m/rad and B in N m s/rad. By default, the units of the points decide; numbers without
            units are those of a linear device.

    Returns:
        DeviceFit: if B at K_max exceeds the largest measured B, the interval of K_max includes the K measured there.
        ``status``: UNDECIDED if other devices fit equally well (``alternatives``); NO_BOUNDARY if no rigid device has
        the walls on its boundary, K_max is then NaN.

    Raises:
        InputError: an invalid number, or a missing experiment, which the message names.

    Numerics:
        SciPy's Levenberg-Marquardt method from several initial values; exact walls reproduce the device to about 1e-12.
        Errors are linear in the noise, those of K_max in its logarithm. With 2 % noise of K and f, the 95 % interval
        contained K_max for 95.5 % of 200 random rigid devices with four walls each, and 198 safe walls were stable. Of
        200 devices with an actuator lag, resonances or both, 65 were refused; of the others the interval contained
        K_max for 91.9 %, and every safe wall was stable (docs/onsets.md).

    References:
        Hulin, Preusche, Hirzinger 2006, section V (the boundary). Boggs, Rogers 1990 (errors in both coordinates).

    Example:
        >>> import zwidth
        >>> walls = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
        >>> fit = zwidth.fit_buzz(walls, period="1 ms", noise=0.02)
        >>> print(f"{fit.mass * 1e3:.0f} g")
        100 g
    """
    from scipy.special import chdtri

    period = check_number("period", period)
    if isinstance(points, Iterable) and not isinstance(points, str | dict):
        points = list(points)
        implied = find_kind(
            {f"points[{k}]": list(each) for k, each in enumerate(points) if isinstance(each, list | tuple)}
        )
        if None not in (implied, rotary) and implied != rotary:
            raise InputError(f"rotary: got {rotary}, but points have the units of another kind; omit rotary")
        rotary = implied or rotary
    system = SYSTEMS[bool(rotary)]
    velocity = BackwardDifference() if velocity is None else velocity
    if not isinstance(velocity, Velocity):
        raise InputError(f"velocity: got {velocity!r}; give an estimate, as zwidth.LowPass(cutoff=100)")
    noise_pair = _read_noise(noise)
    table, warnings = _read_points(points, period, noise_pair is None, system)
    kappa, scaled_damping, w = (table * [period**2, period, 2 * np.pi * period]).T
    onsets = Onsets(kappa, scaled_damping, w, velocity, period, system=system)
    weights = 1.0 / np.array(noise_pair or (1.0, 1.0))
    rigid_fit = find_device(onsets, weights, noise_pair is not None)
    best, equals = rigid_fit.best, rigid_fit.equals
    scale = rigid_fit.scale
    refusal = None
    if noise_pair and best.squares > chdtri(rigid_fit.degrees_of_freedom, CHANCE):
        ratio = plain(np.sqrt(best.squares / rigid_fit.degrees_of_freedom), 2)
        refusal = (
            f"no rigid device has these walls: residuals are {ratio} times the noise; check K, B and f, or fit a log "
            "for lags and resonances"
        )
    elif not noise_pair and scale > ROUGH**2:
        refusal = (
            f"no rigid device has these walls: residuals are {plain(100 * np.sqrt(scale), 2)} %; check K, B, f "
            "and the period, fit a log, or give a larger noise"
        )
    elif not equals:
        refusal = "these walls are not on the stability boundary of the fitted device; check K, B, f and the period"
    status = Status.NO_BOUNDARY if refusal else Status.OK
    derivatives = weight_derivatives(onsets.predict_walls(best.theta).differentiate(), weights)
    _require_identifiability(derivatives, best.theta, table, bool(equals), system)
    information = derivatives.T @ derivatives / scale
    scene = rigid_fit.scene(best.theta)
    by_theta = differentiate(lambda theta: onsets.normalize(theta).to_parameters(period), best.theta)
    stiffness_max, gradient = differentiate_stiffness_max(scene)
    covariance = by_theta @ np.linalg.inv(information) @ by_theta.T
    distinct = [best.theta]
    for other in equals[1:] if status == Status.OK else ():
        # Skip a device if the walls cannot distinguish it from one already listed: the squared difference of the two
        # theta, in standard errors, is then at most AS_GOOD.
        if all((step := other.theta - one) @ information @ step > AS_GOOD for one in distinct):
            distinct.append(other.theta)
    alternatives = tuple(_describe_alternative(rigid_fit.scene(theta)) for theta in distinct[1:])
    if alternatives:
        status = Status.UNDECIDED
        warnings.append(
            f"another device fits equally well: {format_alternative(alternatives[0], system)}; "
            "add the measurement proposed as next"
        )
    if refusal:
        warnings.append(refusal)
    else:
        if covariance[0, 0] > (VAGUE * scene.device.mass) ** 2:
            warnings.append(MASS_OPEN)
        if best.squares > EXACT:
            warnings += [
                f"the {name} is at its lower bound, 0: a negative one would fit better; check K, B, f and the period"
                for name in best.fixed
                if name != "delay" or _estimate_delay_step(derivatives, best) < -BEYOND * np.sqrt(scale)
            ]
    further = _propose_measurement(rigid_fit, stiffness_max, information, gradient @ by_theta, weights**2 / scale)
    stiffness, damping, _ = table[np.argmax(table[:, 1])].tolist()
    fit = DeviceFit(
        nominal=scene,
        covariance=covariance,
        noise=noise_pair or (float(np.sqrt(scale)), float(np.sqrt(scale))),
        residuals=best.residuals / np.sqrt(scale),
        warnings=(*warnings, *check_period_unit(period)),
        status=int(status),
        degrees_of_freedom=None if noise_pair else rigid_fit.degrees_of_freedom,
        alternatives=alternatives,
        measured_damping=damping,
        measured_stiffness=stiffness,
    )
    if further is None or status == Status.NO_BOUNDARY:
        return fit
    after = further.stiffness_error if fit.stiffness_max > 0 else np.nan
    return replace(fit, next=further._replace(stiffness_error=after))


def _read_points(
    points: Iterable[Any], period: float, copies_count_once: bool, system: UnitSystem
) -> tuple[np.ndarray, list[str]]:
    """Convert the walls to an array of shape (walls, 3) with the columns K, B and f, and list warnings about them.

    Args:
        points: walls, as in `fit_buzz`.
        period: sampling period in s.
        copies_count_once: remove walls that are identical to others, with a warning.
        system: units of K and B.

    Raises:
        InputError: a wall is invalid, or all walls have the same damping.
    """
    if not isinstance(points, Iterable) or isinstance(points, str | dict):
        raise InputError(f"points: got {points!r}; give walls, each (K in N/m, B in N s/m, f in Hz)")
    rows, units = [], (system["N/m"], system["N s/m"], "Hz")
    for k, point in enumerate(points):
        try:
            row = [float(read_texts(f"points[{k}]", *each)) for each in zip(point, units, strict=True)]
        except (TypeError, ValueError):
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(
                f"points[{k}]: got {point!r}; give K in {units[0]}, B in {units[1]} and f in Hz, as (6e3, 0, 37.6)"
            )
        if not row[0] > 0:
            raise InputError(f"points[{k}].stiffness: got {row[0]:g} {units[0]}; it must be greater than 0")
        if not 0 < row[2] < 0.5 / period:
            raise InputError(
                f"points[{k}].frequency: got {row[2]:g} Hz; it must be greater than 0 and less than half the sampling "
                f"rate, {plain(0.5 / period)} Hz: check the frequency, or the period"
            )
        rows.append(row)
    if not rows:
        raise InputError("points: got none; raise K at B = 0 until the wall becomes unstable, and again at another B")
    warnings = []
    if copies_count_once and len(kept := list(dict.fromkeys(map(tuple, rows)))) < len(rows):
        warnings.append(
            f"{len(rows) - len(kept)} of the walls repeat others to the last digit and count once; give the noise if "
            "they were measured again"
        )
        rows = kept
    table = np.array(rows)
    # Compare differences of B with K/(2 pi f), a typical size of B, because all measured B may be 0 or close to 0.
    unit = table[0, 0] / (2 * np.pi * table[0, 2])
    if np.ptp(table[:, 1]) <= SAME * max(unit, np.abs(table[:, 1]).max()):
        count = "one wall does" if len(table) == 1 else f"{len(table)} walls of one damping do"
        raise InputError(
            f"points: {count} not determine m, b and t_d; add another damping: raise K at B = "
            f"{with_unit(table[0, 1] + 0.4 * unit, units[1], 2)}"
        )
    return table, warnings


def _read_noise(noise: Any) -> tuple[float, float] | None:
    """Return the relative standard deviations of K and f; None if ``noise`` is None. Raise `InputError` if invalid."""
    if noise is None:
        return None
    try:
        shares = [read_share(each) if isinstance(each, str) else each for each in np.ravel(np.array(noise, object))]
        pair = np.broadcast_to(np.asarray(shares, float), (2,))
    except (TypeError, ValueError):
        pair = np.zeros(2)
    if not np.all((pair > 0) & (pair < 1)):
        raise InputError(f"noise: got {noise!r}; give the relative noise of K and f, as 0.02, 2% or (0.03, 0.01)")
    return float(pair[0]), float(pair[1])


def _describe_alternative(scene: Scene) -> AlternativeDevice:
    """Return mass, damping, delay and K_max of the device of a scene, as an alternative that fits equally well."""
    return AlternativeDevice(scene.mass, scene.damping, scene.timing.delay, float(scene.max_stiffness().stiffness))


def _estimate_delay_step(derivatives: np.ndarray, best: Candidate) -> float:
    """Return the delay that least squares would choose if it were not fixed at 0, in standard errors.

    Args:
        derivatives: weighted derivatives of the residuals with respect to theta, one row per residual.
        best: fit with the delay fixed at 0; its residuals are assumed to have variance 1.
    """
    inverse = np.linalg.pinv(derivatives)[2]
    return float(inverse @ best.residuals.ravel() / np.linalg.norm(inverse))


def _require_identifiability(
    derivatives: np.ndarray, theta: np.ndarray, table: np.ndarray, on_boundary: bool, system: UnitSystem
) -> None:
    """Raise `InputError` if the walls do not determine mass, damping and delay.

    Args:
        derivatives: weighted derivatives of the residuals with respect to theta, one row per residual.
        theta: parameters of the best device.
        table: walls, shape (walls, 3), with the columns K, B and f.
        on_boundary: True if the walls are on the stability boundary of the best device.
        system: units of K and B.
    """
    if is_rank_deficient(derivatives):
        dampings = ", ".join(f"{value:g}" for value in np.unique(table[:, 1]))
        if not on_boundary:
            raise InputError(
                "points: no device has these walls on its stability boundary; check K, B, f and period; raise K from "
                "far below at each B"
            )
        raise InputError(
            f"points: B = {dampings} {system['N s/m']} do not determine m, b and t_d"
            + (f" (large b T/m = {plain(theta[1], 2)})" if theta[1] > 3 else "")
            + "; add a clearly different B"
        )


def _propose_measurement(
    rigid_fit: RigidFit, stiffness_max: float, information: np.ndarray, wanted: np.ndarray, precision: np.ndarray
) -> NextMeasurement | None:
    """Return the further wall whose measurement would reduce the standard error of K_max most; None if none exists.

    The candidates are on the stability boundary of the fitted device, with B >= 0.

    Args:
        rigid_fit: the fit to the measured walls.
        stiffness_max: K_max of the fitted device in N/m.
        information: information matrix of theta from the measured walls.
        wanted: derivatives of K_max with respect to theta.
        precision: inverse variances of ln K and ln f.
    """
    onsets, theta = rigid_fit.onsets, rigid_fit.best.theta
    scene, period = rigid_fit.scene(theta), onsets.period
    w = np.linspace(0.0, np.pi, ANGLES + 2)[1:-1]
    # Extend the uniform grid to low frequencies, because loops with long delay or weak damping become unstable there.
    w = np.concatenate([np.geomspace(1e-4, w[0], 60)[:-1], w])
    stiffness, damping = scene.boundary(w / period)
    # Exclude walls softer than a tenth of K_max, because their onset of instability is hard to measure.
    valid = (damping >= 0) & (stiffness > 0.1 * stiffness_max)
    valid[valid] = are_on_boundary(scene, stiffness[valid], damping[valid])
    if not valid.any():
        return None
    stiffness, damping, w = stiffness[valid], damping[valid], w[valid]
    walls = replace(onsets, kappa=stiffness * period**2, scaled_damping=damping * period, w=w)
    rows = walls.predict_walls(theta).differentiate()
    added = np.einsum("nki,k,nkj->nij", rows, precision, rows)
    after = np.linalg.solve(information + added, wanted[:, None])[..., 0] @ wanted
    best = int(np.argmin(after))
    return NextMeasurement(
        float(damping[best]),
        float(stiffness[best]),
        float(w[best] / (2 * np.pi * period)),
        float(np.sqrt(max(after[best], 0.0))),
    )
