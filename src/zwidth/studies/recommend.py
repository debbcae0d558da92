"""The recommend study: the stiffest wall of a device, and one with some margin, in SI units."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np

from zwidth import figures
from zwidth.assessment import Assessment, assess
from zwidth.config.fields import Fraction
from zwidth.config.scenes import AnyDevice, AnyScene, AnyWall, PhysicalDevice
from zwidth.formatting import plain, with_unit
from zwidth.parts.wall import VirtualWall
from zwidth.quantities import RECOMMENDED_SHARE
from zwidth.stability.ridge import alpha_max
from zwidth.studies.boundary import outline
from zwidth.studies.outcome import Outcome, add_si_columns, si_scales, stack
from zwidth.studies.passivity import passive_outlines
from zwidth.studies.recommend_with_parts import recommend_with_parts, spell_answer
from zwidth.studies.step import ResponseStudy


class RecommendStudy(ResponseStudy):
    """Maximum stiffness and recommended damping of a device in SI units, and its response."""

    what: ClassVar[str] = "a recommend study"
    from_scene: ClassVar[tuple[str, ...]] = ("device", "delay_model")

    takes_parts: ClassVar[bool] = True

    kind: Literal["recommend"]

    device: PhysicalDevice
    """Device in SI units; the scene's where left out."""

    stiffness_fraction: Fraction = RECOMMENDED_SHARE
    """Stiffness of the recommended wall as a share of the maximum."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        filled = {"delay_model": scene.delay_model, **raw}
        if isinstance(scene.device, PhysicalDevice):
            filled.setdefault("device", scene.device)
        return filled

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        if name == "device":
            return "a recommendation in N/m needs a device in SI units", "give the scene mass and period"
        return super().missing(name)

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        return ((self.device, None),)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """Recommend a wall, judge it, and write both down as text and JSON, with a table and a figure."""
        stem = "recommendation" if alone else f"{self.name}_recommendation"
        device = self.device
        bare = device.to_scene()
        if not device.is_rigid:
            return recommend_with_parts(bare, device.label or self.name, self.stiffness_fraction, stem)
        ridge = alpha_max(device.delta, device.d)
        alpha, beta = self.stiffness_fraction * float(ridge.alpha), float(ridge.beta)
        stiffness, damping = si_scales(device)
        wall = VirtualWall(stiffness=alpha * stiffness, virtual_damping=beta * damping)
        verdict = assess(replace(bare, wall=wall))
        assert isinstance(verdict, Assessment), "scenes with parts are recommended for elsewhere"
        # The wall as it was judged: from SI units and back, a last digit may be another.
        columns, note = self.respond(
            device, verdict.alpha, verdict.beta, label=device.label or self.name, physical=True
        )
        response = stack([columns])
        found = _summary(device, wall, verdict, self.stiffness_fraction, float(columns["settling_time_s"]))
        edge = outline(device.delta, device.d, "held")
        passive = passive_outlines(np.array([device.delta]), np.array([device.d]), device.own_share)
        region = add_si_columns(stack([edge, *passive]), device)
        return Outcome(
            table=response,
            figures={"": partial(figures.draw_recommendation, found, region, response)},
            documents={
                f"{stem}.json": json.dumps(found, indent=2, allow_nan=False) + "\n",
                f"{stem}.md": _markdown(device, wall, verdict, found),
            },
            answer=spell_answer(found, verdict),
            notes=(note,) if note else (),
        )


def _finite(value: float) -> float | None:
    """A number as JSON has it: none that is infinite or missing."""
    return value if math.isfinite(value) else None


def _summary(
    device: PhysicalDevice, wall: VirtualWall, verdict: Assessment, stiffness_fraction: float, settling_time: float
) -> dict[str, Any]:
    """All numbers of the recommendation in SI units, with the normalized ones beside them."""
    return {
        "units": {
            "stiffness": "N/m",
            "damping": "N s/m",
            "virtual_damping": "N s/m",
            "mass": "kg",
            "time": "s",
            "frequency": "Hz",
        },
        "device": {
            "mass": device.mass,
            "damping": device.damping,
            "period": device.period,
            "delay": device.delay.seconds(device.period),
            "delta": verdict.delta,
            "d": verdict.d,
        },
        "maximum": {
            "stiffness": verdict.stiffness_max,
            "virtual_damping": verdict.virtual_damping_at_max,
            "alpha": verdict.alpha_max,
            "beta": verdict.beta_at_max,
            "kind": verdict.ridge_kind,
        },
        "recommended": {
            "stiffness_fraction": stiffness_fraction,
            "stiffness": wall.stiffness,
            "virtual_damping": wall.virtual_damping,
            "alpha": verdict.alpha,
            "beta": verdict.beta,
            "virtual_damping_lower": _finite(verdict.virtual_damping_lower),
            "virtual_damping_upper": _finite(verdict.virtual_damping_upper),
            "stable": verdict.stable,
            "spectral_radius": verdict.spectral_radius,
            "passive": verdict.passive,
            "passivity_margin": _finite(verdict.passivity_margin),
            "settling_time": _finite(settling_time),
            "time_constant": _finite(verdict.time_constant),
            "frequency": _finite(verdict.frequency),
        },
    }


def _markdown(device: PhysicalDevice, wall: VirtualWall, verdict: Assessment, found: dict[str, Any]) -> str:
    """The recommendation for a reader."""
    stiffness, stiffness_max = (with_unit(value, "N/m") for value in (wall.stiffness, verdict.stiffness_max))
    dampings = (
        wall.virtual_damping,
        verdict.virtual_damping_at_max,
        verdict.virtual_damping_lower,
        verdict.virtual_damping_upper,
        device.damping,
        -verdict.passivity_margin,
    )
    recommended, at_max, lower, upper, physical, missing = (with_unit(value, "N s/m") for value in dampings)
    period, delay = (with_unit(value, "s") for value in (device.period, device.delay.seconds(device.period)))
    best = found["recommended"]
    settled = best["settling_time"]
    settling = "not known" if settled is None else f"{with_unit(settled, 's', 3)} after a step of force"
    passive = "yes" if verdict.passive else f"no, that would take {missing} more physical damping"
    lines = [
        "# Recommended virtual wall",
        "",
        f"Device: m = {with_unit(1e3 * device.mass, 'g')}, b = {physical}, sampled every {period}, force delayed by",
        f"{delay} (normalized: delta = {plain(verdict.delta)}, d = {plain(verdict.d)}).",
        "",
        "| | stiffness K | virtual damping B | alpha | beta |",
        "|---|---|---|---|---|",
        f"| stiffest stable wall | {stiffness_max} | {at_max} "
        f"| {plain(verdict.alpha_max)} | {plain(verdict.beta_at_max)} |",
        f"| **recommended, {100 * best['stiffness_fraction']:g} % of it** | **{stiffness}** | **{recommended}** "
        f"| {plain(verdict.alpha)} | {plain(verdict.beta)} |",
        "",
        "The recommended wall",
        "",
        f"- is {'stable' if verdict.stable else 'NOT stable'}: spectral radius {verdict.spectral_radius:.6f};",
        f"- stays stable at this K for B between {lower} and {upper};",
        f"- settles to 2 % {settling};",
        f"- is passive: {passive}.",
        "",
        "No virtual damping makes a stiffness above the maximum stable.",
        "",
    ]
    return "\n".join(lines)
