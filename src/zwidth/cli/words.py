"""What the commands say, in plain words."""

from __future__ import annotations

from math import isfinite, isnan
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from zwidth.formatting import plain, with_unit

if TYPE_CHECKING:
    from zwidth.assessment import Assessment, SceneAssessment
    from zwidth.scene import Scene


# A margin is a difference of dampings; a smaller share of them is their rounding.
_ROUNDED = 1e-12


def row(label: str, text: str) -> str:
    return f"{label:<20}  {text}"


class Slope(NamedTuple):
    """The derivative of K_max by one property of a device, and what a small step of it comes to in words."""

    name: str
    symbol: str
    value: float
    unit: str
    words: str

    def line(self) -> str:
        """For people."""
        return row(f"dK_max/d{self.symbol}", f"{with_unit(self.value, self.unit)}: {self.words}")

    def as_dict(self) -> dict[str, Any]:
        """For machines; null stands for an infinite slope, which JSON cannot write."""
        return {"value": self.value if isfinite(self.value) else None, "unit": self.unit}


def find_slopes(scene: Scene, delay_model: Any) -> list[Slope]:
    """What damping, mass, period and delay change of the stiffest wall of a device."""
    from zwidth.design.stiffness import sensitivities, sensitivity_lines

    numbers = (scene.device.damping, scene.device.mass, scene.timing.period, scene.timing.delay)
    device: dict[str, Any] = dict(zip(("damping", "mass", "period", "delay"), numbers, strict=True))
    gain = sensitivities(**device, delay_model=delay_model)
    words = sensitivity_lines(**device, delay_model=delay_model)
    units = (f"N/m per {unit}" for unit in ("N s/m", "kg", "s", "s"))
    values = (float(getattr(gain, f"per_{name}")) for name in device)
    return [Slope(*parts) for parts in zip(device, ("b", "m", "T", "t_d"), values, units, words, strict=True)]


def stability_word(stable: bool, marginal: bool = False) -> str:
    """The verdict, in color."""
    if marginal:
        word = click.style("marginal", fg="yellow", bold=True)
        return f"{word} (a pole at z = 1: without stiffness nothing pulls back)"
    return click.style("stable", fg="green", bold=True) if stable else click.style("UNSTABLE", fg="red", bold=True)


def verdict_lines(scene: Scene, verdict: Assessment) -> list[str]:
    wall, device, timing = scene.wall, scene.device, scene.timing
    stable = stability_word(verdict.stable, verdict.marginal)
    lines = [
        row("device", f"m = {with_unit(device.mass * 1e3, 'g')}, b = {with_unit(device.damping, 'N s/m')}"),
        row(
            "timing",
            f"T = {with_unit(timing.period, 's')}, delay {with_unit(timing.delay, 's')} (d = {plain(verdict.d)})",
        ),
        row("wall", f"K = {with_unit(wall.stiffness, 'N/m')}, B = {with_unit(wall.virtual_damping, 'N s/m')}"),
        row(
            "normalized",
            f"alpha = {plain(verdict.alpha)}, beta = {plain(verdict.beta)}, delta = {plain(verdict.delta)}",
        ),
        "",
        row("verdict", f"{stable}, spectral radius {verdict.spectral_radius:.6f}"),
        *_distance_lines(wall.stiffness, wall.virtual_damping, verdict),
        row("passive", passivity_words(scene, verdict)),
        row(
            "stiffest stable wall",
            f"K_max = {with_unit(verdict.stiffness_max, 'N/m')} "
            f"at B = {with_unit(verdict.virtual_damping_at_max, 'N s/m')} "
            f"(alpha_max = {plain(verdict.alpha_max)}, beta = {plain(verdict.beta_at_max)})",
        ),
        row("slowest pole", pole_words(verdict.time_constant, verdict.frequency)),
        *margin_lines(wall.stiffness, verdict),
    ]
    return lines


def _distance_lines(stiffness: float, virtual_damping: float, verdict: Assessment) -> list[str]:
    limit, lower, upper = verdict.stiffness_limit, verdict.virtual_damping_lower, verdict.virtual_damping_upper
    if limit != limit:
        in_k = "no stiffness is stable at this B"
    elif verdict.stable:
        in_k = f"K may rise by {with_unit(limit - stiffness, 'N/m')}, to {with_unit(limit, 'N/m')} (at this B)"
    elif stiffness <= 0:
        in_k = f"K must be greater than 0, up to {with_unit(limit, 'N/m')} (at this B)"
    else:
        in_k = f"K must fall by {with_unit(stiffness - limit, 'N/m')}, below {with_unit(limit, 'N/m')} (at this B)"
    if lower != lower or upper != upper:
        in_b = "no damping makes this K stable"
    else:
        span = f"between {with_unit(lower, 'N s/m')} and {with_unit(upper, 'N s/m')} (at this K)"
        if verdict.stable:
            in_b = (
                f"B may fall by {with_unit(virtual_damping - lower, 'N s/m')} or rise by "
                f"{with_unit(upper - virtual_damping, 'N s/m')}: {span}"
            )
        else:
            in_b = f"B must lie {span}"
    return [row("to the boundary in K", in_k), row("to the boundary in B", in_b)]


def margin_lines(stiffness: float, verdict: Assessment | SceneAssessment) -> list[str]:
    """The margins of control engineering, where the wall has a stiffness or stands without one."""
    if stiffness <= 0 and not verdict.stable:
        return []
    parts = [f"gain {plain(verdict.gain_margin)}"]
    if isfinite(verdict.phase_margin):
        at = with_unit(verdict.gain_crossover, "Hz", 3)
        parts.append(f"phase {plain(verdict.phase_margin)} degrees at {at}")
    delay = "not known" if isnan(verdict.delay_margin) else with_unit(verdict.delay_margin, "s")
    parts += [f"delay {delay}", f"modulus {plain(verdict.modulus_margin)}"]
    return [row("margins", ", ".join(parts))]


def passivity_words(scene: Scene, verdict: Assessment | SceneAssessment, *, sufficient: bool = False) -> str:
    """Whether a wall is passive; where the condition is only sufficient, a wall that misses it may still be."""
    stiffness, margin = scene.wall.stiffness, verdict.passivity_margin
    if verdict.passive is None:
        return "not known: the sensor is not where the force acts"
    if stiffness < 0:
        return "no, and no damping makes a negative stiffness passive"
    dampings = scene.device.damping + abs(scene.wall.virtual_damping) + stiffness * scene.timing.period
    if abs(margin) <= _ROUNDED * dampings:
        return "only just, without any physical damping to spare"
    if verdict.passive:
        return f"yes, with {with_unit(margin, 'N s/m')} of physical damping to spare"
    verb = "not proved" if sufficient else "no"
    return f"{verb}, for want of {with_unit(-margin, 'N s/m')} of physical damping"


def pole_words(constant: float, frequency: float) -> str:
    """How the slowest pole moves: its time constant in s, negative for a growing one, and its frequency in Hz."""
    swing = f", oscillating at {with_unit(frequency, 'Hz')}" if frequency else ""
    if not isfinite(constant):
        return f"neither decays nor grows{swing}"
    verb = "decays" if constant >= 0 else "grows"
    return f"{verb} with time constant {with_unit(abs(constant), 's')}{swing}"
