"""The stability boundary of the rigid loop: its closed form, and exact points on a given line."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from zwidth.arrays.batching import elementwise
from zwidth.arrays.roots import bisect, newton
from zwidth.arrays.xp import along, epsilon, frozen, namespace, repeat
from zwidth.loops.domain import WALL_RANGE, check_scalars, poison, valid_device, wall_status, within
from zwidth.loops.rigid.crossover import stable_at
from zwidth.loops.rigid.curve import (
    Lobe,
    RowEnd,
    column_end,
    creeps,
    frequency,
    lobe,
    on_line,
    peak,
    row_end,
    spread,
    wall,
)
from zwidth.loops.rigid.delay_classes import classify_delays
from zwidth.loops.rigid.polynomial import Wall, check_delay_model, frequency_boundary, frequency_loop
from zwidth.words.errors import InputError, check_choice
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike, DelayModel

PointMethod: TypeAlias = Literal["auto", "optimistix"]
_METHODS: tuple[str, ...] = ("auto", "optimistix")

# Places of the lobe at which a ray is looked for, and Newton's steps from between two of them.
_PLACES, _RAY_STEPS = 24, 12
# One Newton step through which derivatives pass makes the first ones exact, a second one the second ones.
_EXACT_STEPS = 2
# Closer to pi the frequency of a fractional power of less than one has too few digits.
_NEAREST_PI = 1e-3


def boundary(omega: ArrayLike, delta: ArrayLike, d: ArrayLike, *, delay: DelayModel = "held") -> Wall:
    """Return the wall that puts a pole pair of the loop at ``e^(+-j omega)``, in closed form.

    With ``q = -z^n (z - 1)(z - c)/(n0(z) + n1(z)/z)`` on ``z = e^(j omega)``: ``beta = Im q / sin omega``,
    ``alpha = Re q - tan(omega/2) Im q``. The curve starts at (0, -delta), eq. (19). Its first lobe bounds the stable
    set, see `zwidth.stable_region`; behind it the curve only lists walls with a pole on the circle.

    Args:
        omega: frequency in radians a period, 0 <= omega <= pi.
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, whole or not. All three broadcast.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d), principal branch).

    Returns:
        Wall with ``alpha`` and ``beta`` of the broadcast shape; NaN out of range. At omega = 0 and pi the
        values are the limits. They are finite unless the curve runs to infinity at pi: where N(-1) = 0, as for
        delta = 0 and whole d (for held delays between whole numbers it vanishes at one damping, if at all), and for a
        fractional power.

    Numerics:
        A few units in the last place, at a cost that does not grow with d. Traceable, also in d (derivatives at whole
        d are those from the right). Float64 when called directly; the ambient precision inside `jit`.

    References:
        Hulin, Preusche, Hirzinger 2006, section V; D-decomposition.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary(0.0, 0.25, 2).beta:.2f}")
        -0.25
    """
    check_delay_model(delay)
    check_scalars(delta=delta, d=d)
    return elementwise(_boundary_kernel, ("omega", "delta", "d"), (omega, delta, d), (delay,))


def _boundary_kernel(omega: Array, delta: Array, d: Array, delay_model: str) -> Wall:
    xp = namespace(omega, delta, d)
    ok = valid_device(delta, d) & (omega >= 0) & (omega <= np.pi)
    spoiled = poison(ok, omega, delta, d)
    omega, delta, d = (xp.where(ok, value, 1.0) for value in (omega, delta, d))
    curve = frequency_boundary(omega, frequency_loop(delta, d, delay_model), delay_model)
    return Wall(curve.alpha + spoiled, curve.beta + spoiled)


class BoundaryPoint(NamedTuple):
    """A wall on the edge of stability, or an array of them."""

    alpha: Array
    beta: Array
    omega: Array
    status: Array


def boundary_point(
    delta: ArrayLike,
    d: ArrayLike,
    *,
    beta: ArrayLike | None = None,
    alpha: ArrayLike | None = None,
    side: str = "lower",
    ray: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike] | ArrayLike | None = None,
    delay: DelayModel = "held",
    method: PointMethod = "auto",
) -> BoundaryPoint:
    """Find the exact boundary point on a line: ``P(e^(j omega)) = 0`` on the edge of the stable set.

    Exactly one of ``beta``, ``alpha`` and ``ray`` is given: the stiffest stable wall of that damping; the smallest
    (``side="lower"``) or largest (``"upper"``) stable damping of that stiffness; or the first boundary point on the
    ray ``(alpha0, beta0) + s (dalpha, dbeta)``, s > 0, from a stable wall (alpha0, beta0).

    Args:
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, whole or not.
        beta: normalized virtual damping of a row.
        alpha: normalized stiffness of a column, > 0.
        side: which end of the column.
        ray: (alpha0, beta0, dalpha, dbeta), or an array of which these are the first axis. Everything broadcasts.
        delay: "held" or "fractional_power".
        method: "auto" solves the proved monotone functions of the lobe; "optimistix" the frequency response in real
            unknowns, from a bracket by jaxopt, for any loop that has one: an independent judge, which compiles.

    Returns:
        BoundaryPoint: ``alpha``, ``beta``; ``omega`` of the pole on the circle (0 and pi: the real ones);
        ``status``, see `zwidth.Status`, with NaN where it is not OK: NO_BOUNDARY where a row or column holds no stable
        wall or a ray starts at none, UNDECIDED where the outline, looked at in places along it, does not show one
        crossing ahead, or lies closer to omega = pi than its digits allow (a fractional power of almost 0).

    Raises:
        InputError: not exactly one line is given, or as `zwidth.InputError` says.

    Numerics:
        alpha and ``beta + delta`` to about 1e-15 relative, times the condition of the line: close to the ridge a column
        determines beta to half the digits only. The same in NumPy, compiled and traced; a scalar takes a fraction of a
        millisecond and compiles nothing. Traceable with first and second derivatives, also in d (at whole d from the
        right). Rows and columns are intervals by proof (docs/theory/one-lobe.md); that a ray leaves the stable set but
        once rests on its convexity, seen on every device looked at and not proved.

    References:
        Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary_point(0.0, 0, beta=0.5).alpha:.4f}")
        0.6000
    """
    check_delay_model(delay)
    check_choice("side", side, ("lower", "upper"))
    check_choice("method", method, _METHODS)
    given = [name for name, value in (("beta", beta), ("alpha", alpha), ("ray", ray)) if value is not None]
    if len(given) != 1:
        raise InputError(f"beta, alpha, ray: got {' and '.join(given) or 'none'}; give exactly one of the three")
    check_scalars(delta=delta, d=d)
    if ray is not None:
        line, (alpha0, beta0, dalpha, dbeta) = "ray", _four(ray)
        check_scalars(alpha0=alpha0, beta0=beta0, dalpha=dalpha, dbeta=dbeta)
        names, values = ("alpha0", "beta0", "dalpha", "dbeta"), (alpha0, beta0, dalpha, dbeta)
    elif beta is not None:
        check_scalars(beta=beta)
        line, names, values = "row", ("beta",), (beta,)
    else:
        check_scalars(alpha=alpha)
        line, names, values = side, ("alpha",), (alpha,)
    everything = (delta, d, *values)
    if method == "optimistix":
        # Its solvers take a second to import.
        from zwidth.loops.rigid.boundary_solve import solved_point

        return solved_point(names, everything, line, delay)
    return elementwise(_point_kernel, ("delta", "d", *names), everything, (line, delay, classify_delays(d)))


def _four(ray: Any) -> tuple[ArrayLike, ...]:
    """The four parts of a ray."""
    try:
        parts = () if isinstance(ray, str) else tuple(ray)
    except TypeError:
        parts = ()
    if len(parts) != 4:
        raise InputError(f"ray: got {ray!r}; give the four numbers (alpha0, beta0, dalpha, dbeta)")
    return parts


class _Ray(NamedTuple):
    """A ray from (alpha, beta), or from (alpha, b) with b = beta + delta where points of the lobe are compared."""

    alpha: Array
    beta: Array
    dalpha: Array
    dbeta: Array

    def offset(self, wall: Any) -> Array:
        """Negative on the side of the ray from which the lobe, followed from its start, comes ahead of its origin."""
        return self.dalpha * (wall.b - self.beta) - self.dbeta * (wall.alpha - self.alpha)

    def offset_slope(self, wall: Any) -> Array:
        """The derivative of `offset` along the lobe."""
        return self.dalpha * wall.d_b - self.dbeta * wall.d_alpha


def _as_ray(line: str, numbers: tuple[Array, ...]) -> _Ray:
    """A row begins at alpha = 0; the ends of a column lie up and down from any point of it."""
    zero, one = 0.0 * numbers[0], 1.0 + 0.0 * numbers[0]
    if line == "ray":
        return _Ray(*numbers)
    return _Ray(zero, numbers[0], one, zero) if line == "row" else _Ray(numbers[0], zero, zero, one)


def _point_kernel(delta: Array, d: Array, *arguments: Any) -> BoundaryPoint:
    *numbers, line, delay_model, kind = arguments
    xp = namespace(delta, d, *numbers)
    inputs = (delta, d, *numbers)
    ray = _as_ray(line, tuple(numbers))
    given = line_status(delta, d, *ray) if line == "ray" else wall_status(ray.alpha, ray.beta, delta, d)
    if line == "ray":
        size = xp.where(given == int(Status.OK), xp.maximum(xp.abs(ray.dalpha), xp.abs(ray.dbeta)), 1.0)
        ray = ray._replace(dalpha=ray.dalpha / size, dbeta=ray.dbeta / size)
    curve = lobe(delta, d, delay_model, kind)
    creeping = creeps(delay_model, kind)
    from_b = ray._replace(beta=ray.beta + delta)
    fixed, still, still_b = frozen((curve, ray, from_b), xp)
    undecided = delta != delta
    row = None
    if line in ("row", "ray"):
        row = frozen(row_end(still.beta, fixed, delay_model, kind), xp)
        x, on_lobe, exists = row.x, row.meets, (row.meets | row.beyond) & (row.alpha > 0)
    else:
        top = peak(fixed, delay_model, kind)
        exists = (still.alpha > 0) & (still.alpha < top.alpha)
        goal = xp.where(exists, still.alpha, 0.5 * top.alpha)
        x, cut = frozen(column_end(goal, top, fixed, line == "upper", creeping), xp)
        on_lobe = ~cut
    if line == "ray" and row is not None:
        # For a held delay the verdict of `zwidth.is_stable` itself.
        inside = (ray.alpha > 0) & exists & (ray.alpha < row.alpha)
        exists = stable_at(ray.alpha, ray.beta, curve.here, kind) if delay_model == "held" else inside
        x, on_lobe, single = frozen(_first_crossing(still_b, row, fixed, creeping), xp)
        undecided = on_lobe & ~single
    smooth, at = _follow(x, curve, from_b)
    alpha, b = at.alpha, at.b
    if row and line == "row":
        alpha = _with_slope(row.alpha, alpha, xp)
    elif xp is not np and line != "ray":
        # Beside the ridge a step more would be rounding over rounding.
        b = _with_slope(wall(x, fixed).b, b, xp)
    beta, omega = b - delta, frequency(smooth, curve)
    if line == "ray" or (curve.short is not None and line != "lower"):
        s, there = _off_lobe(ray, curve)
        ends = on_lobe | (s < np.inf)
        undecided = undecided | ~ends
        s = xp.where(on_lobe | ~ends, 0.0, s)
        alpha = xp.where(on_lobe, alpha, xp.where(there == 0.0, 0.0, ray.alpha + s * ray.dalpha))
        beta = xp.where(on_lobe, beta, ray.beta + s * ray.dbeta)
        omega = xp.where(on_lobe, omega, there)
    # What the line itself fixes.
    if line == "ray":
        alpha, beta = xp.where(ray.dalpha == 0, ray.alpha, alpha), xp.where(ray.dbeta == 0, ray.beta, beta)
    else:
        alpha, beta = (alpha, ray.beta) if row else (ray.alpha, beta)
    if creeping:
        # The frequency of a fractional power of less than one is too close to pi.
        undecided = undecided | (on_lobe & (np.pi - x < _NEAREST_PI) & (d > 0) & (d < 1))
    status = xp.where(exists, xp.where(undecided, int(Status.UNDECIDED), int(Status.OK)), int(Status.NO_BOUNDARY))
    status = xp.where(given == int(Status.OK), status, given)
    # NaN, derivatives included, where there is no point.
    spoiled = poison(status == int(Status.OK), *inputs)
    return BoundaryPoint(alpha + spoiled, beta + spoiled, omega + spoiled, status.astype(np.int32))


def _off_lobe(ray: _Ray, curve: Lobe) -> tuple[Array, Array]:
    """How far a ray leads to the line of z = -1 or to alpha = 0, whichever comes first, and omega there."""
    xp = namespace(curve.d, ray.alpha)
    rate = ray.dalpha + 2.0 * ray.dbeta
    # Divided before it is chosen: the derivative of an infinite distance would be NaN.
    to_line = (on_line(curve) - ray.alpha - 2.0 * ray.beta) / xp.where(rate > 0, rate, 1.0)
    to_line = xp.where(curve.to_corner & (rate > 0), to_line, np.inf)
    to_zero = xp.where(ray.dalpha < 0, ray.alpha / xp.where(ray.dalpha < 0, -ray.dalpha, 1.0), np.inf)
    at_zero = to_zero < to_line
    return xp.where(at_zero, to_zero, to_line), xp.where(at_zero, 0.0, np.pi)


def _follow(x: Array, curve: Lobe, ray: _Ray) -> tuple[Array, Any]:
    """A root that moves with the curve and the line: it stands still in NumPy, which knows no derivative."""

    def step(x: Array) -> Array:
        at = wall(x, curve)
        return x - ray.offset(at) / ray.offset_slope(at)

    xp = namespace(x)
    x = x if xp is np else repeat(_EXACT_STEPS, step, x, xp)
    return x, wall(x, curve)


def _with_slope(value: Array, moving: Array, xp: Any) -> Array:
    """A value with the derivatives of another expression for it."""
    return value if xp is np else frozen(value, xp) + (moving - frozen(moving, xp))


def line_status(delta: Array, d: Array, alpha0: Array, beta0: Array, dalpha: Array, dbeta: Array) -> Array:
    """The `Status` of a device and a ray."""
    xp = namespace(delta, d, alpha0, beta0, dalpha, dbeta)
    given = wall_status(alpha0, beta0, delta, d)
    inside = within(dalpha, WALL_RANGE) & within(dbeta, WALL_RANGE)
    given = xp.where((given == int(Status.OK)) & ~inside, int(Status.OUT_OF_RANGE), given)
    real = xp.isfinite(dalpha) & xp.isfinite(dbeta) & ((dalpha != 0) | (dbeta != 0))
    return xp.where(real, given, int(Status.INVALID_INPUT))


def _first_crossing(ray: _Ray, row: RowEnd, curve: Lobe, creeping: bool) -> tuple[Array, Array, Array]:
    """Where a ray from a stable wall leaves through the lobe, whether it does, and whether it was seen to do so once.

    Of the row on which the wall lies, ``row`` is the end: a ray upwards can only leave behind that, one downwards
    before it.
    """
    xp = namespace(curve.d, ray.alpha)
    upwards = ray.dbeta >= 0
    low, high = xp.where(upwards, row.x, 0.0), xp.where(upwards, curve.end, row.x)
    # Places even in the square of omega, in which the start of the lobe is straight.
    square = _starts_straight(curve)
    first, last = xp.where(square, low * low, low), xp.where(square, high * high, high)
    share = along(np.linspace(0.0, 1.0, _PLACES + 1), first)
    even = first[..., None] + (last - first)[..., None] * share
    places = xp.where(square[..., None], xp.sqrt(even), even)
    wide = spread(curve)
    wide_ray = _Ray(*(part[..., None] for part in ray))
    offsets = wide_ray.offset(wall(places, wide))
    begins, ends = offsets[..., 0], offsets[..., -1]
    # Where the lobe returns, alpha is 0 to the last digit.
    returned = ray.dalpha * (wall(curve.end, curve).b - ray.beta) + ray.dbeta * ray.alpha
    ends = xp.where(upwards & ~curve.to_corner, returned, ends)
    leaves = xp.where(upwards, (ends >= 0) & ~row.beyond, (begins < 0) & (ends > 0))
    passed = offsets >= 0
    inner = passed[..., 1:-1]
    single = xp.all(inner[..., 1:] >= inner[..., :-1], axis=-1)
    # The number of places before the crossing: 1 to all but the last.
    index = 1 + xp.sum(~inner, axis=-1)
    after = xp.take_along_axis(places, index[..., None], -1)[..., 0]
    before = xp.take_along_axis(places, index[..., None] - 1, -1)[..., 0]
    if creeping:
        before = xp.maximum(before, 1e-32 * after)
        return bisect(lambda x: ray.offset(wall(x, curve)) < 0, before, after, geometric=True), leaves, single

    def offset(x: Array) -> tuple[Array, Array]:
        at = wall(x, curve)
        return ray.offset(at), ray.offset_slope(at)

    left, right = (xp.take_along_axis(offsets, (index - k)[..., None], -1)[..., 0] for k in (1, 0))
    part = xp.clip(left / xp.where(left == right, 1.0, left - right), 0.0, 1.0)
    between = before * before + (after * after - before * before) * part
    start = xp.where(square, xp.sqrt(between), before + (after - before) * part)
    x, last = newton(offset, before, after, start, _RAY_STEPS)
    return x, leaves, single & (last <= epsilon(x) ** 0.5 * x)


def _starts_straight(curve: Lobe) -> Array:
    if curve.is_short is not None:
        return ~curve.is_short
    return curve.end == curve.end if curve.short is None else curve.end != curve.end
