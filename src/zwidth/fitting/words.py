"""A fit in words: for people, and as a configuration."""

from __future__ import annotations

import json
import math
from typing import NamedTuple

import numpy as np

from zwidth.fitting.device_fit import SEE_MORE, DeviceFit, RivalDevice
from zwidth.fitting.safe_wall import bears_resonances
from zwidth.parts.paths import spell_estimate
from zwidth.words.formatting import name_wall, plain, with_unit
from zwidth.words.quantities import FIELDS, RECOMMENDED_SHARE
from zwidth.words.rotation import in_own_units, is_rotary, own_unit
from zwidth.words.status import Status

SYMBOLS = {
    "mass": "m",
    "damping": "b",
    "delay": "t_d",
    "friction": "F_c",
    "stiffness_max": "K_max",
}
# SI units of a linear device by the last part of a path: of parameters, and of what a fit has beside them.
_UNITS = {path.rpartition(".")[2]: known.unit.removeprefix("1") for path, known in FIELDS.items()}
_UNITS |= {"stiffness_max": "N/m", "friction": "N", "offset": "N", "force": "N", "position": "m"}
# What a status says of a fit; the doubts say more.
_TROUBLES = {
    Status.NOT_CONVERGED: "the search ended before its aim",
    Status.NO_BOUNDARY: "the walls do not lie on the edge of any device's stable set",
    Status.UNDECIDED: "another device fits as well",
    Status.UNREACHABLE: "the delay ends the range looked in",
}
_TRY_MORE = "try walls of more damping"
NO_WALL = "under a doubt no safe wall is given, and none to set; do what it says, and record again"


def unit_of(name: str) -> str:
    """The SI unit of a value of a fit, "" where it has none."""
    return own_unit(_UNITS.get(name.rpartition(".")[2], ""))


@in_own_units
def list_units(fit: DeviceFit) -> dict[str, str]:
    """Those of a fit, by the name of what has them."""
    return {name: unit_of(name) for name in ("mass", "damping", "stiffness", "force", "position")}


def spell(name: str, value: float, digits: int = 4) -> str:
    """A value of a fit for people."""
    return with_unit(value, _UNITS.get(name.rpartition(".")[2], ""), digits)


class WallChoice(NamedTuple):
    """A wall to set on a fitted device: N/m, N s/m, and why this one."""

    stiffness: float
    virtual_damping: float
    why: str


def choose_wall(fit: DeviceFit, rigid: bool = False) -> WallChoice | None:
    """What the study ``recommend`` sets, or what `DeviceFit.safe_wall` leaves; None without one, as under a doubt."""
    safe = fit.safe_wall(rigid=rigid)
    if safe.status != Status.OK or not safe.stiffness > 0:
        return None
    usual = RECOMMENDED_SHARE * fit.stiffness_max, fit.virtual_damping
    share = f"{100 * RECOMMENDED_SHARE:g} % of K_max"
    if usual[0] <= safe.stiffness and fit.scene.is_stable(*usual) and (rigid or bears_resonances(fit, *usual)):
        return WallChoice(*usual, share)
    if math.isnan(safe.resonance):
        why = "what 99 % of the devices bear, less than usual"
        if usual[0] <= safe.stiffness:
            why = f"{share}, at {'a safer B' if rigid or fit.damping_tried is None else 'the largest B tried'}"
        return WallChoice(min(usual[0], safe.stiffness), safe.virtual_damping, why)
    share = f"{100 * RECOMMENDED_SHARE:g} % of the safe wall"
    return WallChoice(RECOMMENDED_SHARE * safe.stiffness, safe.virtual_damping, share)


@in_own_units
def describe_fit(fit: DeviceFit, source: str) -> list[tuple[str, str]]:
    """Each line's label and its text, what is wrong first."""
    rows = []
    if fit.status != Status.OK:
        rows.append((Status(fit.status).name, f"do not rely on these numbers: {name_trouble(fit)}"))
    rows.append(("fitted to", source))
    count, total = int(np.isfinite(fit.residuals).sum()), fit.residuals.size
    gaps = sum(int(np.count_nonzero(np.diff(motion.time) > 1.5 * fit.period)) for motion in fit.motions)
    if gaps:
        behind = "a gap" if gaps == 1 else f"each of {gaps} gaps"
        rows.append(("of it", f"{count:,} of {total:,} samples: behind {behind} the first are past force alone"))
    elif any(np.isnan(motion.modelled[-1]) for motion in fit.motions):
        rows.append(("of it", f"{count:,} of {total:,} samples, the first ones; more would only narrow the errors"))
    for name in (*fit.numbers, "stiffness_max"):
        symbol = "J" if name == "mass" and is_rotary() else SYMBOLS.get(name) or _name_part(name, len(fit.modes))
        known = math.isfinite(fit.value_of(name))
        rows.append((symbol, f"{_spell(fit, name)} ({_between(fit, name)})" if known else "open"))
    if math.isfinite(fit.virtual_damping):
        B, error = (spell("damping", value) for value in (fit.virtual_damping, fit.virtual_damping_error))
        rows.append(("at B", f"{B} (standard error {error})"))
    for name, label in (("friction", "friction"), ("offset", "constant force")):
        if name in fit.errors:
            known = math.isfinite(fit.errors[name])
            bar = _between(fit, name) if known else "open: this log does not tell friction from a constant force"
            rows.append((label, f"{_spell(fit, name)} ({bar})"))
    if isinstance(fit.noise, tuple):
        rows.append(("noise of K and f", " and ".join(f"{plain(100 * share, 2)} %" for share in fit.noise)))
    else:
        rows.append(("position noise", spell("position", fit.noise, 3)))
        if fit.resolution:
            rows.append(("step of the encoder", spell("position", fit.resolution, 3)))
    rows += [("or as well", spell_rival(rival)) for rival in fit.rivals]
    if fit.lag is not None:
        names = ("time_constant", "delay", "stiffness_max")
        lag, delay, K = (spell(name, value, 3) for name, value in zip(names, fit.lag, strict=True))
        rows.append(("or as well", f"an amplifier's lag of up to {lag}, with t_d = {delay} and K_max = {K}"))
    safe, wall = fit.safe_wall(), choose_wall(fit)
    if safe.status == Status.OK and safe.stiffness > 0:
        borne = "stable on 99 % of the devices that these records allow"
        rows.append(("safe wall", f"{name_wall(*safe[:2])}: {borne}"))
    if fit.is_doubted:
        rows.append(("no wall", NO_WALL))
    if wall is not None:
        rows.append(("set", f"{name_wall(*wall[:2])}: {wall.why}"))
    rows += [("doubt", doubt) for doubt in fit.doubts]
    rows += [("note", note) for note in fit.notes]
    if not fit.is_doubted and (rigid := choose_wall(fit, rigid=True)) not in (None, wall):
        at = "" if math.isnan(safe.resonance) else f" near {with_unit(safe.resonance, 'Hz', 3)}"
        hidden = f"a resonance{at} may make stiffer walls unstable, K_max too, and not show in this log: {SEE_MORE}"
        if fit.damping_tried is not None:
            hidden = f"a resonance may make other walls unstable, K_max too, and not show in these: {_TRY_MORE}"
        alone = "if nothing hides" if fit.is_structured else "if it is rigid"
        rows += [("not seen", hidden), (alone, f"{name_wall(*rigid[:2])}: {rigid.why}")]
    if fit.next is not None:
        step = fit.next
        B, K = spell("damping", step.virtual_damping, 3), spell("stiffness", step.stiffness, 3)
        errors = [spell("stiffness", error, 2) for error in (fit.stiffness_error, step.error_afterwards)]
        text = f"K at B = {B}, near {K} and {with_unit(step.frequency, 'Hz', 3)}"
        if math.isfinite(fit.stiffness_error + step.error_afterwards):
            text += f": K_max's standard error falls from {' to '.join(errors)}"
        rows.append(("measure next", text))
    return rows


def _name_part(name: str, count: int) -> str:
    """The label of a number of the amplifier or of one of so many resonances."""
    _, *place, number = name.split(".")
    if number == "time_constant":
        return "amplifier's lag"
    if number == "frequency":
        return f"resonance {int(place[0]) + 1}" if count > 1 else "resonance"
    return f"  its {number.replace('_', ' ')}"


def name_trouble(fit: DeviceFit) -> str:
    """What the status of a fit says, "" where it is OK."""
    status = Status(fit.status)
    if status == Status.UNDECIDED and not fit.rivals:
        return "what the fit leaves is no noise"
    return "" if status == Status.OK else _TROUBLES.get(status, status.message)


def spell_rival(rival: RivalDevice) -> str:
    """Its numbers in a line."""
    parts = {SYMBOLS[name]: spell(name, getattr(rival, name)) for name in ("mass", "damping", "delay")}
    parts |= {_name_part(name, 1).strip(): spell(name, value) for name, value in (rival.parts or {}).items()}
    parts[SYMBOLS["stiffness_max"]] = spell("stiffness", rival.stiffness_max)
    return ", ".join(f"{symbol} = {text}" for symbol, text in parts.items())


def _spell(fit: DeviceFit, name: str) -> str:
    """A value with so many digits that its interval shows."""
    return spell(name, fit.value_of(name), _count_digits(fit, name))


def _between(fit: DeviceFit, name: str) -> str:
    if not math.isfinite(sum(fit.intervals[name])):
        return "open"
    low, high = (spell(name, end, _count_digits(fit, name)) for end in fit.intervals[name])
    return f"95 % between {low} and {high}"


def _count_digits(fit: DeviceFit, name: str) -> int:
    value, bar = abs(fit.value_of(name)), fit.intervals[name]
    known = value / (bar.high - bar.low) if bar.high > bar.low else 1.0
    return min(max(4, 2 + math.ceil(math.log10(known))), 9) if known > 0 and math.isfinite(known) else 4


def _write(fit: DeviceFit, name: str) -> str:
    """A value to a thousandth of its standard error: further digits differ from machine to machine."""
    value, error = fit.value_of(name), fit.errors[name]
    if not (error > 0 and value):
        return repr(float(f"{value:.12g}"))
    digits = 4 + math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return repr(float(f"{value:.{min(max(digits, 4), 12)}g}"))


def _write_part(fit: DeviceFit, name: str) -> str:
    """A number of a section of the scene."""
    text = f"{name.rpartition('.')[2]}: {_write(fit, name)} {unit_of(name)}".rstrip()
    return f"{text} # fitted, {_between(fit, name)}"


@in_own_units
def write_scene(fit: DeviceFit, source: str) -> list[str]:
    """A configuration for `zwidth run` in which every number says where it is from."""
    lines = [f"# Fitted to {source}: {_between(fit, 'stiffness_max')} for K_max."]
    if fit.status != Status.OK:
        lines.append(f"# {Status(fit.status).name}: do not rely on these numbers: {name_trouble(fit)}.")
    lines += [f"# Doubt: {doubt}" for doubt in fit.doubts]
    lines += [f"# Note: {note}" for note in fit.notes]
    lines += ["version: 1", "name: fitted_device", "scene:"]
    lines += [f"  {_write_part(fit, key)}" for key in fit.numbers[:3]]
    lines.append(f"  period: {fit.period!r} s # as given")
    if fit.actuator is not None:
        lines += ["  actuator:", f"    order: {fit.actuator.order} # fitted"]
        lines += [f"    {_write_part(fit, name)}" for name in fit.numbers if name.startswith("actuator")]
    lines += ["  modes:"] if fit.modes else []
    for k in range(len(fit.modes)):
        parts = [_write_part(fit, name) for name in fit.numbers if name.startswith(f"modes.{k}.")]
        lines += [f"    {'-' if j == 0 else ' '} {part}" for j, part in enumerate(parts)]
    for key, section in spell_estimate(fit.velocity, every=True).items():
        inside = ", ".join(f"{name}: {json.dumps(value).strip(chr(34))}" for name, value in section.items())
        lines.append(f"  {key}: {{{inside}}} # as given")
    if fit.is_doubted:
        lines += [f"studies: [] # {NO_WALL}"]
    else:
        safe = fit.safe_wall()
        if not math.isnan(safe.resonance):
            alone = "these parts alone" if fit.is_structured else "a rigid device"
            lines += [
                f"# As of {alone}. A resonance that the log does not show may make walls unstable,",
                f"# if they are stiffer than {name_wall(*safe[:2])}: {SEE_MORE}.",
            ]
        lines += ["studies:", "  - kind: recommend # what to set on this device", "    name: recommended"]
    if fit.friction and math.isfinite(fit.errors["friction"]):
        friction = f"{_write(fit, 'friction')} {unit_of('friction')}, {_between(fit, 'friction')}"
        lines.append(f"# For studies of kind simulate: coulomb: {friction}.")
    if fit.resolution:
        resolution = float(f"{fit.resolution:.12g}")
        lines.append(f"# For studies of kind simulate: resolution: {resolution!r} {unit_of('position')}.")
    return lines
