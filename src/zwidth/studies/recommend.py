"""The recommend study: the stiffest wall of a device, and one with some margin, in SI units."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from zwidth import figures
from zwidth.config.scenes import AnyDevice, AnyScene, AnyWall, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Fraction
from zwidth.figures.stable_set import tabulate_walls, trace_outlines
from zwidth.figures.table import stack
from zwidth.loops.rigid.response import decay_time
from zwidth.parts.wall import VirtualWall
from zwidth.scenes.assessment import Assessment, assess, describe_islands, name_kind
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import StiffestWall, choose_damping
from zwidth.studies.boundary import outline
from zwidth.studies.outcome import Outcome, Table, add_si_columns
from zwidth.studies.ridge import passive_outlines
from zwidth.studies.step import ResponseStudy
from zwidth.words.formatting import plain, tell_apart, to_json, with_unit
from zwidth.words.quantities import RECOMMENDED_SHARE
from zwidth.words.status import Status

_UNITS = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "virtual_damping": "N s/m",
    "mass": "kg",
    "time": "s",
    "frequency": "Hz",
}
_WALL = ("stiffness", "virtual_damping")
_BARE = ("mass", "damping", "period", "delay", "delta", "d")
_JUDGED = (
    *("alpha", "beta", "virtual_damping_lower", "virtual_damping_upper", "spectral_radius", "passive"),
    *("passivity_margin", "time_constant", "frequency"),
)
_PASSIVE = {True: "yes", False: "no", None: "not known, the sensor is not where the force acts"}
_OTHER_DAMPING = "with the damping of the stiffest wall this share of its stiffness is not stable: B is another one"


@register
class RecommendStudy(ResponseStudy):
    """Maximum stiffness and recommended damping of a device in SI units, and its response."""

    method = "Closed forms of boundary, stiffest wall and margins; with parts, signed crossings."
    from_scene = ("device", "delay_model")

    takes_parts = True

    kind: Literal["recommend"]

    device: PhysicalDevice
    """Device in SI units; the scene's where left out."""

    stiffness_fraction: Fraction = RECOMMENDED_SHARE
    """Stiffness of the recommended wall as a share of the maximum."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        return ((self.device, None),)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        stem, label = "recommendation" if alone else f"{self.name}_recommendation", self.device.label or self.name
        bare, share = self.device.to_scene(), self.stiffness_fraction
        top, verdict, notes = bare.max_stiffness(), None, describe_islands(bare)
        wall = top._replace(stiffness=share * top.stiffness)
        if top.status == Status.OK:
            wall = wall._replace(virtual_damping=np.float64(choose_damping(bare, top, float(wall.stiffness))))
            verdict = assess(replace(bare, wall=VirtualWall(float(wall.stiffness), float(wall.virtual_damping))))
        if verdict is None or not verdict.stable:
            notes.append(f"no stable wall was found at {share:g} of the largest stiffness; choose another share")
        elif wall.virtual_damping != top.virtual_damping:
            notes.append(_OTHER_DAMPING)
        found = _summarize(bare, top, wall, verdict, share)
        if not bare.parts_beyond and verdict is not None:
            # The wall as it was judged: from SI units and back, a last digit may be another.
            columns, note = self.respond(self.device, verdict.alpha, verdict.beta, label=label, physical=True)
            found["recommended"]["settling_time"] = to_json(float(columns["settling_time_s"]))
            table, notes = stack([columns]), [*notes, note] if note else notes
            region = _outline_rigid(self.device)
            draw = partial(figures.draw_recommendation, found, region, table)
        else:
            table = stack(trace_outlines(bare, label=label))
            marked = {"stiffest": top, **({"recommended": wall} if verdict is not None and verdict.stable else {})}
            walls = stack(
                {"label": label, "wall": kind, **tabulate_walls(bare, *one[:2])} for kind, one in marked.items()
            )
            draw = partial(figures.draw_stable_set, table, walls)
        return Outcome(
            table=table,
            figures={"": draw} if table else {},
            documents={
                f"{stem}.json": json.dumps(found, indent=2, allow_nan=False) + "\n",
                f"{stem}.md": _describe(bare, found),
            },
            answer=spell_answer(found, verdict),
            notes=tuple(notes),
        )


def _outline_rigid(device: PhysicalDevice) -> Table:
    edge = outline(device.delta, device.d, "held")
    passive = passive_outlines(np.array([device.delta]), np.array([device.d]), device.own_share)
    return add_si_columns(stack([edge, *passive]), device)


def _summarize(
    scene: Scene, top: StiffestWall, wall: StiffestWall, verdict: Assessment | None, share: float
) -> dict[str, Any]:
    """All numbers of the recommendation in SI units, with the normalized ones beside them; None where not known."""
    judged = {} if verdict is None else verdict.as_dict()
    device = {name: value for name, value in scene.parameters().items() if name not in _WALL}
    numbers = {name: judged.get(name) for name in _JUDGED}
    constant = math.nan if verdict is None or not verdict.stable else verdict.time_constant
    found = {
        "units": _UNITS,
        "device": {**device, "velocity": type(scene.velocity).__name__, "delta": float(scene.delta), "d": scene.d},
        "maximum": {
            "stiffness": float(top.stiffness),
            "virtual_damping": float(top.virtual_damping),
            "alpha": judged.get("alpha_max"),
            "beta": judged.get("beta_at_max"),
            "frequency": float(top.frequency),
            "kind": name_kind(top),
        },
        "recommended": {
            "stiffness_fraction": share,
            "stiffness": float(wall.stiffness),
            "virtual_damping": float(wall.virtual_damping),
            **numbers,
            "stable": verdict is not None and verdict.stable,
            "decay_time": float(decay_time(1.0 / np.float64(constant))),
            # Of the response to a step, where one is drawn.
            "settling_time": None,
        },
    }
    return to_json(found)


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
    lower, upper = tell_apart(*_find_ends(best))
    delay = float(margins.delay_margin)
    apart = (
        f"gain {plain(float(margins.gain_margin))}",
        f"phase {plain(float(margins.phase_margin))} degrees",
        f"delay {'not known' if math.isnan(delay) else with_unit(delay, 's')}",
    )
    passive = _PASSIVE[best["passive"]]
    return wall, f"stable for B from {lower} to {upper} N s/m; margins: {', '.join(apart)}; passive: {passive}"


def _find_ends(best: dict[str, Any]) -> tuple[float, float]:
    """The ends of the stable dampings; NaN where JSON has null."""
    lower, upper = (best[f"virtual_damping_{side}"] for side in ("lower", "upper"))
    return math.nan if lower is None else lower, math.nan if upper is None else upper


def _describe(scene: Scene, found: dict[str, Any]) -> str:
    best, most, device = found["recommended"], found["maximum"], scene.device

    def spell(value: float | None, unit: str = "") -> str:
        return "not known" if value is None else with_unit(value, unit) if unit else plain(value)

    radius = "not known" if best["spectral_radius"] is None else f"{best['spectral_radius']:.6f}"

    def cells(row: dict[str, Any], mark: str = "") -> str:
        units = {"stiffness": "N/m", "virtual_damping": "N s/m"}
        spelled = [f"{mark}{spell(row[name], unit)}{mark}" for name, unit in units.items()]
        return " | ".join([*spelled, spell(row["alpha"]), spell(row["beta"])])

    lower, upper = tell_apart(*_find_ends(best), "N s/m")
    passive, missing = _PASSIVE[best["passive"]], best["passivity_margin"]
    if best["passive"] is False:
        passive += f", that would take {with_unit(-missing, 'N s/m')} more physical damping"
    parts = [f"{name} = {value}" for name, value in found["device"].items() if name not in _BARE]
    settles = f"settles to 2 % of a step of force in about {spell(best['settling_time'], 's')}"
    if best["settling_time"] is None:
        settles = f"has a slowest motion that decays to 2 % in {spell(best['decay_time'], 's')}"
    lines = [
        "# Recommended virtual wall",
        "",
        f"Device: m = {with_unit(device.mass, 'kg')}, b = {with_unit(device.damping, 'N s/m')}, sampled every "
        f"{with_unit(scene.timing.period, 's')}, force delayed by",
        f"{with_unit(scene.timing.delay, 's')} (normalized: delta = {plain(scene.delta)}, d = {plain(scene.d)}).",
        *([f"Its parts, in SI units: {', '.join(parts)}."] if scene.parts_beyond or scene.operator else []),
        "",
        "| | stiffness K | virtual damping B | alpha | beta |",
        "|---|---|---|---|---|",
        f"| stiffest stable wall | {cells(most)} |",
        f"| **recommended, {100 * best['stiffness_fraction']:g} % of it** | {cells(best, '**')} |",
        "",
        "The recommended wall",
        "",
        f"- is {'stable' if best['stable'] else 'NOT stable'}: spectral radius {radius};",
        f"- stays stable at this K for B between {lower} and {upper};",
        f"- {settles};",
        f"- is passive: {passive}.",
        "",
    ]
    if not scene.parts_beyond:
        lines += ["No virtual damping makes a stiffness above the maximum stable.", ""]
    return "\n".join(lines)
