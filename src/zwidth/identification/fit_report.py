"""Format a fit as text: a summary and details for the terminal, and a configuration of the fitted scene in YAML.

Summary and details are lists of pairs (label, text), one pair per line. Values are printed with their units and with
as many digits as their confidence intervals require. A *value of a fit* is a parameter of the device, given by its
path, or another number of the fit, given by its name.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from zwidth.analysis.recommendation import Recommendation
from zwidth.core.status import Status
from zwidth.identification.device_fit import AlternativeDevice, DeviceFit
from zwidth.identification.safe_scene import (
    RECORD_AGAIN,
    advise_record,
    describe_status,
    limit_walls,
    round_parameter,
    round_period,
)
from zwidth.model.parameter_paths import spell_estimate
from zwidth.units.formatting import plain, round_conservatively, with_unit
from zwidth.units.quantities import FIELDS
from zwidth.units.unit_system import UnitSystem

# Range of RMS residuals that quantization by the encoder explains, relative to its quantization noise.
NEAR_ROUNDING = (0.5, 1.1)

STIFFER = 1.005  # ratio of the stiffnesses of two walls above which the second wall is printed in addition
_SYMBOLS = {"mass": "m", "damping": "b", "delay": "t_d", "stiffness_max": "K_max"}
# SI units of the values of a fit for a linear device. The keys are names, or the last parts of the paths of parameters.
_UNITS = {path.rpartition(".")[2]: field.unit.removeprefix("1") for path, field in FIELDS.items()}
_UNITS |= {"stiffness_max": "N/m", "friction": "N", "offset": "N", "force": "N", "position": "m"}


def unit_of(name: str, system: UnitSystem) -> str:
    """Return the SI unit of a value of a fit by its name or path; "" if the value has no unit."""
    return system[_UNITS.get(name.rpartition(".")[2], "")]


def list_units(fit: DeviceFit) -> dict[str, str]:
    """Return a dictionary of the SI units of mass, damping, stiffness, force and position of a fit, by name."""
    return {name: unit_of(name, fit.unit_system) for name in ("mass", "damping", "stiffness", "force", "position")}


def symbol_of(name: str, system: UnitSystem) -> str:
    """Return the printed symbol of a fitted parameter, such as "m" for the mass (for a rotary device "J")."""
    return "J" if name == "mass" and system.rotary else _SYMBOLS[name]


def format_value(name: str, value: float, system: UnitSystem, digits: int = 4) -> str:
    """Format a value of a fit with its unit.

    Args:
        name: name or path of the value.
        value: the value in SI units.
        system: unit system of the fit.
        digits: number of significant digits.
    """
    return with_unit(value, unit_of(name, system), digits)


def summarize_fit(fit: DeviceFit, checks: Iterable[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Summarize a fit as pairs (label, text): the recommended wall, its reason and margins, the device, the warnings.

    Args:
        fit: the fit.
        checks: further pairs about the recommended wall, such as the results of a simulation.
    """
    recommended = fit.recommended
    rows = [("NO WALL", recommended.reason)]
    if fit.is_unreliable:
        rows = [("NO WALL", RECORD_AGAIN)]
    elif recommended.status == Status.OK:
        limit = recommended.scene.safe_limit
        cause = limit.reason.partition("; ")[0] if limit is not None and recommended.is_at_safe_limit else ""
        reason = ": ".join(filter(None, (recommended.spell_requirement(), cause)))
        rows = [("SET", recommended.spell_wall()), ("", reason)]
    rows += [("", ""), *_describe_device(fit)]
    determined = math.isfinite(fit.stiffness_max)
    rows.append(("K_max", _format_estimate(fit, "stiffness_max") if determined else "not determined: see the warnings"))
    rows.append(("fit", _describe_residuals(fit)))
    if recommended.status == Status.OK:
        rows.append(("margins", f"{recommended.spell_margins()}; passive: {recommended.spell_passive()}"))
        rows += [*checks, *(("CAUTION", caution) for caution in recommended.cautions)]
    # Add a warning about the status only if it is NOT_CONVERGED, because the fit itself has warnings about every other
    # status.
    unconverged = [f"NOT_CONVERGED: {describe_status(fit)}"] if fit.status == Status.NOT_CONVERGED else []
    rows += [("WARNING", text) for text in (*unconverged, *fit.warnings)] or [("warnings", "none")]
    rows += [("note", note) for note in fit.notes]
    if fit.next is not None:
        rows.append(("next", _describe_next(fit)))
    elif fit.motions and recommended.is_at_safe_limit and (rigid := _assume_rigid(fit)) is not None:
        stiffest = format_value("stiffness", rigid.stiffness, fit.unit_system)
        rows.append(("next", f"for a stiffer wall (up to {stiffest} without hidden resonances) {advise_record(fit)}"))
    return rows


def _assume_rigid(fit: DeviceFit) -> Recommendation | None:
    """Return the wall recommended without undetected resonances; None if it is not stiffer than the recommended one."""
    recommended = replace(fit.scene, safe_limit=limit_walls(fit, rigid=True)).recommend()
    return recommended if recommended.stiffness > STIFFER * fit.recommended.stiffness else None


def _describe_device(fit: DeviceFit) -> list[tuple[str, str]]:
    """Return pairs (label, text) that list the fitted parameters of the device with their 95 % confidence intervals."""
    texts = [f"{symbol_of(name, fit.unit_system)} = {_format_estimate(fit, name)}" for name in fit.parameter_names[:2]]
    texts.append(f"delay {_format_estimate(fit, 'delay')}")
    if "friction" in fit.errors:
        certain = math.isfinite(fit.errors["friction"])
        friction = f"friction {_format_estimate(fit, 'friction')}" if fit.friction else "no friction"
        texts.append(friction if certain else "friction not determined")
    rows = [("device", ", ".join(texts))]
    for name in fit.parameter_names[3:]:
        *owner, last = name.split(".")
        label = "actuator" if owner[0] == "actuator" else "resonance"
        text = f"{last.replace('_', ' ')} {_format_estimate(fit, name)}"
        # Join the parameters of the actuator, or of one resonance, into one line. The frequency is the first parameter
        # of a resonance and therefore starts a new line.
        new = rows[-1][0] != label or last == "frequency"
        rows = [*rows, (label, text)] if new else [*rows[:-1], (label, f"{rows[-1][1]}, {text}")]
    return rows


def _format_estimate(fit: DeviceFit, name: str) -> str:
    """Format a fitted value with its unit and its 95 % confidence interval."""
    if not math.isfinite(fit.value_of(name)):
        return "not determined"
    interval = fit.intervals[name]
    if not math.isfinite(sum(interval)):
        return f"{_format(fit, name)} (uncertain)"
    value = _format(fit, name)
    low, high = (format_value(name, end, fit.unit_system, _count_digits(fit, name)) for end in interval)
    unit = f" {high.partition(' ')[2]}"
    if low.endswith(unit):
        low, high = low.removesuffix(unit), high.removesuffix(unit) if value.endswith(unit) else high
    return f"{value} (95 %: {low} to {high})"


def _describe_residuals(fit: DeviceFit) -> str:
    """Return a text that states the size of the residuals, compared with the quantization noise of the encoder."""
    if isinstance(fit.noise, tuple):
        return f"noise of K and f {' and '.join(f'{plain(100 * share, 2)} %' for share in fit.noise)}"
    size = f"residuals of {format_value('position', fit.noise, fit.unit_system, 3)}"
    if not fit.resolution:
        return size
    expected = NEAR_ROUNDING[0] < fit.noise / fit.resolution * math.sqrt(12.0) < NEAR_ROUNDING[1]
    step = format_value("position", fit.resolution, fit.unit_system, 3)
    return f"{size}, {'as expected for an encoder step of' if expected else 'with an encoder step of'} {step}"


def _describe_next(fit: DeviceFit) -> str:
    """Return a text with the wall to measure next, and the standard error of K_max expected after its measurement."""
    step, units = fit.next, fit.unit_system
    assert step is not None, "only fits to walls at the onset of instability propose a next experiment"
    B, K = format_value("damping", step.virtual_damping, units, 3), format_value("stiffness", step.stiffness, units, 3)
    text = f"raise K at B = {B}, to about {K} and {with_unit(step.frequency, 'Hz', 3)}"
    if math.isfinite(fit.stiffness_error + step.stiffness_error):
        errors = [format_value("stiffness", error, units, 2) for error in (fit.stiffness_error, step.stiffness_error)]
        text += f": decreases the standard error of K_max from {' to '.join(errors)}"
    return text


def detail_fit(fit: DeviceFit, source: str) -> list[tuple[str, str]]:
    """Return pairs (label, text) with the details of a fit that its summary omits.

    Args:
        fit: the fit.
        source: name of the log, or number of walls, for the first line.
    """
    rows, units = [("data", source)], fit.unit_system
    count, total = int(np.isfinite(fit.residuals).sum()), fit.residuals.size
    gaps = sum(int(np.count_nonzero(np.diff(motion.time) > 1.5 * fit.period)) for motion in fit.motions)
    if gaps:
        where = "a gap" if gaps == 1 else f"each of {gaps} gaps"
        rows.append(
            (
                "samples",
                f"{count:,} of {total:,} used: those after {where} depend on forces that were not logged",
            )
        )
    elif any(np.isnan(motion.modeled[-1]) for motion in fit.motions):
        rows.append(("samples", f"{count:,} of {total:,} used, from the start; more would only reduce the errors"))
    if math.isfinite(fit.virtual_damping):
        B, error = (format_value("damping", value, units) for value in (fit.virtual_damping, fit.virtual_damping_error))
        rows.append(("B at K_max", f"{B} (standard error {error})"))
    for name in ("friction", "offset"):
        if name in fit.errors and not math.isfinite(fit.errors[name]):
            rows.append(
                (name, f"{_format(fit, name)}, uncertain: the log does not distinguish friction from a constant force")
            )
        elif name == "offset" and name in fit.errors:
            rows.append((name, f"{_format_estimate(fit, name)}, a constant force"))
    rows += [("alternative", format_alternative(each, units)) for each in fit.alternatives]
    if fit.lag is not None:
        names = ("time_constant", "delay", "stiffness_max")
        lag, delay, K = (format_value(name, value, units, 3) for name, value in zip(names, fit.lag, strict=True))
        rows.append(
            ("alternative", f"an actuator lag of up to {lag}; at this lag the fitted delay is {delay} and K_max is {K}")
        )
    if fit.is_unreliable or fit.scene.safe_limit is None:
        return rows
    rows.append(("safe limit", fit.scene.safe_limit.describe(units)))
    if (wall := _assume_rigid(fit)) is not None:
        condition = "has no further resonances" if fit.is_structured else "is rigid"
        rows.append(("stiffer wall", f"{wall.spell_wall()} if the device {condition}; {wall.spell_requirement()}"))
    return rows


def format_alternative(alternative: AlternativeDevice, system: UnitSystem) -> str:
    """Format the parameters and K_max of another device that fits equally well, in one line."""
    names = ("mass", "damping", "delay")
    parts = {symbol_of(name, system): format_value(name, getattr(alternative, name), system) for name in names}
    parts[symbol_of("stiffness_max", system)] = format_value("stiffness", alternative.stiffness_max, system)
    return ", ".join(f"{symbol} = {text}" for symbol, text in parts.items())


def _format(fit: DeviceFit, name: str) -> str:
    """Format a value of a fit with its unit, and with as many digits as its confidence interval requires."""
    value, digits = fit.value_of(name), _count_digits(fit, name)
    # Round K_max down, as all commands do, because it is a limit.
    value = round_conservatively(value, "below", digits) if name == "stiffness_max" else value
    return format_value(name, value, fit.unit_system, digits)


def _format_interval(fit: DeviceFit, name: str) -> str:
    """Format the 95 % confidence interval of a value of a fit, with units."""
    if not math.isfinite(sum(fit.intervals[name])):
        return "not determined"
    low, high = (format_value(name, end, fit.unit_system, _count_digits(fit, name)) for end in fit.intervals[name])
    return f"95 % between {low} and {high}"


def _count_digits(fit: DeviceFit, name: str) -> int:
    """Return the number of significant digits with which a value is printed.

    It is two more than the confidence interval determines, but at least 4 and at most 9.
    """
    value, bar = abs(fit.value_of(name)), fit.intervals[name]
    ratio = value / (bar.high - bar.low) if bar.high > bar.low else 1.0
    return min(max(4, 2 + math.ceil(math.log10(ratio))), 9) if ratio > 0 and math.isfinite(ratio) else 4


def _write_number(fit: DeviceFit, name: str) -> str:
    """Format a parameter of the fitted scene as a line of YAML, such as "mass: 0.1 kg"."""
    return f"{name.rpartition('.')[2]}: {round_parameter(fit, name)!r} {unit_of(name, fit.unit_system)}".rstrip()


def _write_part(fit: DeviceFit, name: str) -> str:
    """Format a parameter of the fitted scene as a line of YAML, with its 95 % confidence interval in a comment."""
    return f"{_write_number(fit, name)} # fitted, {_format_interval(fit, name)}"


def _write_limit(fit: DeviceFit) -> list[str]:
    """Format the safe limit of the fitted scene as lines of YAML."""
    limit = fit.scene.safe_limit
    assert limit is not None, "the scene of a fit has a safe limit"
    lines = [
        "  # Valid for this loop only: measure again after changes to the device, the timing or the velocity estimate.",
        "  safe_limit:",
        f"    stiffness: {float(limit.stiffness)!r} {unit_of('stiffness', fit.unit_system)}",
        f"    virtual_damping: {float(limit.virtual_damping)!r} {unit_of('damping', fit.unit_system)}",
        f"    reason: {json.dumps(limit.reason, ensure_ascii=False)}",
    ]
    reserve = f"    damping_reserve: {limit.damping_reserve!r} {unit_of('damping', fit.unit_system)}"
    lines += [f"{reserve} # not counted for passivity: b minus its lower end"] if limit.damping_reserve else []
    warnings = [f"      - {json.dumps(text, ensure_ascii=False)}" for text in limit.warnings]
    return lines + (["    warnings:", *warnings] if warnings else [])


def write_scene(
    fit: DeviceFit, source: str, *, period_given: bool = False, max_force: float | None = None
) -> list[str]:
    """Format the fitted scene with its safe limit as a configuration for `zwidth run`, a list of lines of YAML.

    Args:
        fit: the fit.
        source: name of the log, or number of walls, for the first comment.
        period_given: True if the user specified the period; otherwise it is derived from the times of the log.
        max_force: largest force of the motor, in N; None if unknown.
    """
    units = fit.unit_system
    origin = "as given" if period_given or not fit.motions else "from the times of the log"
    lines = [
        f"# Fitted to {source}: {_format_interval(fit, 'stiffness_max')} for K_max.",
        *(f"# Note: {note}" for note in fit.notes),
        *("version: 1", f"name: {_name_file(source)}", "scene:"),
        *(f"  {_write_part(fit, key)}" for key in fit.parameter_names[:3]),
        f"  period: {round_period(fit)!r} s # {origin}",
    ]
    if fit.actuator is not None:
        lines += ["  actuator:", f"    order: {fit.actuator.order} # fitted"]
        lines += [f"    {_write_part(fit, name)}" for name in fit.parameter_names if name.startswith("actuator")]
    lines += ["  modes:"] if fit.modes else []
    for k in range(len(fit.modes)):
        parts = [_write_part(fit, name) for name in fit.parameter_names if name.startswith(f"modes.{k}.")]
        lines += [f"    {'-' if j == 0 else ' '} {part}" for j, part in enumerate(parts)]
    for key, section in spell_estimate(fit.velocity, every=True).items():
        inside = ", ".join(f"{name}: {json.dumps(value).strip(chr(34))}" for name, value in section.items())
        lines.append(f"  {key}: {{{inside}}} # as given")
    hardware = list_hardware(fit)
    if "coulomb" in hardware:
        lines.append(f"  coulomb: {hardware['coulomb']!r} {units['N']} # fitted, {_format_interval(fit, 'friction')}")
    if "resolution" in hardware:
        lines.append(f"  resolution: {hardware['resolution']!r} {units['m']} # encoder step of the log")
    lines += [] if max_force is None else [f"  max_force: {max_force!r} {units['N']} # as given"]
    lines += _write_limit(fit)
    return [*lines, "studies:", "  - kind: recommend # the recommended wall for this device", "    name: recommended"]


def list_hardware(fit: DeviceFit) -> dict[str, float]:
    """Return the fitted friction and encoder step, if they are determined, as arguments of `zwidth.diagnose`."""
    friction = math.isfinite(fit.errors.get("friction", math.nan)) and round_parameter(fit, "friction")
    values = {"coulomb": friction, "resolution": float(f"{fit.resolution:.12g}")}
    return {name: value for name, value in values.items() if value}


def _name_file(source: str) -> str:
    """Return the name of the configuration of a fit, derived from the name of the first log or the number of walls."""
    title = Path(source.partition(" and ")[0]).name.partition(".")[0].lower()
    return f"fitted_{re.sub('[^a-z0-9_-]+', '_', title)}"[:64]
