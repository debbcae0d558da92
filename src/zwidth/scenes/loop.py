"""The loop of a scene, normalized: every question about its walls under one name, answered by two kernels.

`LinearLoop` answers of any linear loop, by its roots and by the boundary of its walls, which is laid out once.
`RigidLoop` is the loop of a rigid mass with the difference of two samples: where there is a closed form it answers by
that, and lays nothing out. A scene picks its loop once (`zwidth.Scene.loop`); above, nobody asks which one it is.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import as_float64, check_scalars, evaluate
from zwidth.arrays.held_mass import classify_delays
from zwidth.loops.linear.border import Outline, StableSet
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import evaluate_curve
from zwidth.loops.linear.held import find_roots
from zwidth.loops.linear.margins import compute_margins, open_loop_response
from zwidth.loops.linear.passivity import PassivityCondition, compute_passivity_margins
from zwidth.loops.linear.poles import compute_poles_minus_one, is_marginal, log_modulus
from zwidth.loops.linear.poles import spectral_radius as linear_radius
from zwidth.loops.linear.ridge import (
    RidgeSolution,
    SceneSensitivities,
    compute_sensitivities,
    differentiate_stiffness,
    find_ridge,
)
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.linear.rows import Island, find_stable_dampings, find_stable_intervals, label_walls
from zwidth.loops.rigid.boundary import boundary, boundary_point, stable_region
from zwidth.loops.rigid.margins import margins, margins_kernel
from zwidth.loops.rigid.normalization import wall_status
from zwidth.loops.rigid.outermost_poles import find_dominant_pole
from zwidth.loops.rigid.passivity import passivity_margin
from zwidth.loops.rigid.poles import poles
from zwidth.loops.rigid.ridge import alpha_max, slopes_kernel, stiffness_slopes
from zwidth.loops.rigid.spectral_radius import spectral_radius
from zwidth.loops.rigid.verdict import StabilityMethod, decide_stability, is_stable
from zwidth.parts.chain import AnyChain, chain_of
from zwidth.parts.circle import circle
from zwidth.parts.paths import AnyScene, list_parameters, replace_parameters
from zwidth.scenes.variants import RIGID_PARAMETERS, RigidVariants, Variants
from zwidth.words.errors import ZwidthError
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.results import Margins, RidgePoint, Stability
from zwidth.words.status import Method, RidgeKind, Status
from zwidth.words.types import Array
from zwidth.words.xp import is_jax, is_traced, namespace, nan_beyond

# Largest log|z| of a lossless loop whose poles count as on the unit circle. A rounding error of 1e-16 moves a double
# pole by its square root, about 1e-8.
_ON_CIRCLE = 1e-7


class SlowestMotion(NamedTuple):
    """The slowest motion of a loop with one wall."""

    marginal: bool  # poles on the unit circle, none outside: one at z = 1, or all of a plant without damping
    radius: float  # the spectral radius
    rate: float  # -log(radius) per period, with relative accuracy
    angle: float  # of the slowest pole, per period


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """The loop of any scene with a linear velocity estimate; alpha and beta are arrays of one shape."""

    scene: Any
    # Cache of the stiffest walls, by "negative damping allowed".
    _ridges: dict[bool, RidgeSolution | None] = field(default_factory=dict, init=False, repr=False)

    # Number of random devices in an interactive computation; one maximum stiffness takes some 10 to 50 ms.
    draws: ClassVar[int] = 200
    # True if the methods that take walls work inside jit, vmap and grad.
    traceable: ClassVar[bool] = False
    # Largest window and delay in a search, in periods; its run time increases with their square.
    most_periods: ClassVar[float] = 128

    @cached_property
    def chain(self) -> AnyChain:
        """Its masses, springs and dampers, or its linear system."""
        # A search of numbers: what JAX traces is refused by name.
        for path, value in list_parameters(self.scene).items():
            as_float64(path, value)
        return chain_of(self.scene)

    @cached_property
    def roots(self) -> LoopRoots:
        """The loop without a wall, by roots."""
        return find_roots(self.chain)

    @cached_property
    def boundary(self) -> Boundary:
        """The boundary of its walls, laid out once."""
        return Boundary.trace(self.roots)

    @cached_property
    def _in_powers(self) -> tuple[LoopRoots, int]:
        """The loop of which its own has the k-th roots as poles, and k: they come k at a time, and so would edges."""
        return self.roots.contract_powers()

    @cached_property
    def border(self) -> StableSet:
        """The edge of its stable set."""
        roots, k = self._in_powers
        return StableSet(self.boundary if k == 1 else Boundary.trace(roots))

    @cached_property
    def poles_sought(self) -> int:
        """How many poles a spectral radius is computed from."""
        return self.roots.order

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Whether walls are stable; the two need only broadcast."""
        check_scalars({"alpha": alpha, "beta": beta})
        return label_walls(self.boundary, *nan_beyond(WALL_RANGE, alpha, beta))[()]

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod, exact: tuple[np.ndarray, np.ndarray]
    ) -> Stability:
        """Return label, status and method of each wall; ``exact`` are the walls in SI units, for "certified"."""
        # Device and delay were checked as the parts of the scene.
        status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        if method == "certified":
            from zwidth.loops.linear.certified import decide_walls

            stable, proved = decide_walls(self.scene, *exact)
            inside = status == Status.OK
            stable, status = stable & inside, np.where(inside, proved, status)
            used = Method.CERTIFIED
        elif method == "companion":
            with np.errstate(invalid="ignore"):
                stable = log_modulus(compute_poles_minus_one(self.roots, *np.broadcast_arrays(alpha, beta))).max(-1) < 0
            stable &= ~self.boundary.are_lossless(beta)
            used = Method.COMPANION
        else:
            stable, used = label_walls(self.boundary, alpha, beta), Method.CROSSOVER
        return Stability(stable[()], status[()], np.full(stable.shape, used, np.int32)[()])

    def poles(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """All poles, along a new last axis."""
        return 1.0 + compute_poles_minus_one(self.roots, alpha, beta)

    def radius(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """The spectral radius, below 1 exactly where a wall is stable; NaN where one is out of range."""
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        stable = label_walls(self.boundary, alpha, beta).reshape(-1)
        found = linear_radius(self.roots, alpha.reshape(-1), beta.reshape(-1), stable)
        return found.reshape(alpha.shape)[()]

    def slowest(self, alpha: float, beta: float) -> SlowestMotion:
        """The slowest motion of one wall."""
        if is_marginal(self.roots, alpha, beta):
            return SlowestMotion(True, 1.0, 0.0, 0.0)
        wall = np.array([alpha]), np.array([beta])
        zeta = compute_poles_minus_one(self.roots, *wall)[0]
        slowest = zeta[np.argmax(log_modulus(zeta))]
        turn = abs(np.arctan2(slowest.imag, 1.0 + slowest.real))
        if self.boundary.are_lossless(wall[1])[0] and log_modulus(slowest) <= _ON_CIRCLE:
            return SlowestMotion(True, 1.0, 0.0, float(turn))
        return SlowestMotion(False, float(self.radius(*wall)[0]), -float(log_modulus(slowest)), float(turn))

    def row(self, beta: np.ndarray) -> np.ndarray:
        """The stable intervals of alpha at each damping: shape (rows, intervals, 2), NaN where a row has fewer."""
        return np.stack(find_stable_intervals(self.boundary, *nan_beyond(WALL_RANGE, beta))[:2], -1)

    def column(self, alpha: float) -> np.ndarray:
        """The stable intervals of beta at a stiffness: shape (intervals, 2)."""
        return find_stable_dampings(self.boundary, float(*nan_beyond(WALL_RANGE, alpha)))

    def dampers(self) -> np.ndarray:
        """Return the beta intervals, shape (n, 2), in which all poles of a damper but z = 1 lie inside the circle."""
        damper = self.roots.as_damper()
        if damper is None:
            return LinearLoop.column(self, 0.0)
        intervals = find_stable_intervals(Boundary.trace(damper), np.zeros(1))
        return np.stack([intervals.low[0], intervals.high[0]], -1)

    def explain(self, alpha: float, beta: float) -> list[str]:
        """What keeps a wall undecided, a sentence each: nothing, where there is a model."""
        return []

    def explain_limit(self) -> str:
        """Return the reason for an undecided stiffest wall: "", because the stability of a model is always decided."""
        return ""

    def soft_column(self, alpha: float, least: float) -> list[tuple[float, float]]:
        """Those above ``least`` whose walls lie in a piece of the stable set with soft walls."""
        column = np.maximum(self.column(alpha), least).tolist()
        return [(low, high) for low, high in column if low < high and self.holds_softly(alpha, 0.5 * (low + high))]

    def holds_softly(self, alpha: float, beta: float) -> bool:
        """Whether a path of stable walls leads from soft ones to a stable wall."""
        return self.border.is_in_main(alpha, beta)

    def islands(self, least: float) -> list[Island]:
        """The pieces of the stable set without soft walls, with dampings above ``least``."""
        return self.border.islands(least)

    def critical_walls(self, w: Array) -> tuple[Array, Array]:
        """Return alpha and beta of the walls that have a pole pair on the unit circle at the angles w in (0, pi)."""
        curve = evaluate_curve(self.roots, w)
        return curve.alpha, curve.beta

    def least_stiffness(self, least: float) -> float | None:
        """Return the alpha below which no wall is stable, for a device unstable without a wall; None for others."""
        softest = self.border.find_softest(least) if self.roots.device_is_unstable else 0.0
        return softest if softest > 0 else None

    def outlines(self) -> list[Outline]:
        """Closed outlines of the stable set, the largest first."""
        return self.border.outlines()

    def stiffest(self, negative: bool) -> RidgePoint:
        """Return the stiffest stable wall, with beta >= 0 unless ``negative``."""
        if is_traced(*list_parameters(self.scene).values()):
            from zwidth.loops.linear.traced_ridge import trace_stiffest

            return trace_stiffest(self.scene, negative)
        found, status = self.ridge(negative)
        if found is None:
            nan = np.float64(math.nan)
            return RidgePoint(nan, nan, nan, np.int32(RidgeKind.NONE), np.int32(status))
        alpha, beta, omega = map(np.float64, (found.alpha, found.beta, found.omega))
        return RidgePoint(alpha, beta, omega, np.int32(found.kind), np.int32(status))

    def ridge(self, negative: bool) -> tuple[RidgeSolution | None, Status]:
        """Return the stiffest wall with its active constraints, None if there is none, and a status; not traceable."""
        border = self.border
        if negative not in self._ridges:
            try:
                found, k = find_ridge(border, negative), self._in_powers[1]
                self._ridges[negative] = found and found._replace(w1=found.w1 / k, w2=found.w2 / k)
            except (ArithmeticError, ZwidthError):
                return None, Status.NOT_CONVERGED
        found = self._ridges[negative]
        return found, Status.NO_BOUNDARY if found is None else Status.OK

    def sensitivities(self, negative: bool) -> SceneSensitivities:
        """What a little more of each parameter of the scene buys of the stiffest wall, in SI units."""
        return compute_sensitivities(self.scene, *self.ridge(negative))

    def open_loop(self, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray) -> Array:
        """``L = (alpha + beta F) G`` at angles."""
        return open_loop_response(self.roots, alpha, beta, circle(w)).value

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        """Margins, in periods and radians a period; those that are not wanted may be NaN."""
        return compute_margins(self.chain, self.boundary, alpha, beta, wanted)

    def passivity_margin(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """The device's own damping in excess of what passive walls need."""
        condition = PassivityCondition.derive(self.chain.estimate, self.scene.d)
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        return compute_passivity_margins(condition, alpha, beta, self.scene.own_delta)[()]

    def vary(self, drawn: dict[str, np.ndarray]) -> Variants:
        """The scene with each of the values drawn of some of its parameters."""
        return Variants(self.scene, drawn)


class RigidLoop(LinearLoop):
    """The loop of a rigid mass with the difference of two samples: closed forms of delta and d."""

    draws = 10_000
    most_periods = math.inf
    traceable = True

    @cached_property
    def poles_sought(self) -> int:
        return 1

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        return is_stable(alpha, beta, self.scene.delta, self.scene.d)

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod, exact: tuple[np.ndarray, np.ndarray]
    ) -> Stability:
        return decide_stability(alpha, beta, self.scene.delta, self.scene.d, method=method)

    def poles(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        return poles(alpha, beta, self.scene.delta, self.scene.d)

    def radius(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        return spectral_radius(alpha, beta, self.scene.delta, self.scene.d)

    def slowest(self, alpha: float, beta: float) -> SlowestMotion:
        with np.errstate(all="ignore"):
            slowest = find_dominant_pole((alpha, beta, float(self.scene.delta), float(self.scene.d)))
        # A row is stable right above K = 0, where nothing but the pole at z = 1 comes to the circle.
        return SlowestMotion(alpha == 0 and bool(self.row(np.array([beta])).size), *slowest)

    def row(self, beta: np.ndarray) -> np.ndarray:
        end = np.asarray(boundary_point(self.scene.delta, self.scene.d, beta=beta).alpha)
        return np.stack([0.0 * end, end], -1)[:, None][:, : int(np.isfinite(end).any())]

    def column(self, alpha: float) -> np.ndarray:
        at = np.array([alpha])
        ends = [boundary_point(self.scene.delta, self.scene.d, alpha=at, side=side).beta for side in ("lower", "upper")]
        column = np.stack(ends, -1)
        return column[column[:, 0] < column[:, 1]]

    def holds_softly(self, alpha: float, beta: float) -> bool:
        return True

    def islands(self, least: float) -> list[Island]:
        return []

    def critical_walls(self, w: Array) -> tuple[Array, Array]:
        device = self.scene.delta, self.scene.d
        if not is_traced(w, *device):
            return super().critical_walls(w)
        return boundary(w, *device)

    def outlines(self) -> list[Outline]:
        return [Outline(*stable_region(float(self.scene.delta), float(self.scene.d))[:2], False, False)]

    def stiffest(self, negative: bool) -> RidgePoint:
        delta, d = self.scene.delta, self.scene.d
        found = alpha_max(delta, d)
        xp, below = namespace(found.alpha), found.beta < 0
        # Asked for only where it counts, unless a trace hides whether it does.
        if negative or not (is_traced(below) or below):
            return found
        row = boundary_point(delta, d, beta=0.0 * delta)
        kind = xp.where(row.status == Status.OK, int(RidgeKind.NO_DAMPING), int(RidgeKind.NONE))
        end = RidgePoint(row.alpha, 0.0 * row.alpha, row.omega, kind, row.status)
        return RidgePoint(*(xp.where(below, there, here) for there, here in zip(end, found, strict=True)))

    def sensitivities(self, negative: bool) -> SceneSensitivities:
        found = differentiate_rigid(make_plain(self.scene), negative)
        return super().sensitivities(negative) if found is None else found

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        device = self.scene.delta, self.scene.d
        if "delay_margin" in wanted:
            return margins(alpha, beta, *device)
        walls = np.broadcast_arrays(alpha, beta, *map(float, device))
        with np.errstate(all="ignore"):
            return margins_kernel(*walls, with_delay=False, with_modulus="modulus_margin" in wanted)

    def passivity_margin(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        return passivity_margin(alpha, beta, self.scene.own_delta, self.scene.d)

    def vary(self, drawn: dict[str, np.ndarray]) -> Variants:
        return RigidVariants(self.scene, drawn) if set(drawn) <= set(RIGID_PARAMETERS) else super().vary(drawn)


def make_plain(scene: AnyScene) -> AnyScene:
    """The scene with floats in place of JAX's own numbers that nothing traces."""
    numbers = list_parameters(scene).items()
    held = {path: float(value) for path, value in numbers if is_jax(value) and not is_traced(value)}
    return replace_parameters(scene, held) if held else scene


def differentiate_rigid(scene: Any, negative: bool) -> SceneSensitivities | None:
    """Return the sensitivities of a rigid device in closed form; None if its ridge needs a negative damping."""
    values = scene.delta, scene.d
    found = evaluate(slopes_kernel, {"delta": scene.delta, "d": scene.d}, classify_delays(scene.d))
    if not negative and found.point.beta < 0:
        return None
    with np.errstate(invalid="ignore"):
        stiffness, *slopes = stiffness_slopes(found, scene.mass, scene.timing.period, *values)
    per = dict(zip(("mass", "damping", "period", "delay"), slopes, strict=True))
    if scene.timing.in_periods and scene.timing.d:
        # A delay given in periods grows with T. Chain rule: dK/dT at fixed d is dK/dT at fixed t_d + d dK/dt_d.
        per["period"] = per["period"] + scene.timing.d * per["delay"]
    if scene.operator is not None:
        per |= {"operator.mass": per["mass"], "operator.damping": per["damping"]}
        # The derivative with respect to the stiffness of the operator has no closed form.
        ridge = scene.loop.ridge(negative)[0]
        per["operator.stiffness"] = (
            math.nan if ridge is None else differentiate_stiffness(scene, ridge, "operator.stiffness")
        )
    per = {path: float(slope) for path, slope in per.items()}
    return SceneSensitivities(np.float64(stiffness), per, found.point.status)
