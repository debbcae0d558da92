"""The scene that a fit hands over: parameters rounded to their standard errors, and the safe limit of walls."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from zwidth.parts.safe_limit import SafeLimit
from zwidth.scenes.scene import Scene
from zwidth.words.formatting import round_safely, with_unit
from zwidth.words.rotation import use_kind
from zwidth.words.status import Status

if TYPE_CHECKING:
    from zwidth.fitting.device_fit import DeviceFit
    from zwidth.fitting.safe_wall import SafeWall

EXACT_DIGITS = 12  # of a parameter without a standard error
PERIOD_DIGITS = 7  # of a period that was read from timestamps: finer than any clock's accuracy
LIMIT_DIGITS = 4  # of the safe limit, as walls are printed
# The status of a fit in words; its warnings say more.
_TROUBLES = {
    Status.NOT_CONVERGED: "the search did not converge",
    Status.NO_BOUNDARY: "the walls do not lie on the edge of any device's stable set",
    Status.UNDECIDED: "another device fits as well",
    Status.UNREACHABLE: "the delay is at the end of the range searched",
}


def round_number(fit: DeviceFit, name: str) -> float:
    """Return a parameter rounded to a thousandth of its standard error: further digits differ between machines."""
    value, error = fit.value_of(name), fit.errors[name]
    if not (error > 0 and value):
        return float(f"{value:.{EXACT_DIGITS}g}")
    digits = 4 + math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return float(f"{value:.{min(max(digits, 4), EXACT_DIGITS)}g}")


def round_period(fit: DeviceFit) -> float:
    """Return the period, without the rounding errors of timestamps."""
    return float(f"{fit.period:.{PERIOD_DIGITS}g}") if fit.motions else fit.period


def round_scene(fit: DeviceFit) -> Scene:
    """Return the fitted scene with rounded parameters, as configurations spell them."""
    nominal = fit.nominal
    # Before the delay: one in periods would change with the period.
    nominal = replace(nominal, timing=replace(nominal.timing, period=round_period(fit)))
    return nominal.replace(**{name: round_number(fit, name) for name in fit.numbers})


def name_trouble(fit: DeviceFit) -> str:
    """Return the status of a fit in words, "" if it is OK."""
    status = Status(fit.status)
    if status == Status.UNDECIDED and not fit.rivals:
        return "the residuals are not white noise"
    return "" if status == Status.OK else _TROUBLES.get(status, status.message)


def limit_walls(fit: DeviceFit, *, rigid: bool = False) -> SafeLimit:
    """Return the limit of the walls that a fit supports, with its reason and the warnings of the fit.

    ``rigid`` assumes that the device has no other resonances, as in `DeviceFit.safe_wall`.
    """
    with use_kind(bool(fit.nominal.device.rotary)):
        if fit.is_doubted:
            trouble = name_trouble(fit)
            return SafeLimit(0.0, reason=trouble or "resolve the warnings first", warnings=fit.doubts)
        wall = fit.safe_wall(rigid=rigid)
        if wall.status != Status.OK or not wall.stiffness > 0:
            return SafeLimit(0.0, reason="the records leave the device too uncertain for any wall; record longer")
        stiffness = round_safely(wall.stiffness, "below", LIMIT_DIGITS)
        # Toward 0: beyond the damping of the limit the stiffness often falls steeply.
        damping = math.copysign(round_safely(abs(wall.virtual_damping), "below", LIMIT_DIGITS), wall.virtual_damping)
        return SafeLimit(float(f"{stiffness:.12g}"), float(f"{damping:.12g}"), _explain(fit, wall))


def _explain(fit: DeviceFit, wall: SafeWall) -> str:
    """Return the cause of a safe limit, and the measurement that would raise it."""
    if math.isfinite(wall.resonance):
        near = with_unit(wall.resonance, "Hz", 3)
        hidden = f"a resonance near {near} could make stiffer walls unstable without showing in the log"
        return f"{hidden}; {advise_record(fit)}"
    if fit.damping_tried is not None and wall.virtual_damping >= fit.damping_tried:
        tried = with_unit(fit.damping_tried, "N s/m")
        step = "" if fit.next is None else f", as {with_unit(fit.next.virtual_damping, 'N s/m', 3)}"
        return f"no wall of more damping than {tried} was tried, and a resonance may destabilize those; try one{step}"
    return "99 % of the devices that the records allow keep this wall stable"


def advise_record(fit: DeviceFit) -> str:
    """Return the command that designs a more informative record."""
    force = max(float(np.abs(motion.force).max()) for motion in fit.motions)
    options = {
        "rate": with_unit(1.0 / round_period(fit), "Hz"),
        "force": with_unit(force, "N", 2),
        "resolution": with_unit(fit.resolution or float(np.max(fit.noise)), "m", 3),
    }
    return "record again with " + " ".join(["zwidth excite", *(f"--{name} '{text}'" for name, text in options.items())])
