"""Stability of a virtual coupling, a spring alpha and a damper beta between a device and a simulated tool.

alpha and beta are normalized. G is the response of the device from force to position, G_t that of the tool, and F the
velocity estimate. The closed loop is ``1 + (alpha + beta F) (G + G_t) = 0`` (docs/theory/passivity.md, U5). The
analyses of `LinearLoop` for a wall are therefore valid for the coupling, with G + G_t in place of G. A position
estimate and further feedback of the device change G and F (`stability.linear.composition`).

A tool that is integrated by the implicit Euler method responds to the coupling force without delay. The set of stable
couplings can then be *unbounded*: all couplings with sufficiently large alpha are stable, or couplings with large alpha
and beta in certain ratios.
"""

from __future__ import annotations

from collections.abc import Container
from functools import cached_property

import numpy as np

from zwidth.analysis.loop import LinearLoop
from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind, Status
from zwidth.core.xp import nan_beyond
from zwidth.plant.composed_plant import factor_tool
from zwidth.plant.factored_plant import FactoredPlant
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.composition import compose_coupling
from zwidth.stability.linear.coupled_controller import find_coupling_delay_margin
from zwidth.stability.linear.regions import StableSet
from zwidth.stability.linear.ridge import RidgeSolution
from zwidth.stability.linear.roots import LoopRoots
from zwidth.stability.linear.rows import CONNECTED_START, find_stable_intervals
from zwidth.stability.results import Margins, RidgePoint
from zwidth.units.quantities import WALL_RANGE

# Values of the damping beta at which `CouplingLoop.free_damping` tests whether every alpha > 0 is stable.
TESTED_DAMPINGS = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 91)])


class CouplingLoop(LinearLoop):
    """Loop of a scene with a tool; methods without a docstring are documented in `LinearLoop`."""

    @cached_property
    def roots(self) -> LoopRoots:
        return self._add_tool(super().roots)

    def _add_tool(self, device: LoopRoots) -> LoopRoots:
        """Return the loop of the coupling for the given loop of the device without a tool."""
        return compose_coupling(device, self.chain.estimates, self._factored_tool)

    @cached_property
    def _factored_tool(self) -> FactoredPlant:
        """Response G_t of the tool from force to position."""
        return factor_tool(self.scene.tool.respond(self.scene.mass, self.scene.timing.period))

    @cached_property
    def has_free_stiffness(self) -> bool:
        """True if all couplings with sufficiently large alpha are stable, whatever their beta."""
        return not self.boundary.count_above(np.zeros(1))

    @cached_property
    def stable_ratios(self) -> np.ndarray:
        """Intervals of the ratio alpha/beta, shape (n, 2), in which all sufficiently stiff couplings are stable.

        The array is empty if no coupling is stable in the limit of large beta. The array is also empty if
        `has_free_stiffness` is True; then every ratio is stable.
        """
        loop = self.roots
        if self.has_free_stiffness or not loop.shared or loop.zeros.size < loop.poles.size + loop.lag:
            return np.empty((0, 2))
        # For alpha = r beta and beta -> inf, the poles of the loop approach the zeros of r + F.
        # The zeros of r + F are the poles of a loop with the plant 1/F and a spring of stiffness r.
        intervals = find_stable_intervals(Boundary.trace(loop.invert_estimate()), np.zeros(1))
        return np.stack([intervals.low[0], intervals.high[0]], -1)

    @cached_property
    def unbounded(self) -> bool:
        """True if some couplings with arbitrarily large alpha or beta are stable."""
        return self.has_free_stiffness or bool(self.stable_ratios.size)

    @cached_property
    def free_damping(self) -> float:
        """The smallest beta in `TESTED_DAMPINGS` with which the coupling is stable for every alpha > 0; NaN if none is.

        The value is also NaN if not all couplings with sufficiently large alpha are stable (`has_free_stiffness`).
        """
        if not self.has_free_stiffness:
            return np.nan
        intervals = find_stable_intervals(self.boundary, TESTED_DAMPINGS)
        scale = CONNECTED_START * np.abs(self.boundary.ends[0][np.isfinite(self.boundary.ends[0])]).max(initial=1e-60)
        free = ((intervals.low <= scale) & (intervals.high == np.inf)).any(-1)
        return float(TESTED_DAMPINGS[free.argmax()]) if free.any() else np.nan

    @cached_property
    def stable_set(self) -> StableSet:
        if self.unbounded:
            raise InputError(
                "tool: the set of stable couplings has no boundary at high stiffness; use is_stable or stable_stiffness"
            )
        return super().stable_set

    def ridge(self, negative: bool) -> tuple[RidgeSolution | None, Status]:
        return (None, Status.NO_BOUNDARY) if self.unbounded else super().ridge(negative)

    def stiffest(self, negative: bool) -> RidgePoint:
        if not self.unbounded:
            return super().stiffest(negative)
        low, high = self.stable_ratios.T
        if ((low <= 0) & (high > 0)).any():
            # The stiffness is unlimited, because every alpha > 0 is stable with a sufficiently large beta.
            unlimited, nan = np.float64(np.inf), np.float64(np.nan)
            return RidgePoint(unlimited, unlimited, nan, np.int32(RidgeKind.NONE), np.int32(Status.OK))
        beta = np.float64(self.free_damping)
        alpha = np.float64(np.nan if np.isnan(beta) else np.inf)
        status = Status.NOT_CONVERGED if np.isnan(beta) else Status.OK
        return RidgePoint(alpha, beta, np.float64(np.nan), np.int32(RidgeKind.NONE), np.int32(status))

    def is_connected(self, alpha: float, beta: float) -> bool:
        if not self.unbounded:
            return super().is_connected(alpha, beta)
        # All stable couplings with very large alpha belong to one region of the plane of alpha and beta.
        # This region is connected to alpha = 0 if one beta is stable for every alpha > 0.
        intervals = find_stable_intervals(self.boundary, np.array([beta]))
        inside = (intervals.low[0] < alpha) & (alpha < intervals.high[0])
        from_zero = intervals.low[0] <= CONNECTED_START * alpha
        return bool((inside & (from_zero | (np.isfinite(self.free_damping) & np.isinf(intervals.high[0])))).any())

    def find_connected_beta(self, alpha: float, least: float) -> list[tuple[float, float]]:
        if self.unbounded and np.isinf(self.find_stable_beta(alpha)).any():
            raise InputError("tool: the coupling is stable with every larger damping; choose B by spectral_radius")
        return super().find_connected_beta(alpha, least)

    @property
    def has_pieces(self) -> bool:
        return not self.unbounded

    def explain_limit(self) -> str:
        if not self.unbounded:
            return ""
        return (
            "stable couplings exist for arbitrarily large K, but no tested B is stable for every K > 0; choose K and B "
            "by is_stable or stable_stiffness"
        )

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        others = [name for name in Margins._fields if name in wanted and name != "delay_margin"]
        margins = super().margins(alpha, beta, others)
        if "delay_margin" not in wanted or self.chain.sampled:
            return margins
        stable, tool = np.asarray(self.labels(alpha, beta)), self._factored_tool
        delay = np.where(np.isnan(nan_beyond(WALL_RANGE, alpha, beta)).any(0), np.nan, 0.0)
        for index in map(tuple, np.argwhere(stable).tolist()):
            delay[index] = find_coupling_delay_margin(self.chain, tool, float(alpha[index]), float(beta[index]))
        return margins._replace(delay_margin=delay[()])

    def with_delay(self, delay: float) -> LoopRoots:
        return self._add_tool(super().with_delay(delay))
