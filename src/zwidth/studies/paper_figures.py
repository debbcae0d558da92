"""Studies "paper_fig6" and "paper_fig10": the figures of the paper with two models of fractional delays.

The models are the exact fractional delay ("held": the force changes within a period) and the paper's z^(1+d) with real
d ("fractional_power"). For integer d both are equal. For other d, z^d has several branches, and poles are not defined.
On the principal branch, the boundary is the closed form for integer delays, evaluated at real d.

Symbols: alpha, beta and delta are normalized stiffness, virtual damping and physical damping. As in
`stability.rigid.ridge_newton`, ``s = sin(omega/2)``, with the angular frequency omega in rad per sample, and ``lag`` is
the delay d in sampling periods.

References:
    Hulin, Preusche, Hirzinger 2006, sections V and VII.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np

from zwidth import plotting
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.numerics.root_finding import bisect, newton
from zwidth.plant.rigid_mass import Plant, discretize_mass
from zwidth.plotting.table import stack
from zwidth.stability.rigid.ridge import alpha_max, stiffness_slope
from zwidth.stability.rigid.ridge_newton import (
    Curve,
    Start,
    evaluate_stationarity,
    evaluate_wall,
    evaluate_wave,
    expand_curve,
    guess_start,
)
from zwidth.studies.boundary import tabulate_stable_intervals
from zwidth.studies.outcome import CurvesStudy, Outcome
from zwidth.studies.ridge import ridge_table
from zwidth.units.quantities import WALL_RANGE

_NEWTON_STEPS = 16  # Newton iterations; sufficient for the shortest delays, whose maximum is close to omega = pi


def _find_maximum(curve: Curve, lag: Any, start: Start) -> Any:
    """Compute s at the maximum of alpha along the boundary by Newton's method, for a fractional delay.

    Args:
        curve: coefficients of the boundary curve for each delta.
        lag: delay d for each delta.
        start: initial estimate of s, and its scale 1/(d + 1).
    """
    # For short delays the maximum is close to omega = pi, where q = 1 - s^2 solves A + B q = C d q^(-3/2) with
    # coefficients A, B, C that depend on delta. Therefore q is of the order of d^(2/3), and s is bounded away from 1.
    rest = 0.3 * np.minimum(lag, 0.05) ** (2.0 / 3.0)
    lower, upper = 0.5 * start.scale, np.minimum(np.sqrt(1.0 - rest), 1.05 * start.scale)

    def evaluate_decrease(s: Any) -> tuple[Any, Any]:
        value, slope = evaluate_stationarity(s, curve, lag)
        return -value, -slope

    return newton(evaluate_decrease, lower, upper, np.clip(start.s, lower, upper), _NEWTON_STEPS)[0]


def maximize_alpha(delta: np.ndarray, d: float) -> tuple[Any, Any, Any]:
    """Return alpha, beta and omega at the maximum of alpha for each delta, with the paper's z^(1+d)."""
    if d.is_integer():
        return alpha_max(delta, d)[:3]
    curve, lag = expand_curve(discretize_mass(delta)), np.full_like(delta, d)
    maximum = evaluate_wave(_find_maximum(curve, lag, guess_start(delta, lag, 0.0 * delta)), lag, False)
    return *evaluate_wall(maximum, curve), 2.0 * maximum.half_omega


def limit_slope(d: float) -> float:
    """Return the limit of alpha_max/delta for delta -> infinity, with the paper's z^(1+d)."""
    if d.is_integer():
        return float(stiffness_slope(d))
    zero, lag = np.zeros(1), np.full(1, d)
    # For delta -> infinity the velocity is proportional to the force, so delta N(z) becomes z, with N the numerator of
    # the plant.
    curve = expand_curve(Plant(c=zero, em=zero + 1.0, a2=zero + 1.0, a1=zero, a0=zero, gap=zero + 1.0))
    s = _find_maximum(curve, lag, guess_start(zero, lag, zero, strength=zero + 1.0))
    return float(evaluate_wall(evaluate_wave(s, lag, False), curve)[0][0])


def find_upper_damping(delta: np.ndarray, d: float) -> np.ndarray:
    """Return the largest stable beta for alpha -> 0 and each delta, with the paper's z^(1+d) at a non-integer d."""
    curve, lag = expand_curve(discretize_mass(delta)), np.full_like(delta, d)
    top = _find_maximum(curve, lag, guess_start(delta, lag, 0.0 * delta))
    limit = np.full_like(delta, np.sin(0.5 * np.pi / max(1.0, d + 0.5)))  # upper bound of s on the stability lobe
    s = bisect(lambda s: evaluate_wall(evaluate_wave(s, lag, False), curve)[0] > WALL_RANGE[0], top, limit)
    return evaluate_wall(evaluate_wave(s, lag, False), curve)[1]


class _PaperStudy(CurvesStudy):
    """Base of the studies that compare the exact delay with the paper's z^(1+d)."""

    method = "Closed forms of the exact delay, and of integer delays evaluated at real d, to a few rounding errors."

    @property
    def fractional(self) -> list[float]:
        """Non-integer values of d in the study, for which the paper's z^(1+d) is not the exact delay."""
        return [d for d in self.d.values().tolist() if not d.is_integer()]


def _tabulate(columns: Iterable[str], exact: Iterable[Mapping[str, Any]], power: Iterable[Mapping[str, Any]]) -> Any:
    """Return one table with the rows of both delay models.

    Args:
        columns: names of the columns in their order.
        exact: parts of the table for the exact delay, each a mapping of columns.
        power: parts for the paper's z^(1+d).
    """
    models = {"held": exact, "fractional_power": power}
    table = stack({"delay_model": model, **part} for model, parts in models.items() for part in parts)
    return {name: table[name] for name in columns}


@register
class Fig6Study(_PaperStudy):
    """The stable virtual damping over delta for alpha -> 0, also with the paper's z^(1+d), as in Fig. 6."""

    kind: Literal["paper_fig6"]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        delta = np.sort(self.delta.values())
        shared = {"curve": "stable", "delta": delta, "beta_lower": -delta}
        power = ({"d": d, **shared, "beta_upper": find_upper_damping(delta, d)} for d in self.fractional)
        columns = "curve", "d", "delay_model", "delta", "beta_lower", "beta_upper"
        table = _tabulate(columns, tabulate_stable_intervals(delta, self.d.values()), power)
        return Outcome(table=table, figures={"": partial(plotting.draw_zero_stiffness, table)})


@register
class Fig10Study(_PaperStudy):
    """The maximum stable stiffness over delta, also with the paper's z^(1+d), as in Fig. 10."""

    kind: Literal["paper_fig10"]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        delta = self.delta.values()
        exact, notes = ridge_table(delta, self.d.values())
        names = "alpha_max", "beta", "omega"
        power = (
            {"d": d, "delta": delta, **dict(zip(names, maximize_alpha(delta, d), strict=True)), "kind": "smooth"}
            for d in self.fractional
        )
        table = _tabulate(("d", "delay_model", "delta", *names, "kind"), [exact], power)
        drawn = {"": partial(plotting.draw_ridge, table, two_scalings=True)}
        return Outcome(table=table, figures=drawn, notes=tuple(notes))
