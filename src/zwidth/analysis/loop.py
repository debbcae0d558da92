"""Normalized loop of a scene with one interface for all analyses of its walls, and two implementations.

`LinearLoop` supports every linear loop. It computes with the poles and zeros of the loop without a wall, and with the
stability boundary in the plane of alpha and beta, which it traces once (docs/theory/scenes.md). `RigidLoop` supports a
rigid mass with the backward difference and replaces most methods by closed forms (docs/theory/one-crossover.md).
`zwidth.analysis.measured_loop.MeasuredLoop` supports a measured frequency response. `zwidth.Scene.loop` selects the
implementation once; its callers do not depend on which one is selected.

Walls are given by their normalized stiffness alpha and damping beta, angles are w = omega T, and the period T is the
unit of time. A wall is *connected to K = 0* if a path of stable walls leads from it to alpha = 0; a piece of the stable
set that is not connected to K = 0 is an *island*. The *ridge* is the stiffest stable wall connected to K = 0.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from zwidth.analysis.ensemble import RIGID_PARAMETERS, RigidVariants, Variants
from zwidth.core.errors import ZwidthError
from zwidth.core.pytrees import list_leaves
from zwidth.core.status import Method, RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import is_jax, is_traced, namespace, nan_beyond
from zwidth.model.circle_functions import circle_points
from zwidth.model.mechanism import AnyChain, build_chain
from zwidth.model.parameter_paths import AnyScene, list_parameters
from zwidth.numerics.evaluate import as_float64, check_scalars, evaluate
from zwidth.plant.rigid_mass import classify_delays
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.composition import find_roots
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.delay_margin import change_delay
from zwidth.stability.linear.derivatives import SceneSensitivities, compute_sensitivities
from zwidth.stability.linear.margins import compute_margins, evaluate_walls
from zwidth.stability.linear.passivity import PassivityCondition, compute_passivity_margins
from zwidth.stability.linear.poles import (
    agree_with_verdict,
    compute_dominant_poles,
    compute_poles_minus_one,
    is_marginal,
    log_modulus,
)
from zwidth.stability.linear.poles import spectral_radius as linear_radius
from zwidth.stability.linear.regions import Outline, StableSet
from zwidth.stability.linear.ridge import RidgeSolution, find_ridge
from zwidth.stability.linear.roots import LoopRoots
from zwidth.stability.linear.rows import Island, find_stable_dampings, find_stable_intervals, label_walls
from zwidth.stability.results import DominantPole, Margins, RidgePoint, Stability
from zwidth.stability.rigid.boundary import boundary, boundary_point, stable_region
from zwidth.stability.rigid.dominant.spectral_radius import dominant_pole, spectral_radius
from zwidth.stability.rigid.margins import margins, margins_kernel
from zwidth.stability.rigid.normalization import wall_status
from zwidth.stability.rigid.passivity import passivity_margin
from zwidth.stability.rigid.poles import poles
from zwidth.stability.rigid.ridge import alpha_max, slopes_kernel, stiffness_slopes
from zwidth.stability.rigid.verdict import StabilityMethod, decide_stability, is_stable
from zwidth.units.quantities import WALL_RANGE

# Largest log|z| of poles of a lossless loop that are treated as poles on the unit circle. It exceeds 1e-8, because a
# rounding error of 1e-16 moves a double pole by the square root of this error.
ON_CIRCLE = 1e-7


class DominantMode(NamedTuple):
    """Dominant pole (pole of largest magnitude) of the closed loop with one wall, also if it is on the unit circle."""

    marginal: bool  # poles on the unit circle, none outside: one at z = 1, or all poles of an undamped plant
    radius: float  # spectral radius
    rate: float  # decay rate -log(radius) per period, accurate in relative terms also if the radius rounds to 1
    angle: float  # angle of the dominant pole, in rad per period


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """Analyses of a scene whose device has a model; by default, alpha and beta are arrays of equal shape."""

    scene: Any
    # Cache of computed ridges; the key is True if negative damping is allowed.
    _ridges: dict[bool, RidgeSolution | None] = field(default_factory=dict, init=False, repr=False)

    # Default number of random devices in tolerance estimates; small, because K_max of a device takes 10 to 50 ms.
    draws: ClassVar[int] = 200
    # True if the methods with arguments alpha and beta work inside jit, vmap and grad.
    traceable: ClassVar[bool] = False
    # Largest velocity window and delay, in periods, that searches in other modules try. It is limited, because the run
    # time increases with the square of window and delay.
    most_periods: ClassVar[float] = 128
    # True if the stability boundary in the plane of alpha and beta is available, from which margins follow.
    has_boundary: ClassVar[bool] = True

    @property
    def has_pieces(self) -> bool:
        """True if the connected pieces of the stable set are available, so that `islands` and `outlines` work."""
        return self.has_boundary

    @cached_property
    def chain(self) -> AnyChain:
        """Mechanical model of the device: masses, springs and dampers, or a linear system."""
        # Raise an error that names a parameter traced by JAX, because these analyses need plain numbers.
        for path, value in list_parameters(self.scene).items():
            as_float64(path, value)
        return build_chain(self.scene)

    @cached_property
    def roots(self) -> LoopRoots:
        """Poles and zeros of the loop without a wall."""
        return find_roots(self.chain)

    @cached_property
    def boundary(self) -> Boundary:
        """Stability boundary in the plane of alpha and beta, traced at first use."""
        return Boundary.trace(self.roots)

    @cached_property
    def _contracted(self) -> tuple[LoopRoots, int]:
        """Loop whose poles are the k-th powers of the poles of this loop, and the largest possible k; usually k = 1.

        If k > 1, groups of k poles of this loop reach the unit circle together, so k edges of its stable set would
        coincide. The stable set is therefore computed from the loop in z^k.
        """
        return self.roots.contract_powers()

    @cached_property
    def stable_set(self) -> StableSet:
        """Set of the stable walls, as connected pieces bounded by edges."""
        roots, k = self._contracted
        return StableSet(self.boundary if k == 1 else Boundary.trace(roots))

    @cached_property
    def poles_sought(self) -> int:
        """Number of closed-loop poles that have to be computed to determine the spectral radius of one wall."""
        return self.roots.order

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Return a boolean array that is True for stable walls; alpha and beta may broadcast."""
        check_scalars({"alpha": alpha, "beta": beta})
        return label_walls(self.boundary, *nan_beyond(WALL_RANGE, alpha, beta))[()]

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod, exact: tuple[np.ndarray, np.ndarray]
    ) -> Stability:
        """Return for each wall whether it is stable, a status code, and the method used.

        Args:
            alpha: normalized stiffness of the walls.
            beta: normalized damping of the walls.
            method: "auto", "crossover", "companion" or "certified".
            exact: K and B in SI units, which the method "certified" uses instead of the rounded alpha and beta.
        """
        # Check only alpha and beta, with zeros in place of delta and d, because these were checked with the scene.
        status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        if method == "certified":
            from zwidth.stability.linear.certified import decide_walls

            stable, certified_status = decide_walls(self.scene, *exact)
            inside = status == Status.OK
            stable, status = stable & inside, np.where(inside, certified_status, status)
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
        """Return all closed-loop poles of each wall, along a new last axis."""
        return 1.0 + compute_poles_minus_one(self.roots, alpha, beta)

    def radius(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Return the spectral radius of each wall, below 1 if and only if the wall is stable; NaN for invalid walls."""
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        stable = label_walls(self.boundary, alpha, beta).reshape(-1)
        radius = linear_radius(self.roots, alpha.reshape(-1), beta.reshape(-1), stable)
        return radius.reshape(alpha.shape)[()]

    def dominant_poles(self, alpha: np.ndarray, beta: np.ndarray) -> DominantPole:
        """Return the dominant pole of each wall, with times in periods; NaN for invalid walls."""
        # Check only alpha and beta, with zeros in place of delta and d, because these were checked with the scene.
        status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        stable = label_walls(self.boundary, alpha, beta).reshape(-1)
        log, angle = compute_dominant_poles(self.roots, alpha.reshape(-1), beta.reshape(-1))
        radius, log = agree_with_verdict(log, stable)
        radius, log, angle = (leaf.reshape(alpha.shape) for leaf in (radius, log, angle))
        failed = (status == Status.OK) & np.isnan(radius + angle)
        return DominantPole(radius, angle, -log, np.where(failed, np.int32(Status.NOT_CONVERGED), status))

    def find_dominant(self, alpha: float, beta: float) -> DominantMode:
        """Return the dominant pole of the closed loop with one wall."""
        if is_marginal(self.roots, alpha, beta):
            return DominantMode(True, 1.0, 0.0, 0.0)
        wall = np.array([alpha]), np.array([beta])
        zeta = compute_poles_minus_one(self.roots, *wall)[0]
        dominant = zeta[np.argmax(log_modulus(zeta))]
        angle = abs(np.arctan2(dominant.imag, 1.0 + dominant.real))
        if self.boundary.are_lossless(wall[1])[0] and log_modulus(dominant) <= ON_CIRCLE:
            return DominantMode(True, 1.0, 0.0, float(angle))
        return DominantMode(False, float(self.radius(*wall)[0]), -float(log_modulus(dominant)), float(angle))

    def find_stable_alpha(self, beta: np.ndarray) -> np.ndarray:
        """Return the stable intervals of alpha for each beta, shape (n, intervals, 2), padded with NaN."""
        return np.stack(find_stable_intervals(self.boundary, *nan_beyond(WALL_RANGE, beta))[:2], -1)

    def find_stable_beta(self, alpha: float) -> np.ndarray:
        """Return the stable intervals of beta for one alpha, shape (intervals, 2)."""
        return find_stable_dampings(self.boundary, float(*nan_beyond(WALL_RANGE, alpha)))

    def find_damper_intervals(self) -> np.ndarray:
        """Return the intervals of beta, shape (n, 2), in which a wall with alpha = 0 is stable except for a pole at 1.

        This pole exists unless the device has a spring to ground; all other poles lie inside the unit circle.
        """
        damper = self.roots.as_damper()
        if damper is None:
            return LinearLoop.find_stable_beta(self, 0.0)
        intervals = find_stable_intervals(Boundary.trace(damper), np.zeros(1))
        return np.stack([intervals.low[0], intervals.high[0]], -1)

    def explain(self, alpha: float, beta: float) -> list[str]:
        """Return the reasons why a wall is undecided: an empty list, because a model decides every wall."""
        return []

    def explain_limit(self) -> str:
        """Return the reason why the stiffest wall is not computed; "" if the message of its status suffices."""
        return ""

    def find_connected_beta(self, alpha: float, least: float) -> list[tuple[float, float]]:
        """Return for one alpha the intervals of beta >= ``least`` in which walls are stable and connected to K = 0."""
        intervals = np.maximum(self.find_stable_beta(alpha), least).tolist()
        return [(low, high) for low, high in intervals if low < high and self.is_connected(alpha, 0.5 * (low + high))]

    def is_connected(self, alpha: float, beta: float) -> bool:
        """Return whether a stable wall is connected to K = 0."""
        return self.stable_set.is_in_main(alpha, beta)

    def islands(self, least: float) -> list[Island]:
        """Return the islands that contain walls with beta > ``least``."""
        return self.stable_set.islands(least)

    def critical_walls(self, w: Array) -> tuple[Array, Array]:
        """Return alpha and beta of the walls that have a pole pair on the unit circle at the angles w in (0, pi)."""
        curve = evaluate_curve(self.roots, w)
        return curve.alpha, curve.beta

    def least_stiffness(self, least: float) -> float | None:
        """Return the smallest alpha of the stable walls with beta >= ``least``.

        The result is None if walls close to alpha = 0 are stable, i.e. unless the device is unstable without a wall.
        """
        softest = self.stable_set.find_softest(least) if self.roots.device_is_unstable else 0.0
        return softest if softest > 0 else None

    def outlines(self) -> list[Outline]:
        """Return the closed boundary curves of the pieces of the stable set, the largest first."""
        return self.stable_set.outlines()

    def stiffest(self, negative: bool) -> RidgePoint:
        """Return the stiffest stable wall connected to K = 0; ``negative`` allows beta < 0."""
        ridge, status = self.ridge(negative)
        if ridge is None:
            nan = np.float64(math.nan)
            return RidgePoint(nan, nan, nan, np.int32(RidgeKind.NONE), np.int32(status))
        alpha, beta, omega = map(np.float64, (ridge.alpha, ridge.beta, ridge.omega))
        return RidgePoint(alpha, beta, omega, np.int32(ridge.kind), np.int32(status))

    def ridge(self, negative: bool) -> tuple[RidgeSolution | None, Status]:
        """Return the stiffest stable wall with its active constraints, None if no wall is stable; and a status code."""
        stable_set = self.stable_set
        if negative not in self._ridges:
            try:
                ridge, k = find_ridge(stable_set, negative), self._contracted[1]
                # Divide the angles by k, because an angle of the loop in z^k is k times that of the loop in z.
                self._ridges[negative] = ridge and ridge._replace(w1=ridge.w1 / k, w2=ridge.w2 / k)
            except (ArithmeticError, ZwidthError):
                return None, Status.NOT_CONVERGED
        ridge = self._ridges[negative]
        return ridge, Status.NO_BOUNDARY if ridge is None else Status.OK

    def sensitivities(self, negative: bool) -> SceneSensitivities:
        """Return the derivatives of K_max with respect to the parameters of the scene, in SI units."""
        return compute_sensitivities(self.scene, *self.ridge(negative))

    def open_loop(self, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray) -> Array:
        """Return the open loop ``L = (alpha + beta F) G`` at angles w; F is the velocity estimate, G the plant."""
        return evaluate_walls(self.roots, alpha, beta, circle_points(w)).value

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        """Return the stability margins of walls, with times in periods and frequencies in rad per period.

        Margins not named in ``wanted`` may be NaN.
        """
        return compute_margins(self.chain, self.boundary, alpha, beta, wanted)

    def with_delay(self, delay: float) -> LoopRoots:
        """Return the poles and zeros of the loop without a wall, for another delay, in periods."""
        return change_delay(self.chain, delay)

    def passivity_margin(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Return the damping of the device minus the damping that passive walls require, in units of m/T."""
        condition = PassivityCondition.derive(self.chain.estimate, self.scene.d)
        alpha, beta = nan_beyond(WALL_RANGE, alpha, beta)
        return compute_passivity_margins(condition, alpha, beta, self.scene.device_delta)[()]

    def vary(self, drawn: dict[str, np.ndarray]) -> Variants:
        """Return variants of the scene; ``drawn`` maps dotted paths to arrays with one parameter value per variant."""
        return Variants(self.scene, drawn)


class RigidLoop(LinearLoop):
    """Loop of a rigid mass with the backward difference: closed forms in alpha, beta, delta and d.

    The normalized damping of the device is ``delta = b T/m``, the delay in periods d. Methods without docstring are
    described in `LinearLoop`.
    """

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

    def dominant_poles(self, alpha: np.ndarray, beta: np.ndarray) -> DominantPole:
        return dominant_pole(alpha, beta, self.scene.delta, self.scene.d)

    def find_dominant(self, alpha: float, beta: float) -> DominantMode:
        poles = self.dominant_poles(np.array([alpha]), np.array([beta]))
        radius, angle, rate = (float(leaf[0]) for leaf in poles[:3])
        # A wall with K = 0 has a pole at z = 1. If walls with slightly larger K are stable, it has no pole outside the
        # unit circle, i.e. it is marginal.
        marginal = alpha == 0 and bool(self.find_stable_alpha(np.array([beta])).size)
        return DominantMode(marginal, radius, rate, angle)

    def find_stable_alpha(self, beta: np.ndarray) -> np.ndarray:
        end = np.asarray(boundary_point(self.scene.delta, self.scene.d, beta=beta).alpha)
        return np.stack([0.0 * end, end], -1)[:, None][:, : int(np.isfinite(end).any())]

    def find_stable_beta(self, alpha: float) -> np.ndarray:
        one = np.array([alpha])
        ends = [
            boundary_point(self.scene.delta, self.scene.d, alpha=one, side=side).beta for side in ("lower", "upper")
        ]
        interval = np.stack(ends, -1)
        return interval[interval[:, 0] < interval[:, 1]]

    def is_connected(self, alpha: float, beta: float) -> bool:
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
        ridge = alpha_max(delta, d)
        xp, below = namespace(ridge.alpha), ridge.beta < 0
        # Compute the stiffest wall with B = 0 only if the ridge has B < 0, or if JAX traces B, so that its sign is
        # unknown.
        if negative or not (is_traced(below) or below):
            return ridge
        limit = boundary_point(delta, d, beta=0.0 * delta)
        kind = xp.where(limit.status == Status.OK, int(RidgeKind.NO_DAMPING), int(RidgeKind.NONE))
        undamped = RidgePoint(limit.alpha, 0.0 * limit.alpha, limit.omega, kind, limit.status)
        return RidgePoint(*(xp.where(below, first, second) for first, second in zip(undamped, ridge, strict=True)))

    def sensitivities(self, negative: bool) -> SceneSensitivities:
        closed_form = differentiate_rigid(make_plain(self.scene), negative)
        return super().sensitivities(negative) if closed_form is None else closed_form

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        device = self.scene.delta, self.scene.d
        if "delay_margin" in wanted:
            return margins(alpha, beta, *device)
        walls = np.broadcast_arrays(alpha, beta, *map(float, device))
        with np.errstate(all="ignore"):
            return margins_kernel(*walls, with_delay=False, with_modulus="modulus_margin" in wanted)

    def passivity_margin(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        return passivity_margin(alpha, beta, self.scene.device_delta, self.scene.d)

    def vary(self, drawn: dict[str, np.ndarray]) -> Variants:
        if "rate" in drawn:
            with np.errstate(divide="ignore"):
                period = 1.0 / drawn["rate"]
            drawn = {"period": period} | {name: column for name, column in drawn.items() if name != "rate"}
        return RigidVariants(self.scene, drawn) if set(drawn) <= set(RIGID_PARAMETERS) else super().vary(drawn)


def make_plain(scene: AnyScene) -> AnyScene:
    """Return the scene with all JAX numbers converted to floats and checked."""
    return scene._rebuild() if any(map(is_jax, list_leaves(scene))) else scene


def differentiate_rigid(scene: Any, negative: bool) -> SceneSensitivities | None:
    """Return the derivatives of K_max of a rigid device in closed form.

    The result is None if the stiffest wall has a negative damping, but ``negative`` is False.
    """
    values = scene.delta, scene.d
    slopes = evaluate(slopes_kernel, {"delta": scene.delta, "d": scene.d}, classify_delays(scene.d))
    if not negative and slopes.point.beta < 0:
        return None
    with np.errstate(invalid="ignore"):
        stiffness, *derivatives = stiffness_slopes(slopes, scene.mass, scene.timing.period, *values)
    per = dict(zip(("mass", "damping", "period", "delay"), derivatives, strict=True))
    if scene.timing.in_periods and scene.timing.d:
        # If the delay is given in periods, t_d = d T increases with T. By the chain rule, the derivative of K_max with
        # respect to T at constant d is the derivative at constant t_d, plus d times the derivative with respect to t_d.
        per["period"] = per["period"] + scene.timing.d * per["delay"]
    if scene.operator is not None:
        per |= {"operator.mass": per["mass"], "operator.damping": per["damping"]}
        # Differentiate the active constraints of the stiffest wall implicitly, because the derivative of K_max with
        # respect to the stiffness of the operator has no closed form.
        per["operator.stiffness"] = compute_sensitivities(scene, *scene.loop.ridge(negative)).per["operator.stiffness"]
    per = {path: float(derivative) for path, derivative in per.items()}
    return SceneSensitivities(np.float64(stiffness), per, slopes.point.status)
