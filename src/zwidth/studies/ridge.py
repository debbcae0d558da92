"""The stiffest stable and the stiffest passive wall over delta, and the studies of both."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

import numpy as np

from zwidth import figures
from zwidth.config.scenes import AnyScene
from zwidth.config.study import DelayModels, HeldOnly, register
from zwidth.figures.stable_set import Outlines
from zwidth.figures.table import stack
from zwidth.loops.rigid.boundary import stable_region
from zwidth.loops.rigid.passivity import passive_stiffness_slope
from zwidth.loops.rigid.ridge import alpha_max, stiffness_slope
from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.scenes.assessment import passive_edge
from zwidth.scenes.scene import Scene
from zwidth.studies.outcome import CurvesStudy, Outcome, Table, share_of_device
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import DelayModel

# A path that goes this far shows what alpha_max/delta tends to: within some percent.
_STRONG_DAMPING = 100.0
# Delays at which g(d) is sampled between two whole ones; it has kinks at these.
_SLOPE_SAMPLES = 64


@register
class RidgeStudy(CurvesStudy):
    """Maximum stiffness over delta, one curve for every d and delay model."""

    method = "Stationary points of the closed form and corners at z = -1, to some ten rounding errors."
    from_scene = ("delta", "d", "delay_models")

    kind: Literal["ridge"]

    delay_models: DelayModels = ("held",)
    """Models of a delay that is not whole."""

    two_scalings: bool = False
    """Show the small deltas in a panel of their own, as fig. 10 of the paper does."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        parts, notes = [], []
        for model, delays in needed_models(self.delay_models, self.d.values()):
            part, remarks = ridge_table(self.delta.values(), delays, model)
            parts.append(part)
            notes += remarks
        table = stack(parts)
        drawn: dict[str, Any] = {"": partial(figures.draw_ridge, table, two_scalings=self.two_scalings)}
        if table["delta"].max() >= _STRONG_DAMPING:
            drawn["_slope"] = partial(figures.draw_slope, table, slope_table(table))
        return Outcome(table=table, figures=drawn, notes=tuple(notes))


def ridge_table(delta: np.ndarray, d: np.ndarray, delay: DelayModel) -> tuple[Table, list[str]]:
    """The stiffest stable walls over ``delta``, delay by delay, and notes about points without an answer."""
    deltas, delays = np.tile(delta, d.size), np.repeat(d, delta.size)
    points = alpha_max(deltas, delays, delay=delay)
    columns = {"alpha_max": points.alpha, "beta": points.beta, "omega": points.omega}
    columns["kind"] = np.array([RidgeKind(int(code)).name.lower() for code in points.kind])
    failed = [(value, np.count_nonzero(points.status[delays == value] != Status.OK)) for value in d]
    notes = [
        f"alpha_max: {count} of {delta.size} points have no answer for d = {value:g} ({delay})"
        for value, count in failed
        if count
    ]
    return {"d": delays, "delay_model": np.full(delays.size, delay), "delta": deltas, **columns}, notes


def needed_models(models: tuple[DelayModel, ...], d: np.ndarray) -> list[tuple[DelayModel, np.ndarray]]:
    """The delays to compute in each model: for whole periods the models agree, and one of them is enough."""
    chosen: list[tuple[DelayModel, np.ndarray]] = []
    for model in models:
        delays = d[d != np.floor(d)] if model == "fractional_power" and "held" in models else d
        if delays.size:
            chosen.append((model, delays))
    return chosen


def slope_table(table: Table) -> Table:
    """The slope g(d) that alpha_max/delta of a ridge's table tends to, over its delays and those between them."""
    longest = max(1, math.ceil(table["d"].max()))
    d = np.union1d(np.linspace(0.0, longest, longest * _SLOPE_SAMPLES + 1), table["d"])
    models = dict.fromkeys(table["delay_model"].tolist())
    return stack({"delay_model": model, "d": d, "slope": stiffness_slope(d, delay=model)} for model in models)


@register
class PassivityStudy(CurvesStudy):
    """What passivity costs: the largest passive and the largest stable stiffness over delta."""

    method = "Colgate's condition at its worst frequency, for the exact delay, to 1e-12 of its terms."
    from_scene = ("delta", "d", "delay_model")
    reads_scene = True

    kind: Literal["passivity"]

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; passivity is known for the model 'held'."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        ridge, notes = ridge_table(self.delta.values(), self.d.values(), self.delay_model)
        table = {name: ridge[name] for name in ("d", "delta", "alpha_max", "beta")}
        slopes = map(passive_stiffness_slope, self.d.values().tolist())
        own = share_of_device(self.delta, self.d, scene) * table["delta"]
        for name, slope in zip(("alpha_max_passive", "beta_passive"), zip(*slopes, strict=True), strict=True):
            table[name] = np.repeat(slope, self.delta.size) * own
        return Outcome(table=table, figures={"": partial(figures.draw_passivity_cost, table)}, notes=tuple(notes))


def unit_outline(d: float) -> tuple[np.ndarray, np.ndarray]:
    """alpha and beta of the passive set's edge for delta = 1, from the smallest beta to the largest."""
    return passive_edge(Scene(Device(1.0, 1.0), Timing(1.0, d)))


def find_edges(delta: float, d: float) -> dict[str, Outlines]:
    """Where the stable and the passive walls of a rigid device end, normalized."""
    found = stable_region(delta, d)
    edges: dict[str, Outlines] = {"stable": [(np.stack([found.alpha, found.beta], -1), False)]}
    if delta > 0:
        edges["passive"] = [(delta * np.stack(unit_outline(d), -1), False)]
    return edges


def passive_outlines(deltas: np.ndarray, delays: np.ndarray, share: float = 1.0) -> Iterator[dict[str, Any]]:
    """The edge of the passive set of every device that has damping, as columns; without it nothing is passive.

    ``share`` is the part of the damping that is the device's own: a hand's does not count.
    """
    for d in delays:
        alpha, beta = unit_outline(float(d))
        for delta in deltas[share * deltas > 0]:
            yield {"curve": "passive", "d": d, "delta": delta, "delay_model": "held",
                   "alpha": share * delta * alpha, "beta": share * delta * beta}  # fmt: skip


def passive_intervals(deltas: np.ndarray, delays: np.ndarray) -> Iterator[dict[str, Any]]:
    """The virtual damping that is passive for alpha -> 0, over delta, as columns."""
    for d in delays:
        _, beta = unit_outline(float(d))
        yield {"curve": "passive", "d": d, "delay_model": "held", "delta": deltas,
               "beta_lower": deltas * beta[0], "beta_upper": deltas * beta[-1]}  # fmt: skip
