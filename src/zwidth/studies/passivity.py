"""The passive set of walls, which grows with delta as a whole, and the study of what passivity costs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

import numpy as np

from zwidth import figures
from zwidth.config.scenes import AnyScene
from zwidth.config.study import HeldOnly, register
from zwidth.figures.region import Outlines
from zwidth.loops.rigid.boundary import stable_region
from zwidth.loops.rigid.passivity import passive_stiffness_slope
from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.scenes.assessment import passive_edge
from zwidth.scenes.scene import Scene
from zwidth.studies.outcome import CurvesStudy, Outcome
from zwidth.studies.ridge import ridge_table


@register
class PassivityStudy(CurvesStudy):
    """What passivity costs: the largest passive and the largest stable stiffness over delta."""

    method = "Colgate's condition at its worst frequency, for the exact delay, to 1e-12 of its terms."
    from_scene = ("delta", "d", "delay_model")

    kind: Literal["passivity"]

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; passivity is known for the model 'held'."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """The stiffest passive and the stiffest stable wall over delta, as a table and a figure."""
        ridge, notes = ridge_table(self.delta.values(), self.d.values(), self.delay_model)
        table = {name: ridge[name] for name in ("d", "delta", "alpha_max", "beta")}
        slopes = [passive_stiffness_slope(d) for d in self.d.values().tolist()]
        for name, slope in zip(("alpha_max_passive", "beta_passive"), zip(*slopes, strict=True), strict=True):
            table[name] = np.repeat(slope, self.delta.size) * table["delta"]
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
