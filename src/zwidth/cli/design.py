"""Command `zwidth design`: the parameter that a given stiffness requires, and the effect of tolerances.

K_max is the largest stiffness of a stable wall on the device of a scene. The functions return a pair: results as a dict
for JSON, and printed lines.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import click
import numpy as np

from zwidth.analysis.batch import stiffest_walls
from zwidth.app.printing import LABEL, format_line, format_notes, format_parts, print_result
from zwidth.app.verdict import spell_device
from zwidth.cli.commands import EXIT_FAILED, cli
from zwidth.cli.help import OF_SCENE, show_example
from zwidth.cli.options import (
    Parsed,
    find_omitted,
    json_option,
    read_pairs,
    scene_options,
)
from zwidth.cli.parts import name_option
from zwidth.core.status import Status
from zwidth.units.formatting import (
    count_digits,
    format_stiffness,
    format_sufficient,
    format_wall,
    plain,
    round_conservatively,
    with_unit,
)
from zwidth.units.parsing import read_share
from zwidth.units.quantities import PARAMETERS

# Path of a parameter in a scene, by the value of the option --find that selects the parameter.
_FINDS = {name: name for name in ("damping", "mass", "period", "rate", "delay")}
_FINDS |= {"cutoff": "velocity.cutoff", "virtual_damping": "virtual_damping"}
_TRIED = 41  # number of values of a parameter at which K_max is computed, to find its largest value in a range
# Parameters whose tolerances `zwidth.analysis.robust` supports in the search for a wall that is stable on all devices.
_BOX = ("mass", "damping", "period", "delay")


def _read_tolerance(text: str) -> tuple[str, float]:
    """Parse a text "NAME=SHARE"; return the path of the parameter and its tolerance relative to its value."""
    name, _, share = text.partition("=")
    return name.strip(), read_share(share)


_TOLERANCE = Parsed("NAME=SHARE", _read_tolerance, "write NAME=SHARE, such as mass=10% or velocity.cutoff=0.05")


@cli.command(**show_example("design --stiffness '30 kN/m' --find rate", OF_SCENE))
@scene_options(wall=True)
@click.option("--find", type=click.Choice(tuple(_FINDS)), help="Parameter to compute for --stiffness.")
@click.option(
    "--tolerance",
    "tolerances",
    type=_TOLERANCE,
    multiple=True,
    callback=read_pairs,
    help="Relative tolerance of a parameter, such as mass=10%; may be repeated.",
)
@click.option(
    "--distribution",
    type=click.Choice(("uniform", "normal")),
    default="uniform",
    show_default=True,
    help="Meaning of a tolerance: largest deviation (uniform), or standard deviation (normal).",
)
@click.option("--samples", type=int, help="Number of random devices.  [default: 10,000, or 200 with additional parts]")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the random devices.")
@json_option
def design(scene: Any, find: str | None, tolerances: dict[str, float], as_json: bool, **drawn: Any) -> None:
    """Compute the parameter that a given stiffness requires, or the effect of tolerances.

    With --find, the command computes the value of one parameter at which K_max reaches --stiffness. With --find
    virtual_damping, it computes the virtual damping with which a wall of --stiffness settles fastest. With --tolerance,
    the command computes the percentage of random devices on which the wall (--stiffness, --virtual-damping) is stable,
    and the stiffness up to which 99 % of the devices are stable. For uniform tolerances of a rigid device, it also
    searches for the stiffest wall that is stable on all devices. Parameters that are not given as options are taken
    from SCENE.yaml (or from the folder of a run).
    """
    if find is None and not tolerances:
        raise click.UsageError("give --find or --tolerance, or both")
    shares, uniform = tolerances, drawn["distribution"] == "uniform"
    searchable = shares and uniform and not scene.nonrigid_parts and all(name in _BOX for name in shares)
    # Exclude a tolerance of the period if the delay is given in periods, because the delay then varies with the period,
    # but the search assumes independent intervals of both.
    searchable = searchable and not ("period" in shares and scene.timing.in_periods)
    parts = {
        "required": _require(scene, find) if find is not None else None,
        "tolerances": _tolerate(scene, shares, **drawn) if shares else None,
        "every_device": _search_box(scene, shares) if searchable else None,
    }
    sections = {name: part for name, part in parts.items() if part is not None}
    lines = [line for _, section_lines in sections.values() for line in section_lines]
    result = {name: values for name, (values, _) in sections.items()}
    print_result(result, lines, as_json, LABEL)
    if result.get("required", {}).get("status", "OK") != "OK":
        raise SystemExit(EXIT_FAILED)


def _require(scene: Any, find: str) -> tuple[dict[str, Any], list[str]]:
    """Return the value of a parameter at which K_max reaches the given stiffness, as a dict and as printed lines."""
    path = _FINDS[find]
    if path == "virtual_damping":
        return _choose_damping(scene)
    units = scene.unit_system
    unit = units[PARAMETERS[path].unit]
    values = {**scene.parameters(), "rate": 1.0 / scene.timing.period}
    if path not in values:
        raise click.UsageError(
            f"--find {find}: not a parameter of this scene; give {name_option(path)} as a starting value"
        )
    present = values[path]
    # If the current value is 0, search a range that suits every device, because the default range is proportional to
    # the current value.
    period = scene.timing.period
    within = None if present else {"damping": (1e-6, 1e4), "delay": (1e-3 * period, 500 * period)}[path]
    wanted = float(scene.wall.stiffness)
    needed = scene.required(path, wanted, within=within)
    if path == "delay" and needed.status == Status.UNREACHABLE and within is None:
        # Extend the default range to shorter delays, because a large stiffness may require a very short delay.
        needed = scene.required(path, wanted, within=(1e-4 * present, needed.range[1]))
    result = {"parameter": path, "value": needed.value, "unit": unit, "sufficient_side": needed.sufficient_side}
    result["status"] = Status(needed.status).name
    result |= {"crossings": [[c.value, c.sufficient_side] for c in needed.crossings], "range": list(needed.range)}
    if path in ("period", "rate"):
        result["rate"] = needed.value if path == "rate" else 1.0 / needed.value
    low, high = (with_unit(end, unit) for end in needed.range)
    goal = f"for K_max = {format_stiffness(wanted, units)}"
    kept = f" (the delay stays {scene.timing.delay_text})" if path in ("period", "rate") and scene.timing.delay else ""
    if needed.status == Status.UNREACHABLE:
        best = _find_best(scene, path, needed.range)
        result["best"] = best
        reached = f"the largest is {format_stiffness(best['stiffness'], units)} at {with_unit(best['value'], unit)}"
        text = f"none {goal} from {low} to {high}{kept}; {reached}" if best["stiffness"] else f"none {goal}"
    elif needed.status != Status.OK:
        text = f"not found from {low} to {high}{kept}: {Status(needed.status).message}"
    elif needed.sufficient_side == "everywhere":
        text = f"any from {low} to {high} {goal}{kept}"
    else:
        values = [crossing.value for crossing in needed.crossings]
        text = f"{format_sufficient(needed.value, needed.sufficient_side, values, unit)}"
        # Count the values at which K_max equals the goal and that the text does not contain yet. It contains one or, if
        # it states an interval, two of them.
        others = len(values) - 1 - (" to " in text)
        text += f" {goal}{kept}; now {with_unit(present, unit)}"
        text += f"; {others} more crossing{'s' if others > 1 else ''} in the range, see --json" if others else ""
    return result, [
        format_line(path, text),
        format_line("device", spell_device(scene, find_omitted())),
        *format_parts(scene),
    ]


def _find_best(scene: Any, path: str, ends: tuple[float, float]) -> dict[str, float]:
    """Return the value in a range at which K_max is largest, and this K_max; both 0 if no wall is stable."""
    values = np.array([*([0.0] if path == "delay" else []), *np.geomspace(*ends, _TRIED)])
    stiffness = np.nan_to_num(stiffest_walls(scene, {path: values}).stiffness)
    k = int(np.argmax(stiffness))
    return {"value": float(values[k]) if stiffness[k] else 0.0, "stiffness": float(stiffness[k])}


def _choose_damping(scene: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the B with which a wall of the given stiffness settles fastest, as a dict and as printed lines."""
    wanted, best, units = float(scene.wall.stiffness), scene.best_damping(), scene.unit_system
    result = {"parameter": "virtual_damping", "value": best.virtual_damping, "unit": units["N s/m"]}
    result |= {"spectral_radius": best.spectral_radius, "modulus_margin": best.modulus_margin}
    result["status"] = Status(best.status).name
    text = f"none: no B is stable at K = {with_unit(wanted, units['N/m'])}"
    if best.status == Status.OK:
        B, radius = best.virtual_damping, plain(best.spectral_radius)
        digits = count_digits(lambda digits: scene.is_stable(wanted, float(f"{B:.{digits}g}")))
        text = f"{with_unit(B, units['N s/m'], digits)} settles fastest: spectral radius {radius}"
        text += f", modulus margin {plain(best.modulus_margin)}"
    return result, [
        format_line("B", text),
        format_line("device", spell_device(scene, find_omitted())),
        *format_parts(scene),
    ]


def _tolerate(
    scene: Any, shares: dict[str, float], distribution: Any, samples: int | None, seed: int
) -> tuple[dict[str, Any], list[str]]:
    """Return the share of random devices on which the wall is stable, as a dict and as printed lines."""
    from zwidth.analysis.assessment import describe_islands
    from zwidth.analysis.tolerances import Tolerance, simulate_tolerances

    count = samples if samples is not None else scene.loop.draws
    named = {name: Tolerance(share, distribution) for name, share in shares.items()}
    simulation = simulate_tolerances(scene, named, samples=count, seed=seed)
    result = {name: value for name, value in asdict(simulation).items() if name not in ("drawn", "labels")}
    result |= {"seed": seed, "distribution": distribution, "shares": shares}
    percent = f"{100 * simulation.reliability:g} %"
    unit = scene.unit_system["N/m"]
    stiffness, stiffness_best = (
        with_unit(round_conservatively(end, "below"), unit) for end in (simulation.stiffness, simulation.stiffness_max)
    )
    # Round the share and its lower bound down, its upper bound up: a printed share of 100 % must mean all devices.
    ends = (
        (simulation.stable, "below"),
        (simulation.stable_low, "below"),
        (simulation.stable_high, "above"),
    )
    stable, low, high = (plain(round_conservatively(100 * each, side)) for each, side in ends)
    share = f"{stable} % of {simulation.samples} devices drawn"
    interval = f"{low} to {high} % of all, with 95 % confidence"
    lines = [
        format_line("wall", format_wall(scene.wall.stiffness, scene.wall.virtual_damping, scene.unit_system)),
        format_line("stable", f"{share} ({interval})"),
        format_line("stiffness", f"{percent} of them are stable for K up to {stiffness} at this B"),
    ]
    if simulation.stiffness_max == simulation.stiffness_max:
        lines.append(format_line("", f"or up to {stiffness_best}, each device with its best B"))
    return result, [*lines, *format_notes(describe_islands(scene))]


def _search_box(scene: Any, shares: dict[str, float]) -> tuple[dict[str, Any], list[str]]:
    """Return the stiffest wall that is stable for all tolerances, as a dict and as printed lines."""
    from zwidth.analysis.robust import DIGITS, Interval, robust_max_stiffness, robust_wall

    nominal = (scene.mass, scene.damping, scene.timing.period, scene.timing.delay)
    box: dict[str, Any] = dict(zip(_BOX, nominal, strict=True))
    device_values = (scene.device.mass, scene.device.damping, 0.0, 0.0)
    for (name, value), device in zip(list(box.items()), device_values, strict=True):
        if name in shares:
            # Apply the tolerance to the value of the device only, because mass and damping of a rigid hand have no
            # tolerance.
            reach = shares[name] * (device or value)
            box[name] = Interval(value - reach, value + reach)
    wall, best = robust_wall(**box), robust_max_stiffness(**box)
    result = {
        "stiffness": float(wall.stiffness),
        "virtual_damping": float(wall.virtual_damping),
        "stiffness_max": float(best.stiffness),
    }
    # Round the stiffness down, because softer walls of the same damping are stable, too.
    units, names = scene.unit_system, ("stiffness", "stiffness_max")
    stiffness, stiffness_best = (with_unit(round_conservatively(result[name], "below"), units["N/m"]) for name in names)
    damping = with_unit(result["virtual_damping"], units["N s/m"], DIGITS)
    text = f"all devices within the tolerances are stable for K up to {stiffness} at B = {damping} (by search), "
    text += f"or up to {stiffness_best}, each device with its best B"
    return result, [format_line("stiffness", text)]
