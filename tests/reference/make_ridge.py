"""Compute ridge_extended.json: the ridge with its derivatives, in 160-digit arithmetic, without the project's code.

    python tests/reference/make_ridge.py

Everything follows from the paper's loop (Hulin, Preusche, Hirzinger 2006, section IV) and, for a delay of n + f
periods, from the exact zero-order-hold response to a force that changes at the instant f of a period. The boundary
is solved for (alpha, beta) at z = e^(j w); the ridge is its maximum on the first lobe, found on a grid, then by
bisection of d alpha/d w. Derivatives are central differences of 160-digit values, ordered by the implicit function
theorem. Inputs are the float64 numbers nearest to the decimals given here, taken exactly.
"""

from __future__ import annotations

import json
from pathlib import Path

import mpmath as mp

# Small damping costs up to 60 of them, the differences 32.
mp.mp.dps = 160
DIGITS = 25
HERE = Path(__file__).parent

HELD_D = [
    "0",
    "0.01",
    "0.125",
    "0.37",
    "0.5",
    "0.9",
    "0.999999999",
    "1",
    "1.3",
    "2",
    "2.6",
    "7.25",
    "8",
    "50",
    "100.5",
    "200",
    "499.5",
    "500",
]
DELTAS = ["0", "1e-8", "1e-3", "0.1", "1", "3", "3.65", "3.67", "10", "32", "34", "100", "1e3", "1e4", "1e6"]
# Before and behind the corner's take-over at d = 0, 3.659361627421783507.
TAKE_OVER = ["3.659361627", "3.65936162742", "3.659361627421783", "3.659361627421785", "3.65936162743", "3.659361628"]
POWER_D = ["0.001", "0.01", "0.125", "0.5", "0.9", "1.3", "7.25", "100.5"]
POWER_DELTAS = ["0", "1e-3", "0.1", "1", "3", "3.67", "10", "100", "1e4"]


def response(t, delta):
    """Position and velocity after a unit force held for t, and the impulse response, for unit mass."""
    if delta == 0:
        return t * t / 2, t
    e = mp.exp(-delta * t)
    return (t - (1 - e) / delta) / delta, (1 - e) / delta


def numerator(z, delta, f):
    """n0(z) + n1(z)/z of the held loop: newer force from f on, older one before."""
    c = mp.exp(-delta)
    drift = response(mp.mpf(1), delta)[1]  # position gained in one period from unit velocity
    t = 1 - f
    x0, v0 = response(t, delta)
    xf, vf = response(f, delta)
    x1, v1 = xf + vf * response(t, delta)[1], vf * mp.exp(-delta * t)
    n0 = x0 * z + drift * v0 - c * x0
    n1 = x1 * z + drift * v1 - c * x1
    return n0 + n1 / z


class Loop:
    """The boundary curve of one delay model with n whole periods; ``tau`` is f (held) or d (fractional power)."""

    def __init__(self, model, n):
        self.model, self.n = model, n

    def wall(self, w, delta, tau):
        z = mp.expj(w)
        c = mp.exp(-delta)
        if self.model == "held":
            q = -(z**self.n) * (z - 1) * (z - c) / numerator(z, delta, tau)
        else:
            q = -mp.expj(w * tau) * (z - 1) * (z - c) / (numerator(z, delta, mp.mpf(0)))
        return mp.re(q) - mp.tan(w / 2) * mp.im(q), mp.im(q) / mp.sin(w)

    def alpha(self, w, delta, tau):
        return self.wall(w, delta, tau)[0]

    def slope(self, w, delta, tau):
        h = mp.mpf(10) ** -30
        return (self.alpha(w + h, delta, tau) - self.alpha(w - h, delta, tau)) / (2 * h)

    def corner(self, delta, tau):
        """alpha and beta with P(-1) = P'(-1) = 0, P divided by z^(1 + n)."""
        c = mp.exp(-delta)
        h = mp.mpf(10) ** -30

        def parts(z):
            n = numerator(z, delta, tau)
            return z**self.n * (z - 1) * (z - c), n, n * (z - 1) / z

        low, mid, high = parts(-1 - h), parts(mp.mpf(-1)), parts(-1 + h)
        derivative = [(b - a) / (2 * h) for a, b in zip(low, high, strict=True)]
        solution = mp.lu_solve(mp.matrix([mid[1:], derivative[1:]]), -mp.matrix([mid[0], derivative[0]]))
        return solution[0], solution[1]


def stationary_frequency(loop, delta, tau, d):
    """The w of the smooth maximum of the first lobe, or None where alpha still rises at pi."""
    limit = min(mp.pi, mp.pi / (d + mp.mpf(1) / 2))
    grid = [limit * k / 240 for k in range(1, 240)]
    if limit == mp.pi:
        # Near pi the maximum may hide in the last part in 1e8.
        grid += [mp.pi - mp.pi / 240 * mp.mpf(10) ** (-mp.mpf(k) / 4) for k in range(1, 44)]
    values = []
    for w in grid:
        value = loop.alpha(w, delta, tau)
        if value <= 0:
            break
        values.append(value)
    reaches_pi = len(values) == len(grid) and limit == mp.pi
    best = max(range(len(values)), key=values.__getitem__)
    if reaches_pi and best == len(values) - 1:
        return None
    low, high = grid[best - 1] if best else grid[0] / 1000, grid[best + 1]
    for _ in range(90):
        middle = (low + high) / 2
        low, high = (middle, high) if loop.slope(middle, delta, tau) > 0 else (low, middle)
    # Bisection alone would need 500 steps; the secant finishes.
    return mp.findroot(lambda w: loop.slope(w, delta, tau), (low, high), solver="secant", tol=1e-110, verify=False)


def partial(function, point, orders):
    """A mixed partial derivative by central differences of fourth order."""
    h = mp.mpf(10) ** -16
    if not any(orders):
        return function(*point)
    k = next(i for i, order in enumerate(orders) if order)
    lower = tuple(order - (i == k) for i, order in enumerate(orders))

    def at(factor):
        return partial(function, tuple(x + factor * h * (i == k) for i, x in enumerate(point)), lower)

    # The error is h^4 times a fifth derivative.
    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)


def text(value, digits=DIGITS):
    return mp.nstr(value, digits)


def smooth_row(loop, w, delta, tau):
    def a(*orders):
        return partial(loop.alpha, (w, delta, tau), orders)

    def b(*orders):
        return partial(lambda *point: loop.wall(*point)[1], (w, delta, tau), orders)

    alpha, beta = loop.wall(w, delta, tau)
    curvature = a(2, 0, 0)
    w_delta, w_d = -a(1, 1, 0) / curvature, -a(1, 0, 1) / curvature
    return {
        "alpha": alpha,
        "beta": beta,
        "omega": w,
        "alpha_delta": a(0, 1, 0),
        "alpha_d": a(0, 0, 1),
        "beta_delta": b(0, 1, 0) + b(1, 0, 0) * w_delta,
        "beta_d": b(0, 0, 1) + b(1, 0, 0) * w_d,
        "omega_delta": w_delta,
        "omega_d": w_d,
        "alpha_delta_delta": a(0, 2, 0) + a(1, 1, 0) * w_delta,
        "alpha_delta_d": a(0, 1, 1) + a(1, 1, 0) * w_d,
        "alpha_d_d": a(0, 0, 2) + a(1, 0, 1) * w_d,
    }


def corner_row(loop, delta, tau):
    def a(*orders):
        return partial(lambda *point: loop.corner(*point)[0], (delta, tau), orders)

    def b(*orders):
        return partial(lambda *point: loop.corner(*point)[1], (delta, tau), orders)

    alpha, beta = loop.corner(delta, tau)
    zero = mp.mpf(0)
    return {
        "alpha": alpha,
        "beta": beta,
        "omega": mp.pi,
        "alpha_delta": a(1, 0),
        "alpha_d": a(0, 1),
        "beta_delta": b(1, 0),
        "beta_d": b(0, 1),
        "omega_delta": zero,
        "omega_d": zero,
        "alpha_delta_delta": a(2, 0),
        "alpha_delta_d": a(1, 1),
        "alpha_d_d": a(0, 2),
    }


def row(model, delta_text, d_text):
    delta, d = mp.mpf(float(delta_text)), mp.mpf(float(d_text))
    n = int(mp.floor(d).real) if model == "held" else 0
    tau = d - n
    loop = Loop(model, n)
    # A central difference in delta needs room on both sides; the formulas continue analytically below 0, except
    # that 0 itself has no 1/delta: this shift changes nothing that is kept.
    shifted = delta if delta else mp.mpf(10) ** -30
    w = stationary_frequency(loop, shifted, tau, d)
    values = corner_row(loop, shifted, tau) if w is None else smooth_row(loop, w, shifted, tau)
    head = {"model": model, "d": d_text, "delta": delta_text, "kind": "corner" if w is None else "smooth"}
    return head | {key: text(value) for key, value in values.items()}


def main():
    points = [("held", delta, d) for d in HELD_D for delta in DELTAS]
    points += [("held", delta, "0") for delta in TAKE_OVER]
    points += [("fractional_power", delta, d) for d in POWER_D for delta in POWER_DELTAS]
    rows = [row(*point) for point in points]
    (HERE / "ridge_extended.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
