"""The recommendation for a device with a velocity filter, a hand or a coupling: walls and outlines."""

from __future__ import annotations

import json
import math
from functools import partial
from typing import Any

import numpy as np

from zwidth import figures
from zwidth.design.limits import describe_islands
from zwidth.formatting import plain, tell_apart, with_unit
from zwidth.linear.passivity import has_condition
from zwidth.linear.stiffest import StiffestWall, choose_damping
from zwidth.scene import Scene
from zwidth.settling import decay_time
from zwidth.status import Status
from zwidth.studies.outcome import Outcome, stack
from zwidth.studies.stable_set import name_kind, tabulate_walls, trace_outlines

_SIDES = ("lower", "upper")
_PASSIVE = {True: "yes", False: "no", None: "not known, the sensor is not where the force acts"}


def recommend_with_parts(scene: Scene, label: str, fraction: float, stem: str) -> Outcome:
    """The stiffest stable wall and one at a share of its stiffness, with the stable damping around that."""
    top = scene.max_stiffness()
    softer = fraction * top.stiffness
    wall = top._replace(stiffness=softer)
    if top.status == Status.OK:
        wall = wall._replace(virtual_damping=np.float64(choose_damping(scene, top, float(softer))))
    stable = bool(scene.is_stable(wall.stiffness, wall.virtual_damping))
    columns = scene.stable_damping(wall.stiffness).tolist() if stable else []
    ends = next(((low, high) for low, high in columns if low < wall.virtual_damping < high), (math.nan, math.nan))
    found = _summarize(scene, top, wall, fraction, stable, ends)
    outlines = stack(trace_outlines(scene, label=label))
    marked = {"stiffest": top, "recommended": wall} if stable else {"stiffest": top}
    notes = describe_islands(scene)
    if not stable:
        notes.append(f"no stable wall was found at {fraction:g} of the largest stiffness; choose another share")
    elif wall.virtual_damping != top.virtual_damping:
        notes.append(
            "with the damping of the stiffest wall this share of its stiffness is not stable: B is another one"
        )
    return Outcome(
        table=outlines,
        figures={} if not outlines else {"": partial(figures.draw_stable_set, outlines, tabulate_walls(label, marked))},
        documents={
            f"{stem}.json": json.dumps(found, indent=2, allow_nan=False) + "\n",
            f"{stem}.md": _describe(found),
        },
        answer=spell_answer(found, scene.margins(wall.stiffness, wall.virtual_damping)),
        notes=tuple(notes),
    )


def spell_answer(found: dict[str, Any], margins: Any) -> tuple[str, ...]:
    """A recommended wall in two lines, what to set and how far that is from trouble; nothing where there is none."""
    best, most = found["recommended"], found["maximum"]
    if best["stiffness"] is None:
        return ()
    stiffness, largest = (with_unit(row["stiffness"], "N/m") for row in (best, most))
    share = f"{100 * best['stiffness_fraction']:g} % of the stiffest stable wall, {largest}"
    wall = f"K = {stiffness}, B = {with_unit(best['virtual_damping'], 'N s/m')}: {share}"
    if not best["stable"]:
        return wall, "NOT stable; choose another stiffness_fraction"
    low, high = (math.nan if (end := best[f"virtual_damping_{side}"]) is None else end for side in _SIDES)
    lower, upper = tell_apart(low, high)
    delay = float(margins.delay_margin)
    apart = (
        f"gain {plain(float(margins.gain_margin))}",
        f"phase {plain(float(margins.phase_margin))} degrees",
        f"delay {'not known' if math.isnan(delay) else with_unit(delay, 's')}",
    )
    passive = _PASSIVE[best["passive"]]
    return wall, f"stable for B from {lower} to {upper} N s/m; margins: {', '.join(apart)}; passive: {passive}"


def _summarize(
    scene: Scene, top: StiffestWall, wall: StiffestWall, fraction: float, stable: bool, ends: tuple[float, float]
) -> dict[str, Any]:
    """All numbers of the recommendation, in SI units; what is not known is None."""
    radius = float(scene.spectral_radius(wall.stiffness, wall.virtual_damping))
    known = has_condition(scene.device)
    passive = bool(scene.is_passive(wall.stiffness, wall.virtual_damping)) if known else None
    numbers = {name: _known(value) for name, value in scene.parameters().items()}
    device = {name: value for name, value in numbers.items() if name not in ("stiffness", "virtual_damping")}
    return {
        "units": {"stiffness": "N/m", "damping": "N s/m", "virtual_damping": "N s/m", "frequency": "Hz"},
        "device": {**device, "velocity": type(scene.velocity).__name__},
        "maximum": {
            "stiffness": _known(float(top.stiffness)),
            "virtual_damping": _known(float(top.virtual_damping)),
            "frequency": _known(float(top.frequency)),
            "kind": name_kind(top),
        },
        "recommended": {
            "stiffness_fraction": fraction,
            "stiffness": _known(float(wall.stiffness)),
            "virtual_damping": _known(float(wall.virtual_damping)),
            "virtual_damping_lower": _known(ends[0]),
            "virtual_damping_upper": _known(ends[1]),
            "stable": stable,
            "spectral_radius": _known(radius),
            "decay_time": _known(float(decay_time(-np.log(radius))) * scene.timing.period),
            "passive": passive,
        },
    }


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _describe(found: dict[str, Any]) -> str:
    """The recommendation for a reader."""
    best, most = found["recommended"], found["maximum"]

    def spell(value: float | None, unit: str) -> str:
        return "not known" if value is None else with_unit(value, unit)

    units = {"stiffness": "N/m", "virtual_damping": "N s/m"}
    top, wall = ([spell(row[name], unit) for name, unit in units.items()] for row in (most, best))
    low, high = (best[f"virtual_damping_{side}"] for side in _SIDES)
    if low is None or high is None:
        lower, upper = spell(low, "N s/m"), spell(high, "N s/m")
    else:
        lower, upper = tell_apart(low, high, "N s/m")
    lines = [
        "# Recommended virtual wall",
        "",
        f"Device: {', '.join(f'{name} = {value}' for name, value in found['device'].items())} (SI units).",
        "",
        "| | stiffness K | virtual damping B |",
        "|---|---|---|",
        f"| stiffest stable wall | {top[0]} | {top[1]} |",
        f"| **recommended, {100 * best['stiffness_fraction']:g} % of it** | **{wall[0]}** | **{wall[1]}** |",
        "",
        "The recommended wall",
        "",
        f"- is {'stable' if best['stable'] else 'NOT stable'};",
        f"- stays stable at this K for B between {lower} and {upper};",
        f"- has the spectral radius {spell(best['spectral_radius'], '')}, which decays to 2 % in "
        f"{spell(best['decay_time'], 's')};",
        f"- is passive: {_PASSIVE[best['passive']]}.",
        "",
    ]
    return "\n".join(lines)
