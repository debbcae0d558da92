"""The recommend study: the wall to set on a device in SI units, what limits it, and its response."""

from __future__ import annotations

import json
from functools import partial
from math import isnan
from typing import Annotated, Any, Literal

from zwidth import figures
from zwidth.config.scenes import AnyDevice, AnyScene, AnyWall, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Fraction, Quantity
from zwidth.figures.stable_set import trace_outlines
from zwidth.figures.style import WIDTH, house_style, new_figure
from zwidth.figures.table import Table, stack
from zwidth.parts.device import Device
from zwidth.scenes.recommendation import RANGES, Recommendation
from zwidth.studies.outcome import Outcome
from zwidth.studies.step import ResponseStudy
from zwidth.words.formatting import plain, tell_apart, to_json, with_unit

_BARE = ("mass", "damping", "period", "delay", "delta", "d")


@register
class RecommendStudy(ResponseStudy):
    """The wall to set on a device in SI units, at wanted margins, and its response."""

    method = "Closed forms of boundary, stiffest wall and margins; with parts, signed crossings."
    from_scene = ("device", "delay_model")

    takes_parts = True

    kind: Literal["recommend"]

    device: PhysicalDevice
    """Device in SI units; the scene's where left out."""

    stiffness_fraction: Fraction | None = None
    """Stiffness of the recommended wall as a share of the maximum, at most; 0.75 where nothing else is asked for."""

    gain_margin: Annotated[float, Quantity(allowed=RANGES["gain_margin"])] | None = None
    """The factor on stiffness and damping together that the wall must bear, at least."""

    phase_margin: Annotated[float, Quantity(allowed=RANGES["phase_margin"])] | None = None
    """The phase margin that the wall must have, at least, in degrees."""

    passive: bool = False
    """Whether the wall must be passive."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        return ((self.device, None),)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        stem, label = "recommendation" if alone else f"{self.name}_recommendation", self.device.label or self.name
        bare = self.device.to_scene()
        found = bare.recommend(
            stiffness_fraction=self.stiffness_fraction,
            gain_margin=self.gain_margin,
            phase_margin=self.phase_margin,
            passive=self.passive,
        )
        told, notes, response = found.as_dict(), list(found.notes), None
        if not bare.parts_beyond and found.verdict is not None:
            # The wall as it was judged: from SI units and back, a last digit may be another.
            wall = found.verdict.alpha, found.verdict.beta
            columns, note = self.respond(self.device, *wall, label=label, physical=True)
            told["recommended"]["settling_time"] = to_json(float(columns["settling_time_s"]))
            response, notes = stack([columns]), [*notes, note] if note else notes
        table = response or stack(trace_outlines(bare, label=label))
        return Outcome(
            table=table,
            figures={"": partial(draw, found, response)} if table else {},
            documents={
                f"{stem}.json": json.dumps(told, indent=2, allow_nan=False) + "\n",
                f"{stem}.md": _describe(found, told),
            },
            answer=found.lines(),
            notes=tuple(notes),
        )


@house_style()
def draw(found: Recommendation, response: Table | None = None) -> Any:
    """Draw a recommendation into a figure that pyplot does not know, and return its Axes."""
    # Of a measured response no motion is known.
    columns = 1 if found.verdict is None or isnan(found.verdict.frequency) else 2
    _, axes = new_figure(WIDTH if columns == 2 else 5.6, 3.5, 1, columns)
    return figures.plot.recommendation(found, axes, response=response)


def _describe(recommendation: Recommendation, found: dict[str, Any]) -> str:
    """A recommendation as Markdown, from its numbers."""
    scene, verdict = recommendation.scene, recommendation.verdict
    best, most = found["recommended"], found["maximum"]

    def spell(value: float | None, unit: str = "") -> str:
        return "not known" if value is None else with_unit(value, unit) if unit else plain(value)

    def cells(row: dict[str, Any], mark: str = "") -> str:
        units = {"stiffness": "N/m", "virtual_damping": "N s/m"}
        spelled = [f"{mark}{spell(row[name], unit)}{mark}" for name, unit in units.items()]
        return " | ".join([*spelled, spell(row["alpha"]), spell(row["beta"])])

    parts = [f"{name} = {value}" for name, value in found["device"].items() if name not in _BARE]
    by_mass = isinstance(scene.device, Device)
    normalized = f" (normalized: delta = {plain(scene.delta)}, d = {plain(scene.d)})" if by_mass else ""
    lines = [
        "# Recommended virtual wall",
        "",
        f"Device: {scene.device.spell()}, sampled every {with_unit(scene.timing.period, 's')}, force delayed by",
        f"{with_unit(scene.timing.delay, 's')}{normalized}.",
        *([f"Its parts, in SI units: {', '.join(parts)}."] if scene.parts_beyond or scene.operator else []),
        "",
        "| | stiffness K | virtual damping B | alpha | beta |",
        "|---|---|---|---|---|",
        f"| stiffest stable wall | {cells(most)} |",
    ]
    if verdict is None:
        lines += ["", f"No wall to set: {recommendation.reason}.", ""]
    else:
        lower, upper = tell_apart(verdict.virtual_damping_lower, verdict.virtual_damping_upper, "N s/m")
        passive, missing = recommendation.spell_passive(), verdict.passivity_margin
        if verdict.passive is False:
            passive += f", that would take {with_unit(-missing, 'N s/m')} more physical damping"
        radius, how = best["spectral_radius"], ""
        if isnan(verdict.frequency):
            how = "by the measured curve" if scene.device.deviation is None else "for every response in the band"
        settles = f"settles to 2 % of a step of force in about {spell(best['settling_time'], 's')}"
        if best["settling_time"] is None:
            settles = f"has a slowest motion that decays to 2 % in {spell(best['decay_time'], 's')}"
        lines += [
            f"| **recommended, {100 * best['stiffness_fraction']:.4g} % of it** | {cells(best, '**')} |",
            "",
            "The recommended wall",
            "",
            f"- is stable: {how if radius is None else f'spectral radius {radius:.6f}'};",
            f"- stays stable at this K for B between {lower} and {upper};",
            *([] if how else [f"- {settles};"]),
            f"- is passive: {passive}.",
            "",
        ]
    if not scene.parts_beyond:
        lines += ["No virtual damping makes a stiffness above the maximum stable.", ""]
    if recommendation.steps:
        lines += ["What would raise the maximum:", ""]
        lines += [f"- {step.spell()};" for step in recommendation.steps]
        lines = [*lines[:-1], f"{lines[-1].removesuffix(';')}.", ""]
    return "\n".join(lines)
