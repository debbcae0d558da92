"""Derive a scene from a fit: round its parameters according to their standard errors, and add the safe limit of walls.

The *safe limit* is the stiffest wall (K, B) that the measurements support, with the reason for the limit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.core.status import Status
from zwidth.model.safe_limit import SafeLimit
from zwidth.units.formatting import round_conservatively, with_unit

if TYPE_CHECKING:
    from zwidth.identification.device_fit import DeviceFit
    from zwidth.identification.safe_wall import SafeWall

# Numbers of significant digits to which values are rounded.
EXACT_DIGITS = 12  # digits of parameters without a standard error
PERIOD_DIGITS = 7  # digits of sampling periods derived from timestamps, because no clock is more accurate
LIMIT_DIGITS = 4  # digits of the safe limit, as many as are printed for a wall
# Texts that describe the status of a fit in short. The warnings of the fit contain the details.
_STATUS_TEXTS = {
    Status.NOT_CONVERGED: "the search did not converge",
    Status.NO_BOUNDARY: "no device has all of these walls on its stability boundary",
    Status.UNDECIDED: "another device fits equally well",
    Status.UNREACHABLE: "the delay is at the end of the search range",
}


def round_parameter(fit: DeviceFit, name: str) -> float:
    """Return a parameter rounded to a thousandth of its standard error, so that it is equal on all machines.

    Args:
        fit: the fit.
        name: path of the parameter.
    """
    value, error = fit.value_of(name), fit.errors[name]
    if not (error > 0 and value):
        return float(f"{value:.{EXACT_DIGITS}g}")
    digits = 4 + math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return float(f"{value:.{min(max(digits, 4), EXACT_DIGITS)}g}")


def round_period(fit: DeviceFit) -> float:
    """Return the sampling period of a fit, rounded to ``PERIOD_DIGITS`` digits if it is derived from timestamps."""
    return float(f"{fit.period:.{PERIOD_DIGITS}g}") if fit.motions else fit.period


def round_scene(fit: DeviceFit) -> Scene:
    """Return a copy of the fitted scene with rounded parameters, as `zwidth fit --yaml` writes it."""
    nominal = fit.nominal
    # Replace the sampling period before the delay, because a change of the period also changes a delay that is
    # specified in periods.
    nominal = replace(nominal, timing=replace(nominal.timing, period=round_period(fit)))
    return nominal.replace(**{name: round_parameter(fit, name) for name in fit.parameter_names})


def describe_status(fit: DeviceFit) -> str:
    """Return a text that describes the status of a fit; "" if the status is OK."""
    status = Status(fit.status)
    if status == Status.UNDECIDED and not fit.alternatives:
        return "the residuals are not white noise"
    return "" if status == Status.OK else _STATUS_TEXTS.get(status, status.message)


RECORD_AGAIN = "the fit has warnings: record again as they advise"  # reason for no wall, if it is unreliable


def limit_walls(fit: DeviceFit, *, rigid: bool = False) -> SafeLimit:
    """Compute the safe limit of the walls of a fit: a wall with the reason for its limit and the warnings.

    Args:
        fit: the fit.
        rigid: assume that the device has no resonances other than the fitted ones, as in `DeviceFit.safe_wall`.
    """
    if fit.is_unreliable:
        text = describe_status(fit)
        return SafeLimit(0.0, reason=text or RECORD_AGAIN, warnings=fit.warnings)
    wall = fit.safe_wall(rigid=rigid)
    if wall.status != Status.OK or not wall.stiffness > 0:
        return SafeLimit(0.0, reason="the fitted parameters are too uncertain for any wall; record longer")
    stiffness = round_conservatively(wall.stiffness, "below", LIMIT_DIGITS)
    # Round B toward 0, because the stability limit of K often decreases steeply with |B|.
    damping = math.copysign(
        round_conservatively(abs(wall.virtual_damping), "below", LIMIT_DIGITS), wall.virtual_damping
    )
    limit = SafeLimit(float(f"{stiffness:.12g}"), float(f"{damping:.12g}"), _explain_limit(fit, wall))
    estimate, low = round_parameter(fit, "damping"), fit.intervals["damping"].low
    reserve = estimate - low if low > 0 else estimate
    return replace(
        limit, damping_reserve=float(f"{round_conservatively(max(reserve, 0.0), 'above', LIMIT_DIGITS):.12g}")
    )


def _explain_limit(fit: DeviceFit, wall: SafeWall) -> str:
    """Return a text that states the reason for the safe limit, and the measurement that can raise the limit."""
    if math.isfinite(wall.resonance):
        near = with_unit(wall.resonance, "Hz", 3)
        hidden = f"a resonance near {near}, undetectable in the log, may make stiffer walls unstable"
        return f"{hidden}; {advise_record(fit)}"
    if fit.measured_damping is not None and wall.virtual_damping >= fit.measured_damping:
        unit = fit.unit_system["N s/m"]
        measured = with_unit(fit.measured_damping, unit)
        remedy = "" if fit.next is None else f", such as B = {with_unit(fit.next.virtual_damping, unit, 3)}"
        return (
            f"no wall with B > {measured} was measured, and an undetected resonance may make such walls unstable; "
            f"measure one{remedy}"
        )
    return "stable for 99 % of the devices that are consistent with the measurements"


def advise_record(fit: DeviceFit) -> str:
    """Return a text that advises recording another log, with the command that designs the force for this log."""
    force = max(float(np.abs(motion.force).max()) for motion in fit.motions)
    options = {
        "rate": with_unit(1.0 / round_period(fit), "Hz"),
        "force": with_unit(force, fit.unit_system["N"], 2),
        "resolution": with_unit(fit.resolution or float(np.max(fit.noise)), fit.unit_system["m"], 3),
    }
    return "record again with " + " ".join(["zwidth excite", *(f"--{name} '{text}'" for name, text in options.items())])
