"""The passive set of walls, and the study of what passivity costs.

The passivity condition is homogeneous: a wall (alpha, beta) needs damping in proportion to its distance from the
origin. The damping that a unit circle of walls needs therefore gives the whole set, for every delta.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np

from zwidth import figures
from zwidth.config.scenes import AnyScene
from zwidth.config.study import HeldOnly, figure_layout
from zwidth.figures.data import DampingInterval, PassiveOutline, PassivityCost, PassivityData
from zwidth.stability.passivity import passive_stiffness_slope, passivity_margin
from zwidth.studies.curves import CurvesStudy
from zwidth.studies.outcome import Outcome, stack
from zwidth.studies.ridge import ridge_paths

_DIRECTIONS = 721


class PassivityStudy(CurvesStudy):
    """What passivity costs: the largest passive and the largest stable stiffness over delta."""

    what: ClassVar[str] = "a passivity study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_model")

    kind: Literal["passivity"]

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; passivity is known for the model 'held'."""

    figure: Annotated[Literal["passivity_cost"] | None, figure_layout("passivity_cost")] = None
    """Layout of the figure; a generic one where left out."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """The stiffest passive and the stiffest stable wall over delta, as a table and a figure."""
        delta, delays = self.delta.values(), self.d.values()
        paths, notes = ridge_paths(delta, delays, self.delay_model)
        costs = []
        for path in paths:
            wall = stiffest_passive(path.d)
            passive = (wall.alpha * delta, wall.beta * delta)
            costs.append(PassivityCost(path.d, delta, path.alpha_max, path.beta, *passive))
        names = ("d", "delta", "alpha_max", "beta", "alpha_max_passive", "beta_passive")
        table = stack({name: getattr(cost, name) for name in names} for cost in costs)
        draw = partial(figures.draw_passivity_cost, PassivityData(tuple(costs)))
        return Outcome(table=table, figures={"": draw}, notes=tuple(notes))


class PassiveWall(NamedTuple):
    """A wall on the edge of the passive set, over delta."""

    alpha: float
    beta: float


def passive_edge(angles: np.ndarray, d: float) -> tuple[np.ndarray, np.ndarray]:
    """alpha and beta, both over delta, of the passive set's edge in given directions of the plane."""
    alpha, beta = np.maximum(np.cos(angles), 0.0), np.sin(angles)
    needed = 1.0 - np.asarray(passivity_margin(alpha, beta, 1.0, d))
    return alpha / needed, beta / needed


def unit_outline(d: float) -> tuple[np.ndarray, np.ndarray]:
    """The edge of the passive set for delta = 1, from the smallest beta to the largest."""
    return passive_edge(np.linspace(-0.5 * np.pi, 0.5 * np.pi, _DIRECTIONS), d)


def passive_outlines(deltas: np.ndarray, delays: np.ndarray) -> tuple[PassiveOutline, ...]:
    """The edge of the passive set of every device that has damping; without it nothing is passive."""
    found = []
    for d in delays:
        alpha, beta = unit_outline(float(d))
        found += [PassiveOutline(float(delta), float(d), delta * alpha, delta * beta) for delta in deltas if delta > 0]
    return tuple(found)


def passive_intervals(deltas: np.ndarray, delays: np.ndarray) -> tuple[DampingInterval, ...]:
    """The virtual damping that is passive for alpha -> 0, over delta."""
    found = []
    for d in delays:
        _, beta = unit_outline(float(d))
        found.append(DampingInterval(float(d), "held", deltas, deltas * beta[0], deltas * beta[-1]))
    return tuple(found)


def stiffest_passive(d: float) -> PassiveWall:
    """The stiffest passive wall, over delta."""
    return PassiveWall(*passive_stiffness_slope(d))
