"""The stability of haptic walls by the general method: eigenvalues on grids, and exact points by nonlinear solvers.

A device with normalized damping delta = b T/m renders a wall with stiffness alpha = K T^2/m and damping beta = B T/m
after a delay of d = n + f periods (n integer, 0 <= f < 1). With c = e^-delta and the numerator N(z) = a2 z^2 + a1 z +
a0 of the device under zero-order hold (`plant.rigid_mass`), the characteristic polynomial is

    P(z) = z^(2+n) (z - 1)(z - c) + N(z) (alpha z + beta (z - 1)) = D(z) + alpha N1(z) + beta N2(z)

1. *Grids.* The poles are the eigenvalues of the companion matrix of P. The loop is stable if the spectral radius, the
   largest modulus of its poles, is below 1. For integer d, a0 = 0, and a factor z of P cancels.
2. *Boundary points.* On the stability boundary P(e^(j omega)) = 0: two real equations for alpha, beta and omega. A
   third fixes alpha or beta. Bisection (jaxopt) yields omega, Newton's method (optimistix) then implicit derivatives.
3. *Maximum stiffness.* The largest alpha subject to spectral radius 1: the third equation is the stationarity of the
   Lagrangian, Im(conj(dP/dbeta) dP/domega) = 0. For d < 1 the maximum may be the *corner*, a double pole at z = -1.

The *curve* consists of the walls with a pole pair at e^(+-j omega). Its first part, up to alpha = 0 or the corner,
bounds the stable walls: beta increases along it with omega, so a line of constant beta crosses it once, and a line of
constant alpha once on each side of its maximum (docs/theory/one-lobe.md). The faster methods of `zwidth.stability` are
tested against this module. Source: Hulin, Preusche, Hirzinger 2006, eqs. (15), (17) = -delta^2 P, (24), (25).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array, Coefficients, Reals, Roots
from zwidth.core.xp import lazy_jax as jax
from zwidth.core.xp import namespace
from zwidth.numerics.polynomials import Affine, companion
from zwidth.numerics.root_finding import bracket_root, polish_root
from zwidth.plant.rigid_mass import Plant, discretize_mass, split_delay

NEAR_PI = np.pi * (1.0 - 1e-4)  # largest omega of the curve; rounding errors grow as 1/(pi - omega)


class Degree(NamedTuple):
    """The integer part of a delay, and whether it has a fractional part; both determine the degree of P."""

    n: int  # integer part of the delay
    fractional: bool  # the delay has a fractional part

    @property
    def poles(self) -> int:
        """Degree of P: 3 + d for integer d, 4 + n otherwise."""
        return self.n + (4 if self.fractional else 3)


def expand_polynomial(delta: Reals, d: Reals, degree: Degree) -> Affine:
    """Return the coefficients of D, N1 and N2, highest power first, along a last axis of length degree.poles + 1."""
    plant = discretize_mass(delta, d - degree.n if degree.fractional else None)
    xp, zero, one = namespace(plant.a2), 0.0 * plant.a2, 0.0 * plant.a2 + 1.0
    # For an integer delay N(z) is divided by z; ``plant.gap`` is then a2 - a1, without cancellation.
    numerator = [plant.a2, plant.a1, plant.a0] if degree.fractional else [plant.a2, plant.a1]
    differences = [plant.a1 - plant.a2, plant.a0 - plant.a1] if degree.fractional else [-plant.gap]
    D, pad = [one, -(1.0 + plant.c), plant.c] + [zero] * (degree.poles - 2), [zero] * (degree.poles - len(numerator))
    N1, N2 = [*pad, *numerator, zero], [*pad, numerator[0], *differences, -numerator[-1]]
    return Affine(*(xp.stack(row, axis=-1) for row in (D, N1, N2)))


def expand_loop(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    """Return the coefficients of the monic P of each wall, highest power first, along a new last axis."""
    D, N1, N2 = expand_polynomial(delta, d, degree)
    return D + alpha[..., None] * N1 + beta[..., None] * N2


def compute_poles(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Return the poles of walls, given by one-dimensional arrays, along a new last axis."""
    solve = jax.vmap(lambda a, b, c, d: jax.numpy.linalg.eigvals(companion(expand_loop(a, b, c, d, degree))))
    return solve(alpha, beta, delta, d)


def compute_radii(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Reals:
    """Return the spectral radius of each wall; a wall is stable if its spectral radius is below 1."""
    return abs(compute_poles(alpha, beta, delta, d, degree)).max(axis=-1)


class Point(NamedTuple):
    """A wall on the stability boundary, the angle of its pole, and whether the solver converged."""

    alpha: Array
    beta: Array
    omega: Array
    converged: Array


class Loop(NamedTuple):
    """The discretized device, with em = 1 - c and gap = N(-1) = a2 - a1 + a0, and the integer part of its delay."""

    plant: Plant
    n: Array


def build_loop(delta: Array, d: Array) -> Loop:
    """Return the `Loop` of a device with the damping delta and the delay d."""
    n, fraction = split_delay(d)
    return Loop(discretize_mass(delta, fraction), n)


def divide_polynomial(omega: Array, loop: Loop) -> tuple[Array, Array]:
    """Return q and w = z^(1/2) such that P(z) = N(z) w (alpha w + 2j beta Im w - q) at z = e^(j omega)."""
    plant, w = loop.plant, jax.numpy.cos(0.5 * omega) + 1j * jax.numpy.sin(0.5 * omega)
    # Insert z - 1 = 2j w Im w and cos(omega) = 2 (Re w)^2 - 1, because the differences cancel near 0 and near pi.
    device = 2j * w.imag * (plant.em - 2.0 * w.imag**2 + 2j * w.imag * w.real)
    numerator = 2.0 * (plant.a2 + plant.a0) * w.real**2 - plant.gap + 2j * (plant.a2 - plant.a0) * w.imag * w.real
    return -device * jax.numpy.exp(1j * (loop.n + 1.0) * omega) / numerator, w


def solve_wall(omega: Array, loop: Loop) -> tuple[Array, Array]:
    """Return the wall (alpha, beta) with a pole at e^(j omega): P = 0 is linear in alpha and beta."""
    q, w = divide_polynomial(omega, loop)
    alpha = q.real / w.real
    return alpha, (q.imag - alpha * w.imag) / (2.0 * w.imag)


def solve_point(condition: Callable[..., Array], start: Array, bracketed: Array, given: Array, loop: Loop) -> Point:
    """Solve P(e^(j omega)) = 0 and ``condition(unknowns, given, P) = 0`` for the unknowns (alpha, beta, omega).

    Newton's method starts from the wall with a pole at e^(j start), and is skipped if ``bracketed`` is False.
    """
    wall = jax.lax.stop_gradient(solve_wall(start, loop))
    scales = jax.numpy.stack([size := abs(wall[0]) + abs(wall[1]), size, jax.numpy.ones_like(start)])

    def evaluate(unknowns: Array, parameters: tuple[Loop, Array]) -> Array:
        def polynomial(alpha: Array, beta: Array, omega: Array) -> Array:
            q, w = divide_polynomial(omega, parameters[0])
            value = (alpha * w + 2j * beta * w.imag - q) / size
            return jax.numpy.stack([value.real, value.imag])

        unknowns = unknowns * scales
        return jax.numpy.append(polynomial(*unknowns), condition(unknowns, parameters[1], polynomial) / size)

    first = jax.numpy.stack([*wall, start]) / scales
    alpha, beta, omega = polish_root(evaluate, first, (loop, given), bracketed) * scales
    # The start is exact up to rounding errors; after a larger change, the solution is another one.
    return Point(alpha, beta, omega, bracketed & (abs(omega - start) <= 1e-5 * start))


def find_curve_end(loop: Loop, d: Array) -> Array:
    """Return the omega at which the first part of the curve ends with alpha = 0, or `NEAR_PI` at the corner."""
    # Without a corner, i.e. always for d >= 0.5, the curve has alpha < 0 at omega = pi/(d + 0.5).
    limit = jax.numpy.minimum(NEAR_PI, np.pi / (d + 0.5))
    end, exists = bracket_root(lambda omega, loop: solve_wall(omega, loop)[0], 1e-6 * limit, limit, loop)
    return jax.numpy.where(exists, end, NEAR_PI)


def find_line(loop: Loop) -> tuple[Array, Array, Array]:
    """Return N(-1), alpha + 2 beta of all walls with P(-1) = 0, and True if d < 1 and N(-1) > 0; else, N(-1) -> 1."""
    exists = (loop.n == 0) & (loop.plant.gap > 0)
    gap = jax.numpy.where(exists, loop.plant.gap, 1.0)
    return gap, 2.0 * (1.0 + loop.plant.c) / gap, exists


def maximize_stiffness(delta: Array, d: Array) -> tuple[Point, Array]:
    """Return the solution of ``max alpha subject to spectral radius 1``, and True if it is the corner."""
    end = find_curve_end(loop := build_loop(delta, d), d)
    differentiate_alpha = jax.grad(lambda omega, loop: solve_wall(omega, loop)[0])

    def stationarity(unknowns: Array, _: Array, polynomial: Callable[..., Array]) -> Array:
        by_beta, by_omega = jax.jacfwd(polynomial, argnums=(1, 2))(*unknowns)
        return by_beta[0] * by_omega[1] - by_beta[1] * by_omega[0]

    start, bracketed = bracket_root(differentiate_alpha, 1e-6 * end, end, loop)
    smooth = solve_point(stationarity, start, bracketed, d, loop)
    # The corner satisfies P(-1) = 0 and P'(-1) = 0, with D'(-1) = -7 - 5 c and N'(-1) = a1 - 2 a2. It is the maximum
    # if alpha increases up to the end of the curve, i.e. if no zero of the derivative is bracketed.
    (gap, line, exists), plant = find_line(loop), loop.plant
    beta = line - (7.0 + 5.0 * plant.c + (plant.a1 - 2.0 * plant.a2) * line) / gap
    is_corner = exists & (end >= NEAR_PI) & ~bracketed
    corner = Point(line - 2.0 * beta, beta, np.pi + 0.0 * end, is_corner)
    return Point(*(jax.numpy.where(is_corner, *pair) for pair in zip(corner, smooth, strict=True))), is_corner


def find_boundary_point(delta: Array, d: Array, given: Array, line: str) -> tuple[Point, Array]:
    """Return the end of the stable part of a line of constant alpha or beta, and whether the line has stable walls.

    ``line`` is "row" for the largest stable alpha at the given beta; "lower" or "upper" for the smallest or largest
    stable beta at the given alpha.
    """
    loop, k = build_loop(delta, d), int(line == "row")
    end, top = jax.lax.stop_gradient((find_curve_end(loop, d), maximize_stiffness(delta, d)[0]))
    middle = jax.numpy.minimum(top.omega, end)
    lower, upper = middle if line == "upper" else 1e-9 * end, middle if line == "lower" else end
    start, crosses = bracket_root(lambda w, *args: solve_wall(w, args[0])[k] - args[1], lower, upper, loop, given)
    point = solve_point(lambda unknowns, given, _: unknowns[k] - given, start, crosses, given, loop)
    value = point[1 - k]
    if line != "lower":
        # For d < 1 a real pole may reach z = -1 first, on a line of walls that begins at the corner.
        _, total, line_exists = find_line(loop)
        on_line = total - 2.0 * given if k else 0.5 * (total - given)
        first = line_exists & jax.numpy.where(crosses, value > on_line, end >= NEAR_PI)
        value, omega = jax.numpy.where(first, on_line, value), jax.numpy.where(first, np.pi, point.omega)
        point, crosses = Point(point.alpha, point.beta, omega, point.converged | first), crosses | first
    # Without stiffness the loop is stable only if beta > -delta.
    exists = crosses & ((value > 0) & (given > -delta) if k else (given > 0) & (given < top.alpha))
    return point._replace(alpha=value if k else given, beta=given if k else value), exists
