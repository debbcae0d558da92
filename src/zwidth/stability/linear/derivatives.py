"""Compute exact derivatives of results, such as a margin, by the numerical parameters of a scene, in NumPy.

F is the velocity estimate, q = -1/G the critical controller, ``r = alpha + beta F - q``, and ``z = e^lambda``. A wall
(alpha, beta) has a pole at z if and only if r is 0 there. Results such as the stiffest wall or a margin solve equations
in r and its derivatives. These equations are evaluated at the solution in Taylor arithmetic (`zwidth.numerics.taylor`)
and differentiated by the implicit function theorem. With the matrices of the discretized device
(`plant.sampled_states`; delay d = n + f),

    q = -e^((n + 1) lambda)/x_1,   (z - 1 - Psi) x = (z - 1) Gamma(1 - f) + Gamma(1)

A prime denotes d/dlambda. The *leaves* of a scene are its numbers, in the order of `list_leaves`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.pytrees import list_leaves, replace_leaves
from zwidth.core.status import Status
from zwidth.core.types import Array
from zwidth.model.circle_functions import Jet, circle_points
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import build_estimates
from zwidth.model.mechanism import build_chain
from zwidth.model.parameter_paths import list_parameters
from zwidth.numerics.taylor import Taylor, differentiate_implicitly, flow, replace_derivatives, seed, solve, stack
from zwidth.stability.linear.ridge import Condition, RidgeSolution
from zwidth.units.display import compact_repr
from zwidth.units.quantities import WALL

RESPONSE_TOLERANCE = 1e-8  # largest relative difference of q = -1/G computed from matrices and from roots
# Pairs of offset (in steps) and weight of a sixth-order central difference, and its step relative to the parameter. The
# difference is used for velocity estimates that accept only floats.
CENTRAL_DIFFERENCE = [(-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]
DIFFERENCE_STEP = 1e-3


class StateTerms:
    """Taylor expansion of the response of a device's states to a unit command from rest, for time in periods."""

    def __init__(self, A: Taylor, B: Taylor, one: Taylor, fraction: Taylor, sampled: bool) -> None:
        """Compute Psi, the transition matrix over one period minus the identity, Gamma(1) and Gamma(1 - f).

        Gamma(t) is the vector of the states at the time t, in periods, after a unit command from rest.

        Args:
            A, B: matrices of the device, in discrete time if ``sampled`` is True, otherwise in continuous time.
            one: the number 1 as a Taylor object with the variables of A and B.
            fraction: fractional part f of the delay.
            sampled: True for a device in discrete time, which is valid for one period and one delay.
        """
        if sampled:
            self.psi, self.full, self.late = A + stack(-np.eye(len(A.v)), one), B, B
        else:
            self.psi, self.full = flow(A, B, one)
            self.late = flow(A, B, one - fraction)[1]

    def respond(self, zeta: Taylor) -> tuple[Taylor, Taylor]:
        """Return the matrix zeta - Psi, and the responses x of the states to the command, without the factor z^-(n+1).

        The states are ``x = (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1))`` at ``zeta = z - 1``; x[0] is the position.
        """
        matrix = zeta.map(lambda part: np.multiply.outer(np.eye(len(self.full.v)), part)) - self.psi
        return matrix, solve(matrix, self.full + self.late * zeta.map(lambda part: np.asarray(part)[None]))


class LoopTerms:
    """Taylor expansions of q = -1/G and of F by the numerical parameters of a scene and by further variables.

    If the scene has a position estimate P and a velocity estimate V, F is the ratio V/P; otherwise F is the velocity
    estimate.
    """

    def __init__(self, scene: Any, variables: Sequence[Taylor], n: int, more_delay: Taylor | None = None) -> None:
        """Discretize the device.

        Args:
            scene: the scene.
            variables: the numbers of the scene in the order of `list_leaves`, then further variables.
            n: integer part of the delay.
            more_delay: delay in periods to be added to that of the scene.
        """
        self.scene, self.variables = scene, variables
        self.varied = replace_leaves(scene, iter(variables))
        timing, self.one = self.varied.timing, variables[0] * 0.0 + 1.0
        d: Any = timing._periods if timing.in_periods else timing.delay / timing.period
        # Use the value of d of the scene, because the quotient has a rounding error, which `Timing.d` removes.
        self.d = Taylor(np.float64(scene.d), d.first, d.second)
        delay = self.d if more_delay is None else self.d + more_delay
        chain = build_chain(self.varied, (self.d, n), Estimate())
        self.estimates = build_estimates(self.varied)
        A, B = (stack(part, self.one) for part in chain.realize()[:2])
        self.lag = n + 1
        self.states = StateTerms(A, B, self.one, delay - n, chain.sampled)

    def controller(self, lam: Taylor) -> Jet:
        """Return q = -1/G and its derivative in lambda = log z; G is the response of device and simulated tool."""
        q = self._control_device(lam)
        if self.scene.tool is None:
            return q
        response = self._respond_with_tool(lam)
        share = 1.0 / (self.one - q.value * response.value)
        return Jet(q.value * share, (q.slope + q.value * q.value * response.slope) * share * share)

    def _control_device(self, lam: Taylor) -> Jet:
        """Return q = -1/G of the device without a tool, and its derivative in lambda."""
        z, zeta = lam.exp(), lam.expm1()
        matrix, x = self.states.respond(zeta)
        change = solve(matrix, (self.states.late - x) * z.map(lambda part: np.asarray(part)[None]))
        q = -(lam * self.lag).exp() / x[0]
        q_slope = q * (self.one * self.lag - change[0] / x[0])
        if self.estimates is None:
            return Jet(q, q_slope)
        # Here q = -1/H for the sampled plant H. With a position estimate P and further feedback R, G = H P/(1 + H R),
        # so that q = -1/G = (-1/H - R)/P (docs/theory/scenes.md, V25).
        P, R = self._evaluate_position(lam), self._evaluate_feedback(lam)
        return Jet(q - R.value, q_slope - R.slope).over(P)

    def feedback(self, lam: Taylor) -> Jet:
        """Return the ratio R/P of further feedback R and position estimate P, and its derivative in lambda.

        The open loop L at the plant input is ``L = -(alpha + beta F + R/P)/(q + R/P)``. With a simulated tool, the
        ratio is 0, because the open loop of a coupling is that of the coupling force, which excludes R.
        """
        if self.estimates is None or self.estimates.feedback is None or self.scene.tool is not None:
            return Jet(self.one * 0.0, self.one * 0.0)
        return self._evaluate_feedback(lam).over(self._evaluate_position(lam))

    def _respond_with_tool(self, lam: Taylor) -> Jet:
        """Return the response G_t of the simulated tool, and its derivative in lambda."""
        z, zeta = lam.exp(), lam.expm1()
        tool = self.varied.tool.respond(self.varied.mass, self.varied.timing.period)
        denominator = (zeta * tool.a2 + tool.a1) * zeta + tool.a0
        response = (lam * tool.power).exp() * tool.gain / denominator
        return Jet(response, response * (tool.power - (zeta * (tool.a2 * 2.0) + tool.a1) * z / denominator))

    def _evaluate_position(self, lam: Taylor) -> Jet:
        """Return the position estimate P and its derivative in lambda."""
        assert self.estimates is not None
        return evaluate_estimate(self.estimates.position, lam, self.one)

    def _evaluate_velocity(self, lam: Taylor) -> Jet:
        """Return the velocity estimate V and its derivative in lambda."""
        assert self.estimates is not None
        V = evaluate_estimate(self.estimates.velocity, lam, self.one)
        return V.times(self._evaluate_position(lam)) if self.estimates.structure == "series" else V

    def _evaluate_feedback(self, lam: Taylor) -> Jet:
        """Return the further feedback R and its derivative in lambda."""
        assert self.estimates is not None
        feedback = self.estimates.feedback
        if feedback is None:
            return Jet(self.one * 0.0, self.one * 0.0)
        filtered = evaluate_estimate(feedback.filter, lam, self.one)
        if feedback.weights is None:
            return filtered
        P, V = self._evaluate_position(lam), self._evaluate_velocity(lam)
        position, velocity = (self.one * weight for weight in feedback.weights)
        total = Jet(*(position * p + velocity * v for p, v in zip(P, V, strict=True)))
        return filtered.times(total)

    def estimate(self, lam: Taylor) -> Jet:
        """Return the velocity estimate F and its derivative in lambda = log z."""
        if self.estimates is not None:
            if self.estimates.structure == "series":
                return evaluate_estimate(self.estimates.velocity, lam, self.one)
            ratio = self._evaluate_velocity(lam).over(self._evaluate_position(lam))
            return ratio if self.scene.tool is None else self._estimate_coupling(ratio, lam)
        velocity, period = self.varied.velocity, self.varied.timing.period
        try:
            return evaluate_estimate(velocity.estimate(period), lam, self.one)
        except (TypeError, ValueError, AttributeError):
            # A user-defined velocity estimate may accept only floats.
            return self._difference_estimate(lam)

    def _estimate_coupling(self, ratio: Jet, lam: Taylor) -> Jet:
        """Return the velocity estimate F of a coupling and dF/dlambda, from the ratio V/P of the device.

        With G = P H + G_t, q = -1/G and q_d = -1/(P H), F is ``(V H + V_t G_t)/G = q (V/P/q_d - V_t G_t)``.
        """
        assert self.estimates is not None
        tool = evaluate_estimate(self.estimates.of_tool, lam, self.one)
        device, moved = ratio.over(self._control_device(lam)), tool.times(self._respond_with_tool(lam))
        return self.controller(lam).times(Jet(device.value - moved.value, device.slope - moved.slope))

    def _difference_estimate(self, lam: Taylor) -> Jet:
        """Return F and F' of an estimate that accepts only floats, with first derivatives by finite differences."""
        leaves = list_leaves(self.scene)
        names = [id(each) for each in (self.varied.timing.period, *list_leaves(self.varied.velocity))]
        at = Taylor(lam.v, np.zeros(0))

        def evaluate(values: list[Any]) -> Jet:
            scene = replace_leaves(self.scene, iter(values))
            return evaluate_estimate(scene.velocity.estimate(scene.timing.period), at, at * 0.0 + 1.0)

        pair = evaluate_estimate(self.scene.velocity.estimate(self.scene.timing.period), lam, self.one)
        for k, variable in enumerate(self.variables[: len(leaves)]):
            step = DIFFERENCE_STEP * leaves[k]
            if id(variable) in names and step:
                for offset, weight in CENTRAL_DIFFERENCE:
                    moved = evaluate([*leaves[:k], leaves[k] + offset * step, *leaves[k + 1 :]])
                    for part, value in zip(pair, moved, strict=True):
                        part.first = part.first + 0j
                        part.first[..., k] += weight / step * value.v
        for part in pair:
            part.second = None if part.second is None else part.second + np.nan
        return pair

    def residual(self, alpha: Taylor, beta: Taylor, lam: Taylor) -> tuple[Taylor, Taylor, Taylor]:
        """Return the residual r = alpha + beta F - q and its derivative in lambda, both divided by |q|, and F."""
        (q, q_slope), (f, f_slope) = self.controller(lam), self.estimate(lam)
        scale = 1.0 / (abs(q.v) or 1.0)
        return (alpha + beta * f - q) * scale, (beta * f_slope - q_slope) * scale, f


def evaluate_estimate(estimate: Estimate, lam: Taylor, one: Taylor) -> Jet:
    """Return F and dF/dlambda of a velocity estimate whose gain, zeros and poles are numbers or Taylor objects."""
    z, zeta, F = lam.exp(), lam.expm1(), Jet(one * estimate.gain, one * 0.0)
    for zero in np.ravel(estimate.zeros):
        F = F.times(Jet(zeta + zero, z))
    for pole in np.ravel(estimate.poles):
        F = F.over(Jet(zeta + pole, z))
    if estimate.lag:
        power = (lam * -estimate.lag).exp()
        F = Jet(F.value * power, (F.slope - F.value * estimate.lag) * power)
    if n := estimate.window:
        F = F.times(Jet(-(lam * -n).expm1() / n, (lam * -n).exp()))
    return F


# Type of a function that returns the real equations of a result, such as a margin. Its arguments are q and F of the
# loop (`LoopTerms`), and the further parameters and the unknowns.
Equations = Callable[[LoopTerms, Sequence[Taylor]], Sequence[Taylor]]


def differentiate(
    scene: Any,
    order: int,
    parameters: Sequence[float],
    unknowns: Sequence[float],
    equations: Equations,
    added_delay: float | None = None,
) -> list[Taylor]:
    """Return the solution of equations, with its derivatives by the numbers of a scene and by further parameters.

    Args:
        scene: the scene, whose numbers are floats.
        order: 1, or 2 for second derivatives.
        parameters: values of the further parameters.
        unknowns: values of the unknowns.
        equations: function of `LoopTerms`, and of the further parameters followed by the unknowns. It returns one
            equation per unknown, and raises `ArithmeticError` if derivatives are not available.
        added_delay: value of the first unknown if it is a delay in periods to be added to that of the scene.

    Returns:
        The unknowns, in order; derivatives that are not available are NaN.
    """
    n = int(np.floor(scene.d + (added_delay or 0.0)))
    leaves = list_leaves(scene)

    def compute(n: int) -> list[Taylor]:
        variables = seed([*leaves, *parameters, *unknowns], order)
        added = None if added_delay is None else variables[len(leaves) + len(parameters)]
        terms = LoopTerms(scene, variables, n, added)
        return differentiate_implicitly(equations(terms, variables[len(leaves) :]), unknowns)

    index, size = index_parameters(scene), len(leaves) + len(parameters)
    is_sampled = getattr(scene.device, "dt", None) is not None
    unavailable = [Taylor(value, *(np.full([size] * k, np.nan) for k in (1, 2))) for value in unknowns]
    has_kink = not is_sampled and hasattr(scene.device, "system") and n == scene.d > 0 and added_delay is None
    with np.errstate(all="ignore"):
        try:
            result = compute(n)
            if has_kink:
                # Without inertia, the result has a kink at integer delays. For the derivative in the period, use the
                # side of smaller delays, because a longer period reduces the delay in periods.
                replace_derivatives(result, compute(n - 1), index["period"])
        except (ArithmeticError, np.linalg.LinAlgError):
            return unavailable
    if is_sampled:
        # A device in discrete time is valid for one period and one delay only, so these derivatives do not exist.
        for path in ("period", "delay"):
            replace_derivatives(result, unavailable, index[path])
    return result


def index_parameters(scene: Any) -> dict[str, int]:
    """Return the index of each parameter in the list of all numbers of a scene, by dotted path."""
    marked = replace_leaves(scene, iter(map(float, range(len(list_leaves(scene))))))
    index = {path: int(value) for path, value in list_parameters(marked).items() if isinstance(value, float)}
    if marked.timing.in_periods:
        index["delay"] = int(marked.timing._periods)
    return index


def agrees_with_roots(scene: Any, terms: LoopTerms, *angles: float) -> bool:
    """Return whether q from matrices agrees with q from zeros and poles; otherwise rounding errors dominate."""
    exact = scene.loop.roots.evaluate_controller(circle_points(np.array(angles))).value
    for w, q in zip(angles, exact, strict=True):
        value = terms.controller(terms.one * (1j * w))[0].v
        if not abs(value - q) <= RESPONSE_TOLERANCE * abs(q):
            return False
    return True


def split(value: Taylor) -> list[Taylor]:
    """Return the real and the imaginary part of a Taylor object."""
    return [value.real, value.imag]


def differentiate_ridge(scene: Any, ridge: RidgeSolution, order: int) -> list[Taylor]:
    """Return alpha, beta and omega of the stiffest wall, with derivatives (docs/theory/scenes.md, V21)."""
    is_pair = ridge.first == Condition.PAIR, ridge.second == Condition.PAIR
    free = [k for k in range(2) if is_pair[k]]
    extra = [ridge.alpha, ridge.beta, *((ridge.w1, ridge.w2)[k] for k in free)]

    def equations(terms: LoopTerms, unknowns: Sequence[Taylor]) -> list[Taylor]:
        alpha, beta, *angles = unknowns
        if not agrees_with_roots(scene, terms, ridge.w1, ridge.w2):
            raise ArithmeticError("rounding errors dominate the response")
        w = [terms.one * ridge.w1, terms.one * ridge.w2]
        for k, angle in zip(free, angles, strict=True):
            w[k] = angle
        r, slope, f = terms.residual(alpha, beta, w[0] * 1j)
        result = split(r) if is_pair[0] else [r.real]
        if ridge.second == Condition.NO_DAMPING:
            return [*result, beta]
        if ridge.second == Condition.STATIONARY:
            slope = slope * 1j
            return [*result, (f.conjugate() * slope).imag if is_pair[0] else slope.imag]
        r = terms.residual(alpha, beta, w[1] * 1j)[0]
        return [*result, *(split(r) if is_pair[1] else [r.real])]

    alpha, beta, *angles = differentiate(scene, order, [], extra, equations)
    # The derivatives of omega are 0 if omega is the constant angle of a real pole.
    k = (ridge.w1, ridge.w2).index(ridge.omega)
    return [alpha, beta, angles[free.index(k)] if k in free else alpha * 0.0]


@compact_repr()
class SceneSensitivities(NamedTuple):
    """K_max in N/m, its derivatives by dotted path in N/m per unit of the parameter, and the `zwidth.Status`."""

    stiffness: Array
    per: dict[str, Any]
    status: Array


def list_ridge_parameters(scene: Any) -> tuple[str, ...]:
    """Return the dotted paths of the real-valued parameters of a scene on which K_max depends."""
    paths = [path for path, value in scene.parameters().items() if not isinstance(value, int | np.integer)]
    rigid = scene.operator is not None and scene.operator.rigid
    excluded = (*WALL, "operator.coupling_damping") if rigid else WALL
    return tuple(path for path in paths if path not in excluded)


def compute_sensitivities(scene: Any, ridge: RidgeSolution | None, status: Status) -> SceneSensitivities:
    """Return K_max and its derivatives in all parameters of a scene; NaN if ``ridge`` is None."""
    paths = list_ridge_parameters(scene)
    if ridge is None:
        return SceneSensitivities(np.float64(math.nan), dict.fromkeys(paths, math.nan), np.int32(status))
    varied, index = replace_leaves(scene, iter(seed(list_leaves(scene), 1))), index_parameters(scene)
    unit = varied.mass / varied.timing.period / varied.timing.period
    stiffness = differentiate_ridge(scene, ridge, 1)[0] * unit
    per = {path: float(stiffness.first[index[path]]) for path in paths}
    if scene.timing.in_periods:
        per["delay"] /= scene.timing.period
    status = Status.NOT_CONVERGED if any(map(math.isnan, per.values())) else status
    return SceneSensitivities(np.float64(ridge.alpha * scene.units.stiffness), per, np.int32(status))
