"""Write adversarial.npz: hard points with labels from isolated poles, and hold the certified method to many more.

    python tests/reference/make_adversarial.py [--points 24000] [--kept 4000]

The route shares nothing with the library: the plant in the form n0(z), n1(z) of a force held for part of a period, the
phi-functions as hypergeometric functions, and every zero of P enclosed in a ball by python-flint at 120 digits or
more, until each ball lies on one side of the unit circle; where zeros are too close for that, Routh's table. Seeded:
every run finds the same points.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import flint
import numpy as np
from flint import acb, acb_poly, arb

OUTPUT = Path(__file__).with_name("adversarial.npz")
FAMILIES = ("curve", "line", "corner", "origin", "small_alpha", "wide")
UNSTABLE, STABLE, ON_BOUNDARY = 0, 1, 2
DELTAS = (0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1e-4, 0.01, 0.3, 1.0, 2.4, 3.7, 5.0, 33.0, 50.0, 700.0, 750.0, 1e4, 1e6)
SHORT = (0.0, 5e-324, 2.0**-52, 0.125, 0.5, 0.9, 1.0 - 2.0**-53)
MEDIUM = (1.0, 1.0 + 2.0**-52, 1.3, 2.0, 2.6, 3.999, 4.0, 8.0, 8.5, 12.0, 12.7, 13.0, 13.2)
LONG = (20.0, 20.5, 50.0, 50.5)
LONGEST = (100.0, 200.0, 500.0, 500.25)
LEAST_BITS, MOST_BITS_FOR_ZEROS, MOST_BITS = 400, 800, 12_800


def phi(x: arb) -> tuple[arb, arb]:
    """phi1 and phi2."""
    return (-x).hypgeom_1f1(1, 2), (-x).hypgeom_1f1(1, 3) / 2


def loop(delta: float, d: float) -> tuple[int, arb, tuple[arb, arb], tuple[arb, arb]]:
    """Whole delay, c, and the coefficients of n0 and n1, constant term first."""
    n, f, x = int(d), arb(d) - int(d), arb(delta)
    t, c = 1 - f, (-x).exp()
    p1, _ = phi(x)
    p1_t, p2_t = phi(x * t)
    p1_f, p2_f = phi(x * f)
    g0x, g0v = t * t * p2_t, t * p1_t
    g1x, g1v = f * f * p2_f + t * p1_t * f * p1_f, (-x * t).exp() * f * p1_f
    return n, c, (p1 * g0v - c * g0x, g0x), (p1 * g1v - c * g1x, g1x)


def polynomial(alpha: arb | float, beta: arb | float, delta: float, d: float) -> acb_poly:
    """P, or P/(z - 1) at alpha = 0, without zeros at the origin that are exact."""
    n, c, n0, n1 = loop(delta, d)
    z = acb_poly([0, 1])
    numerator = z * acb_poly(list(n0)) + acb_poly(list(n1)) if d != n else acb_poly(list(n0))
    lag = z ** (2 + n if d != n else 1 + n)
    edge = isinstance(alpha, float) and alpha == 0
    wall = acb_poly([beta]) if edge else acb_poly([-arb(beta), arb(alpha) + arb(beta)])
    p = lag * (z - c) * (1 if edge else z - 1) + numerator * wall
    coefficients = p.coeffs()
    first = next(index for index, value in enumerate(coefficients) if value != 0)
    return acb_poly(coefficients[first:])


def label(alpha: float, beta: float, delta: float, d: float) -> tuple[int, float] | None:
    """The label and the spectral radius minus one (NaN if not known); None if the largest precision does not tell."""
    bits = LEAST_BITS
    while bits <= MOST_BITS:
        with flint.ctx.workprec(bits):
            p = polynomial(alpha, beta, delta, d)
            found = by_zeros(p, bits) if bits <= MOST_BITS_FOR_ZEROS else None
            found = found or by_routh(p)
        if found is not None:
            kind, margin = found
            return (ON_BOUNDARY, 0.0) if alpha == 0 and kind == STABLE else (kind, margin)
        bits *= 2
    return None


def by_zeros(p: acb_poly, bits: int) -> tuple[int, float] | None:
    """The label from balls around every zero."""
    try:
        sizes = [abs(zero) for zero in p.roots(tol=arb(2) ** (-bits // 3))]
    except ValueError:
        return None
    margin = max((float(size.mid() - 1) for size in sizes), default=-1.0)
    if all(size < 1 for size in sizes):
        return STABLE, margin
    return (UNSTABLE, margin) if any(size > 1 for size in sizes) else None


def by_routh(p: acb_poly) -> tuple[int, float] | None:
    """The label from Routh's table of p((1 + s)/(1 - s)): clusters of zeros, which are slow to separate, do no harm."""
    degree = p.degree()
    if degree > 60:
        return None
    rows = acb_poly([0])
    for power, value in enumerate(p.coeffs()):
        rows += value * acb_poly([1, 1]) ** power * acb_poly([1, -1]) ** (degree - power)
    row = [value.real for value in rows.coeffs()][::-1]
    upper, lower = row[::2], row[1::2]
    first = [upper[0]]
    while lower and all(abs(value) > 0 for value in first):
        first.append(lower[0])
        k = upper[0] / lower[0]
        tail = [*lower[1:], *[arb(0)] * (len(upper) - len(lower))]
        upper, lower = lower, [left - k * right for left, right in zip(upper[1:], tail, strict=True)]
    if not all(abs(value) > 0 for value in first):
        return None
    signs = {bool(value > 0) for value in first}
    return (STABLE if len(signs) == 1 else UNSTABLE), math.nan


def curve_point(omega: float, delta: float, d: float) -> tuple[arb, arb]:
    """The wall with poles at e^(+-j omega), model in closed form."""
    n, c, n0, n1 = loop(delta, d)
    w = arb(omega)
    z = acb(w.cos(), w.sin())
    q = -(z**n) * (z - 1) * (z - c) / (n0[0] + n0[1] * z + (n1[0] + n1[1] * z) / z)
    return q.real - (w / 2).tan() * q.imag, q.imag / w.sin()


def at_minus_one(delta: float, d: float) -> tuple[arb, arb, arb]:
    """alpha + 2 beta where a pole is at z = -1, and the wall (alpha, beta) where two are."""
    parts = [polynomial(arb(a), arb(b), delta, d) for a, b in ((0, 0), (1, 0), (0, 1))]
    # The factor z that a missing wall leaves was taken out: put it back.
    degree = max(part.degree() for part in parts)
    parts = [acb_poly([0] * (degree - part.degree()) + part.coeffs()) for part in parts]
    value = [part(acb(-1)).real for part in parts]
    slope = [part.derivative()(acb(-1)).real for part in parts]
    (v0, va, vb), (s0, sa, sb) = ([x[0], x[1] - x[0], x[2] - x[0]] for x in (value, slope))
    determinant = va * sb - vb * sa
    return -v0 / va, (vb * s0 - v0 * sb) / determinant, (v0 * sa - va * s0) / determinant


class Generator:
    """Random hard points, one family at a time."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def pick(self, values: tuple[float, ...]) -> float:
        return float(values[self.random.integers(len(values))])

    def delta(self) -> float:
        return self.pick(DELTAS) if self.random.random() < 0.7 else float(10 ** self.random.uniform(-6, 4))

    def delay(self) -> float:
        share = self.random.random()
        if share < 0.02:
            return self.pick(LONG)
        if share < 0.024:
            return self.pick(LONGEST)
        if share < 0.1:
            return float(self.random.uniform(0, 14))
        return self.pick(SHORT) if share < 0.5 else self.pick(MEDIUM)

    def nearly(self, value: arb) -> float:
        """A float64 at a relative distance of 1e-3 to 1e-15 from a value."""
        distance = 10 ** self.random.uniform(-15.3, -3) * self.random.choice([-1, 1])
        return float(value * (1 + arb(distance)))

    def curve(self) -> tuple[float, ...]:
        delta, d = self.delta(), self.delay()
        end = min(math.pi, math.pi / (d + 0.5))
        omega = end * (10 ** self.random.uniform(-8, 0) if self.random.random() < 0.2 else self.random.random())
        alpha, beta = curve_point(omega, delta, d)
        if self.random.random() < 0.5:
            return self.nearly(alpha), float(beta), delta, d
        return float(alpha), self.nearly(beta), delta, d

    def line(self) -> tuple[float, ...]:
        delta, d = max(self.delta(), 1e-3), self.pick(SHORT)
        total, corner, _ = at_minus_one(delta, d)
        alpha = abs(corner) * arb(float(self.random.uniform(0, 1.5)))
        return float(alpha), self.nearly((total - alpha) / 2), delta, d

    def corner(self) -> tuple[float, ...]:
        delta = self.pick((2.4, 3.66, 3.7, 5.0, 33.0, 50.0, 700.0, 750.0, 1e4, 1e6))
        d = self.pick(SHORT[:4])
        _, alpha, beta = at_minus_one(delta, d)
        return self.nearly(alpha), self.nearly(beta), delta, d

    def origin(self) -> tuple[float, ...]:
        """Next to (0, -delta), the end of the curve, by a few last places."""
        delta, d = self.delta(), self.delay()
        beta = -delta
        for _ in range(self.random.integers(0, 4)):
            beta = math.nextafter(beta, self.pick((-math.inf, math.inf)))
        return self.tiny_alpha(max(delta, 1e-300)), beta, delta, d

    def small_alpha(self) -> tuple[float, ...]:
        delta, d = self.delta(), self.delay()
        alpha = self.tiny_alpha(1.0) if self.random.random() < 0.8 else 0.0
        return alpha, float(self.random.uniform(-1.2, 2.5)) * max(delta, 2.0 / (1.0 + d)), delta, d

    def tiny_alpha(self, scale: float) -> float:
        if self.random.random() < 0.5:
            return self.pick((5e-324, 1e-300, 1e-200, 1e-100, 1e-30, 1e-20, 1e-16, 1e-12, 1e-8))
        return float(scale * 10 ** self.random.uniform(-20, -1))

    def wide(self) -> tuple[float, ...]:
        delta, d = self.delta(), self.delay()
        scale = (1.0 + delta) / (1.0 + d)
        alpha, beta = scale * 10 ** self.random.uniform([-9, -9], [1.5, 1.5])
        return float(alpha), float(beta * self.random.choice([-1, 1, 1])), delta, d

    def points(self, count: int) -> list[tuple[int, tuple[float, ...]]]:
        """``count`` points with a wall that is finite and not softer than none."""
        found = []
        with flint.ctx.workprec(LEAST_BITS):
            while len(found) < count:
                family = int(self.random.choice(len(FAMILIES), p=[0.5, 0.1, 0.1, 0.1, 0.1, 0.1]))
                point = getattr(self, FAMILIES[family])()
                if all(math.isfinite(value) for value in point) and point[0] >= 0:
                    found.append((family, point))
        return found


def labelled(count: int, seed: int) -> dict[str, np.ndarray]:
    """``count`` points and their labels as columns."""
    rows = []
    for family, point in Generator(seed).points(count):
        found = label(*point)
        if found is None:
            print("the oracle cannot tell:", point)
        else:
            rows.append((*point, *found, family))
    columns = dict(
        zip(("alpha", "beta", "delta", "d", "label", "margin", "family"), zip(*rows, strict=True), strict=True)
    )
    kinds = {"label": np.uint8, "family": np.uint8}
    return {name: np.array(values, kinds.get(name, np.float64)) for name, values in columns.items()}


def check(points: dict[str, np.ndarray]) -> int:
    """Hold the certified method to the labels; how many it gets wrong or leaves undecided."""
    import zwidth
    from zwidth.core.status import Status
    from zwidth.stability.rigid.certified import OPEN, filter_walls
    from zwidth.stability.rigid.normalization import wall_status

    start = time.perf_counter()
    walls = [points[name] for name in ("alpha", "beta", "delta", "d")]
    result = zwidth.decide_stability(*walls, method="certified")
    seconds = time.perf_counter() - start
    expected = np.where(points["label"] == ON_BOUNDARY, Status.ON_BOUNDARY, Status.OK)
    undecided = result.status == Status.UNDECIDED
    # Beyond the domain there is no label.
    outside = wall_status(*walls) != Status.OK
    expected = np.where(outside, Status.OUT_OF_RANGE, expected)
    wrong = ~undecided & ((result.stable != (~outside & (points["label"] == STABLE))) | (result.status != expected))
    for index in np.flatnonzero(wrong | undecided)[:20]:
        print([points[name][index] for name in points], [values[index] for values in result])
    by_filter = np.mean(filter_walls(*walls) != OPEN)
    print(f"{wrong.size} points in {seconds:.1f} s: {wrong.sum()} wrong, {undecided.sum()} undecided; ", end="")
    print(f"filter {by_filter:.1%}")
    return int(wrong.sum() + undecided.sum())


def main() -> None:
    """Generate, label, check, and write a part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=24_000)
    parser.add_argument("--kept", type=int, default=4_000)
    arguments = parser.parse_args()
    points = labelled(arguments.points, seed=20_060_314)
    for family, name in enumerate(FAMILIES):
        mine = points["family"] == family
        share = [float(np.mean(points["label"][mine] == value)) for value in (UNSTABLE, STABLE, ON_BOUNDARY)]
        print(f"{name}: {mine.sum()} points; unstable, stable, on the boundary: {share}")
    if check(points):
        raise SystemExit("the certified method is wrong or undecided somewhere: nothing written")
    kept: dict[str, Any] = {name: values[: arguments.kept] for name, values in points.items()}
    np.savez_compressed(OUTPUT, **kept)
    print(f"{OUTPUT.name}: {OUTPUT.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
