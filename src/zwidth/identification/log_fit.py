"""Fit a device to a log of its free motion under a commanded force.

The steps are: read and repair the logs (`identification.recordings`); fit the positions by least squares
(`identification.output_error`) with the model structure that the Bayesian information criterion (BIC) selects
(`identification.model_selection`); refuse logs whose motion the force does not explain; test the residuals for white
noise; and bound undetected resonances and actuator lags (`identification.unmodeled_dynamics`,
`identification.unmodeled_lag`). ``theta`` is the parameter vector of `identification.extended_model`. A *stretch* is a
part of a log without missing samples. The *excess* of the residuals measures their autocorrelation
(`FittedModel.excess`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.core.types import ArrayLike
from zwidth.identification.causes import Cause, explain_motion, explain_residuals
from zwidth.identification.device_estimate import compute_coverage_factor, differentiate
from zwidth.identification.device_fit import (
    BEYOND,
    MASS_OPEN,
    SEE_MORE,
    VAGUE,
    DeviceFit,
    FittedMotion,
    check_period_unit,
)
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording
from zwidth.identification.model_selection import ALIKE, EXACT, Choice, choose_structure
from zwidth.identification.output_error import MIN_FRICTION, FittedModel, fit_model
from zwidth.identification.quantization_noise import fits_steps
from zwidth.identification.recordings import ReadLogs, find_even, find_stretches, read_logs
from zwidth.identification.unmodeled_dynamics import HiddenPole, bound_response, sample_resonances
from zwidth.identification.unmodeled_lag import bound_lag
from zwidth.model.checks import check_number
from zwidth.model.velocity import BackwardDifference, Velocity
from zwidth.units.formatting import plain, with_unit
from zwidth.units.quantities import NOT_NEGATIVE
from zwidth.units.unit_system import SYSTEMS, UnitSystem

_LONGEST = 20  # largest delay of the search by default, in sampling periods
# Usual values in SI units, for linear devices (False) and rotary ones (True): smallest mass, largest mass, largest
# range of the positions, largest force. Other values cause a warning, because their unit may be wrong.
_USUAL = {False: (2e-3, 10.0, 3.0, 1e3), True: (1e-8, 10.0, 100.0, 300.0)}
_FEWEST = 20  # least number of fitted positions per stretch; shorter stretches are omitted
_FEW = 60  # number of fitted positions below which a warning is issued, because very different devices may fit them
# Largest number of fitted positions of all logs together. More positions would need gigabytes of memory, and would only
# reduce standard errors that are already small.
_MOST = 200_000
_FINER = 0.3  # an encoder step is excluded if the residuals are at most this share of its quantization noise (RMS)
_SEEN = 5.0  # least effect of the force on the positions, in standard errors; smaller effects are refused
# A log is refused if its residuals exceed both of the following limits.
_UNEXPLAINED = 0.01  # residual sum of squares, relative to that of a model without forces
_SMOOTH = 5.0  # excess of the residuals
# Remedy in warnings about dynamics that the model lacks.
_RECORD_NEXT = "measure the response instead (zwidth.excite, zwidth.respond), which needs no model"


def fit_log(
    time: ArrayLike,
    position: ArrayLike,
    force: ArrayLike,
    *,
    velocity: Velocity | None = None,
    max_delay: Any = None,
    resolution: Any = None,
    resample: bool = False,
    rotary: bool = False,
) -> DeviceFit:
    """Fit mass, damping and delay of a device to a log of its free motion under commanded forces.

    The model is ``m x'' + b x' = F(t - t_d) + f0 - F_c sign(x')``, with zero-order hold of the force; the positions
    are fitted by least squares. The constant force f0 and the friction F_c are always fitted. This increases the errors
    of the other parameters, but omitting f0 or F_c when they are hardly visible could bias the other parameters by many
    standard errors. An actuator lag of first or second order and resonances are added if the Bayesian information
    criterion (BIC) requires them.

    Args:
        time: times of the samples in s, evenly spaced, or only the sampling period. The parts before and after missing
            samples are fitted as two logs. For several logs of one device, time, position and force are lists of
            arrays.
        position: sampled positions in m.
        force: commanded forces at the same samples in N, positive in the direction of increasing positions.
        velocity: velocity estimate of the loop for which K_max is computed; the backward difference by default.
        max_delay: largest delay of the search in s; 20 periods by default. The positions within this time from the
            start are not fitted, because past forces are unknown. At most 200,000 samples of all logs are fitted.
        resolution: encoder step in m, 0 for a sensor without steps; by default determined from the positions.
        resample: accept timestamp jitter of up to a quarter of the period instead of 5 %. The samples are treated as
            evenly spaced, with the period that fits all times.
        rotary: True if the position is an angle in rad and the force a torque in N m. The mass is then an inertia in
            kg m², the damping in N m s/rad, and so on.

    Returns:
        DeviceFit: ``friction`` and ``offset`` have errors NaN if the log does not distinguish the two forces, as for
        motion in one direction only. ``warnings`` may concern a unit, for example; with a warning there is no safe
        wall. ``status`` is UNREACHABLE if the delay is at the end of the search range; NOT_CONVERGED if the search did
        not converge; UNDECIDED, with K_max NaN, if the residuals are not white noise. ``response`` limits the safe wall
        for a device with undetected resonances.

    Raises:
        InputError: times are uneven, the force or the position never changes, the fitted mass is negative, another
            force causes most of the motion, or the log does not determine mass, damping and delay.

    Numerics:
        The motion between samples is computed in closed form, including reversals and sticking, with exact derivatives;
        the least-squares method is Levenberg-Marquardt in NumPy. A log of 3,000 samples takes about half a second,
        without compilation. Friction causes local minima, one for each missed reversal or rest. Therefore several fits
        start, with frictions of 0 and of 0.3 to 35 % of the largest force, from the first 300 samples, and the best
        ones continue with more and more samples. If a fit without friction is almost as good, the standard errors
        include the difference. The standard errors account for the autocorrelated errors of the encoder; all samples
        of a rest count as one. The interval of K_max averages over 200 devices with one more resonance, drawn from its
        posterior distribution, and the device without it, at prior odds of 1 (docs/theory/hidden.md). docs/fitting.md
        lists how often the intervals contain the true values.

    References:
        Ljung 1999, System Identification, section 4.2 (output error). Leeb, Poetscher 2005, Econometric Theory 21,
        21-59 (invalid intervals after model selection). Hoeting, Madigan, Raftery, Volinsky 1999, Statistical
        Science 14, 382-417 (intervals over all models). Schwarz 1978, Annals of Statistics 6, 461-464 (further
        parameters). Widrow, Kollar 2008, Quantization Noise (quantization errors). Hulin,
        Preusche, Hirzinger 2006, eq. (9).

    Example:
        >>> import numpy as np
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 2), zwidth.Timing(period=1e-3))
        >>> force = np.where(np.arange(400) % 60 < 30, 1.0, -1.0)
        >>> motion = zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, periods=400)
        >>> fit = zwidth.fit_log(1e-3, motion.position[:400], force)
        >>> print(f"{fit.mass * 1e3:.1f} g, {fit.damping:.2f} N s/m")
        100.0 g, 2.00 N s/m
    """
    system = SYSTEMS[rotary]
    read = read_logs(time, position, force, system, resample, resolution)
    return _fit(read, BackwardDifference() if velocity is None else velocity, max_delay, resolution, system)


def _fit(
    read: ReadLogs,
    velocity: Velocity,
    max_delay: Any,
    resolution: Any,
    system: UnitSystem,
) -> DeviceFit:
    """Fit a device to logs that have already been read and repaired.

    Args:
        read: the logs.
        velocity: velocity estimate of the scene of the fitted device.
        max_delay: largest delay as specified by the user; None for the default.
        resolution: encoder step as specified by the user; None to determine it.
        system: units of the logs.
    """
    logs, places, period, period_error, notes, _ = read
    longest = _LONGEST if max_delay is None else check_number("max_delay", max_delay, "s", NOT_NEGATIVE) / period
    skip = int(np.ceil(longest)) + 2
    stretches = [find_even(place, skip + _FEWEST) for place in places]
    for k, parts in enumerate(stretches):
        if not parts:
            most = max((each.stop - each.start for each in find_even(places[k], 1)), default=1)
            raise InputError(
                f"time: log {k + 1} has {most} samples without a gap; at least {skip + _FEWEST} are needed, "
                f"because the first {skip} only provide past forces: record longer, or give a shorter max_delay"
            )
    count = sum(map(len, stretches))
    recordings = tuple(
        Recording(log.force[each], log.position[each][skip:], skip).truncate(_MOST // count)
        for log, parts in zip(logs, stretches, strict=True)
        for each in parts
    )
    warnings = [warning for log in logs for warning in find_stretches(log, system)]
    steps, step_warnings = _list_steps(resolution, read, system)
    step, (best, pole, bank, lags) = _choose_step(recordings, longest, steps)
    model, theta = best.model, best.theta
    _refuse_unmoved(best, period, system)
    if best.inverse.undetermined[:3].any():
        raise InputError(
            "force: this log does not determine mass, damping and delay; record longer, with a force that changes its "
            "sign at irregular times"
        )
    scene, of_device = model.normalize(theta, period).to_scene(period, velocity, system), slice(0, model.parts.stop)
    by_theta = differentiate(lambda theta: model.normalize(theta, period).to_parameters(period), theta)[:, of_device]
    (by_period,) = differentiate(
        lambda time: model.normalize(theta, time[0]).to_parameters(time[0]), np.array([period])
    ).T
    from_period = period_error * period * by_period
    covariance = by_theta @ best.covariance[of_device, of_device] @ by_theta.T + np.outer(from_period, from_period)
    degrees_of_freedom = max(1, best.count - theta.size)
    unexplained = _find_unexplained(best, pole, period, system) if bank else []
    warnings = step_warnings + warnings + _list_warnings(scene, np.sqrt(np.diag(covariance)), best, logs) + unexplained
    status = Status.OK if best.converged else Status.NOT_CONVERGED
    # Report the fit as undecided if the residuals are not white noise, because the K_max of the true device may then be
    # very different.
    status = Status.UNDECIDED if status == Status.OK and unexplained else status
    if theta[2] > longest - 1e-3:
        status = Status.UNREACHABLE
        warnings.append(
            f"the delay is at the end of the search range, {with_unit(longest * period, 's')}; give a longer max_delay"
        )
    motions = _build_motions(best, logs, places, stretches, skip, period)
    offset, friction = (_convert_force(best, k) for k in (-2, -1))
    analyses: dict[str, Any] = {}
    if bank and not unexplained:
        analyses = {"response": bound_response(best, scene, bank), "hidden": sample_resonances(best, scene, bank)}
        analyses |= {"lag": bound_lag(best, lags, scene, compute_coverage_factor(degrees_of_freedom))}
    return DeviceFit(
        nominal=scene,
        covariance=covariance,
        force_errors={"offset": offset[1], "friction": friction[1]},
        offset=offset[0],
        friction=friction[0],
        resolution=step,
        motions=motions,
        noise=float(np.sqrt(best.variance)),
        residuals=np.concatenate([motion.position - motion.modeled for motion in motions]),
        warnings=(*warnings, *check_period_unit(period)),
        status=int(status),
        degrees_of_freedom=degrees_of_freedom,
        notes=notes,
        **analyses,
    )


def _find_unexplained(best: FittedModel, pole: HiddenPole | None, period: float, system: UnitSystem) -> list[str]:
    """Return a warning if the residuals are not white noise, or if the fitted lag may be a resonance.

    Args:
        best: the fitted model.
        pole: pole that the model lacks, or resonance that may replace its lag; None if there is neither.
        period: sampling period in s.
        system: units of the logs.

    Returns:
        A list with the warning, which states the cause and the remedy; an empty list if no warning is necessary.
    """
    cause = explain_residuals(best, system) if pole is not None or best.excess > ALIKE else ""
    if cause:
        remedy = "log the force with more digits" if "rounded" in cause else _RECORD_NEXT
        return [f"the residuals are not white noise: {cause}; {remedy}"]
    if pole is not None and pole.replaces_lag:
        near = with_unit(pole.frequency / period, "Hz", 3)
        cause = f"an actuator lag and a resonance near {near}, with another K_max, fit equally well"
        return [f"{cause}: {SEE_MORE}"]
    if pole is not None:
        kind = "a resonance near" if pole.is_resonance else "an actuator lag with a corner frequency near"
        cause = f"they indicate {kind} {with_unit(pole.frequency / period, 'Hz', 3)}"
    elif best.excess > ALIKE:
        ratio = plain(np.sqrt(best.excess), 2)
        cause = f"their sums are {ratio} times too large, as with a hand or a compliance"
    else:
        return []
    return [f"the residuals are not white noise: {cause}; {_RECORD_NEXT}"]


def _convert_force(best: FittedModel, k: int) -> tuple[float, float]:
    """Convert entry ``k`` of theta, the acceleration by the constant force or by friction, to a force in N.

    Returns:
        The force and its standard error.
    """
    g = best.theta[0]
    value, indices = best.theta[k] / g, [0, k]
    slope = np.array([-value / g, 1.0 / g])
    error = float(np.sqrt(slope @ best.covariance[np.ix_(indices, indices)] @ slope))
    # Report a friction at the lower bound of the search as 0, because this bound is slightly above 0.
    is_zero = k == -1 and value <= 2.0 * MIN_FRICTION * best.model.largest_force
    return 0.0 if is_zero else float(value), error


def _list_steps(resolution: Any, read: ReadLogs, system: UnitSystem) -> tuple[list[float], list[str]]:
    """List the candidates for the encoder step, largest first, and warnings about a step that the user specified.

    Positions near integer multiples of a step need not be those of an encoder: under a constant force, the positions of
    a sensor without steps may have this property, too. Only the residuals distinguish the two cases. 0 is the candidate
    for a sensor without steps.

    Args:
        resolution: encoder step as specified by the user; None to determine it from the positions.
        read: the logs.
        system: units of the logs.
    """
    if resolution is None:
        columns = zip(*read.steps, strict=True)
        return sorted({min(each) if max(each) < 1.5 * min(each) else 0.0 for each in columns}, reverse=True), []
    step = check_number("resolution", resolution, system["m"], NOT_NEGATIVE)
    pairs = zip(read.logs, read.steps, strict=True)
    if step and not all(fits_steps(log.position, step, slack=column) for log, (_, column) in pairs):
        text = with_unit(step, system["m"])
        return [0.0], [
            f"the positions are not multiples of {text}, so their errors are treated as noise: check resolution"
        ]
    return [step], []


def _choose_step(recordings: tuple[Recording, ...], longest: float, steps: list[float]) -> tuple[float, Choice]:
    """Fit the device with each candidate for the encoder step in turn, until the residuals agree with a candidate.

    Args:
        recordings: the logs.
        longest: largest delay of the search, in sampling periods.
        steps: candidates for the encoder step, coarsest first.

    Returns:
        The encoder step, and the result of `choose_structure` with this step.
    """
    step, *finer = steps
    choice = choose_structure(fit_model(Recordings(recordings, longest=longest, resolution=step)))
    excluded = choice[0].variance <= (_FINER * step) ** 2 / 12.0
    return _choose_step(recordings, longest, finer) if finer and excluded else (step, choice)


def _refuse_unmoved(best: FittedModel, period: float, system: UnitSystem) -> None:
    """Raise `InputError` if the commanded force explains too little of the motion, or the fitted mass is negative."""
    model, theta, squares = best.model, best.theta, float(best.residuals @ best.residuals)
    # Fit the positions by the motion without forces, with free initial states. The effect of the forces is the amount
    # by which the fitted model reduces the residuals of this motion.
    alone = model.simulate(np.append(theta[:-2], [0.0, 0.0])).derivatives[:, model.parts.stop : -2]
    sizes = np.linalg.norm(alone, axis=0)
    rest = model.measured - alone / sizes @ np.linalg.lstsq(alone / sizes, model.measured, rcond=None)[0]
    if float(rest @ rest) - squares <= _SEEN**2 * squares / model.measured.size:
        raise InputError(
            "force: the position does not follow it; check that both columns belong to the same axis, and that "
            "nothing blocks the device"
        )
    left = squares / float(rest @ rest)
    unexplained = left > _UNEXPLAINED and best.excess > _SMOOTH
    cause = explain_motion(model.logs, period, system) if theta[0] <= 0 or unexplained else Cause("")
    if cause.text:
        raise InputError(
            f"force: {cause.text}; support the device, or measure its frequency response, which needs no model "
            "(zwidth.excite, zwidth.respond)"
        )
    if theta[0] <= 0 and (cause.reversed or left < _UNEXPLAINED):
        raise InputError(
            "force: the device accelerates against it, as with a mass of "
            f"{with_unit(period**2 / theta[0], system['kg'])}; reverse the sign of force or position; a velocity in "
            "place of the position has the same effect"
        )
    if theta[0] <= 0:
        raise InputError(
            f"force: it does not explain {plain(100 * np.sqrt(left), 2)} % of the motion, and the fitted mass is "
            "negative; check that both columns belong to one axis, that every sample is logged and nothing else moves "
            "the device"
        )
    if unexplained:
        raise InputError(
            f"force: {plain(100 * np.sqrt(left), 2)} % of the motion is unexplained and not white noise: another "
            "force, a saturated motor, a wrong column or missing samples; record every sample of the free device"
        )


def _list_warnings(scene: Scene, errors: np.ndarray, best: FittedModel, logs: tuple[Recording, ...]) -> list[str]:
    """List warnings about values that suggest a wrong unit, and about parameters that the log hardly determines.

    Args:
        scene: scene of the fitted device.
        errors: standard errors of the parameters of `name_parameters`.
        best: the fitted model.
        logs: the logs.
    """
    mass, damping, delay = scene.device.mass, scene.device.damping, scene.timing.delay
    warnings, residuals, units = [], best.residuals, scene.unit_system
    lightest, heaviest, farthest, strongest = _USUAL[units.rotary]
    length, newton, fine = units["m"], units["N"], "degrees or counts" if units.rotary else "mm"
    if not lightest <= mass <= heaviest:
        light = f"the position may be in {fine}, or the force in k{newton}"
        heavy = f"the force may be in m{newton}, the time in ms, or the position in a larger unit"
        unit = light if mass < lightest else heavy
        value = f"a mass of {with_unit(mass, units['kg'])} is far from any device"
        warnings.append(f"{value}; {unit}: check that they are in {length}, {newton} and s")
    span, force = max(float(np.ptp(log.position)) for log in logs), best.model.largest_force
    if span > farthest:
        value = f"a travel of {with_unit(span, length)} is far from any device"
        warnings.append(f"{value}; the position may be in {fine}: check that it is in {length}")
    if force > strongest:
        value = f"a force of {with_unit(force, newton)} is far from any device"
        warnings.append(f"{value}; it may be in m{newton}: check that it is in {newton}")
    if errors[0] > VAGUE * mass:
        warnings.append(MASS_OPEN)
    if residuals.size < _FEW:
        warnings.append(
            f"only {residuals.size} positions are fitted, because earlier ones only provide past forces: the errors "
            "may be larger; record longer, or give a shorter max_delay"
        )
    size = float(residuals @ residuals)
    if size <= EXACT**2 * residuals.size * span**2:
        # Return without further warnings, because the residuals are only rounding errors.
        return warnings
    if damping == 0:
        warnings.append(
            "the damping is at its lower bound, 0: a negative one would fit better; record longer, or a faster motion"
        )
    elif errors[1] > VAGUE * damping:
        longest = max(log.force.size for log in logs)
        warnings.append(
            f"the damping is hardly determined: its standard error is {with_unit(errors[1], units['N s/m'], 2)}; "
            f"record more than {longest} samples, or a faster motion"
        )
    if delay == 0 and (step := best.estimate_step(2)) < -BEYOND:
        warnings.append(
            f"the delay is at its lower bound, 0: a negative delay would fit better, by {plain(-step, 2)} standard "
            "errors; check for a shifted column"
        )
    return warnings


def _build_motions(
    best: FittedModel,
    logs: tuple[Recording, ...],
    places: tuple[np.ndarray, ...],
    stretches: list[list[slice]],
    skip: int,
    period: float,
) -> tuple[FittedMotion, ...]:
    """Combine each log with the positions of the fitted model.

    The modeled positions are NaN for samples that are not fitted: the first ones of each stretch, and short stretches.

    Args:
        best: the fitted model.
        logs: the logs.
        places: for each log the times of its samples, in sampling periods.
        stretches: for each log its fitted stretches.
        skip: number of samples at the start of a stretch that only provide past forces.
        period: sampling period in s.
    """
    motions, parts = [], iter(best.model.split(best.response.position))
    for log, place, slices in zip(logs, places, stretches, strict=True):
        modeled = np.full(log.force.size, np.nan)
        for each in slices:
            part = next(parts)
            modeled[each.start + skip : each.start + skip + part.size] = part
        motions.append(FittedMotion(period * place, log.force, log.position, modeled))
    return tuple(motions)
