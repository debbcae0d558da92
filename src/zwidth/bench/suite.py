"""The measurements: every method on maps, scattered walls and ridges, for short delays and long ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np

from zwidth.bench import problems
from zwidth.bench.baselines import available
from zwidth.bench.problems import Walls
from zwidth.stability import balls
from zwidth.stability.certified import certified_stable, filtered
from zwidth.stability.certified_rows import OPEN, STABLE
from zwidth.stability.labels import is_stable
from zwidth.stability.layout import lay_out
from zwidth.stability.radii import spectral_radius
from zwidth.stability.ridge import RidgeMethod, alpha_max

FILTER, NO_BETA, NO_DELTA = "certified, filter alone", "companion, beta = 0", "companion, delta = 0"
# A measurement is repeated until it has taken this long, and at least this often.
_SECONDS = 0.4
_LEAST, _MOST = 3, 40
_RADIUS_ACCURACY = 1e-9
# Beyond these delays a method takes minutes to compile, or days to run.
_LONGEST = {"schur_cohn": 50, "companion": 50, "newton": 50, "bisection": 50, "certified": 500}


@dataclass(frozen=True)
class Row:
    """What was measured of one method on one problem.

    Attributes:
        quantity: "stable", "spectral_radius" or "alpha_max".
        method: the method's name; a baseline's is that of the tool.
        dtype: "float64" or "float32".
        layout: "map" (axes of one device) or "scattered" (every point a device of its own).
        d: delay in periods.
        points: how many were computed at once.
        first_seconds: what the first call takes longer than a later one: compilation, on a cold cache.
        rate: points a second of later calls, by their median.
        error: of "stable", the largest relative distance in alpha from the boundary at which a label was wrong; of
            "spectral_radius" and "alpha_max", the largest relative error; 0 where none was seen.
        wrong: how many of ``checked`` labels were wrong; of other quantities, 0.
        checked: how many points the error was measured on, against ball arithmetic.
        baseline: whether it is a tool for comparison.
        open: which share of the points with alpha > 0 it leaves undecided, where it may.
    """

    quantity: str
    method: str
    dtype: str
    layout: str
    d: float
    points: int
    first_seconds: float
    rate: float
    error: float
    wrong: int
    checked: int
    baseline: bool = False
    open: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    delays: tuple[float, ...]
    map_points: int
    largest_map: int
    checked: int
    roots: int


FULL = Sizes((0.0, 1.0, 4.0, 8.0, 50.0, 500.0), 4_000_000, 100_000_000, 1_200, 60)
QUICK = Sizes((0.0, 1.0, 4.0), 250_000, 4_000_000, 240, 20)


def clock(call: Callable[[], Any]) -> tuple[float, float]:
    """Seconds that the first call took longer, and the median of the later ones."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - start
    durations: list[float] = []
    while len(durations) < _LEAST or (sum(durations) < _SECONDS and len(durations) < _MOST):
        start = time.perf_counter()
        jax.block_until_ready(call())
        durations.append(time.perf_counter() - start)
    warm = float(np.median(durations))
    return max(0.0, first - warm), warm


def measure(sizes: Sizes, tell: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Run every measurement; ``tell`` hears what is measured next.

    Errors are measured against ball arithmetic, so python-flint (extra ``certified``) must be installed.
    """
    rows = []
    for d in sizes.delays:
        tell(f"d = {d:g}: stable or not")
        rows += _labels(d, sizes)
        tell(f"d = {d:g}: spectral radius")
        rows += _radii(d, sizes)
        tell(f"d = {d:g}: stiffest wall")
        rows += _ridges(d)
    tell("size of the map")
    rows += _growing_maps(sizes)
    return rows


def _fewer(points: int, d: float) -> int:
    """As many points as take about the same time at long delays; where all poles are computed, far fewer."""
    slower = (1.0 + d / 8.0) ** 2 if points <= 20_000 else 1.0 + d / 40.0
    return max(16, int(points / slower))


def _possible(method: str, d: float) -> bool:
    return d <= _LONGEST.get(method, np.inf)


def label_error(classify: Callable[[Walls], Any], d: float, points: int) -> tuple[float, int, int]:
    """The farthest wrong label, how many are wrong, and of how many."""
    truth = problems.near_boundary(d, points)
    wrong = np.asarray(classify(truth.walls)) != truth.stable
    return float(np.max(truth.distance, initial=0.0, where=wrong)), int(wrong.sum()), int(wrong.size)


def radius_error(radius: Callable[[Walls], Any], d: float, points: int) -> tuple[float, int, int]:
    """The largest relative error."""
    walls, exact = problems.with_radius(d, points)
    return float(np.max(np.abs(np.asarray(radius(walls)) - exact) / exact)), 0, exact.size


def _labels(d: float, sizes: Sizes) -> Iterator[Row]:
    cases = [("boundary", "float64"), ("schur_cohn", "float64"), ("schur_cohn", "float32"), ("companion", "float64")]
    cases += [("certified", "float64")]
    for method, dtype in cases:
        if not _possible(method, d):
            continue

        def classify(walls: Walls, method: Any = method, dtype: str = dtype) -> Any:
            return is_stable(*walls, method=method, dtype=dtype if dtype == "float32" else None)

        error = label_error(classify, d, sizes.checked)
        slow = {"companion": 20_000, "certified": sizes.map_points // 4}
        for layout, make, points in (
            ("map", problems.grid, sizes.map_points),
            ("scattered", problems.scattered, sizes.map_points // 16),
        ):
            walls = make(d, _fewer(min(points, slow.get(method, points)), d))
            first, warm = clock(lambda classify=classify, walls=walls: classify(walls))
            yield Row("stable", method, dtype, layout, d, walls.points, first, walls.points / warm, *error)
    if _possible("certified", d):
        yield _filter_alone(d, sizes)


def _filter_alone(d: float, sizes: Sizes) -> Row:
    """What of "certified" runs at every point, and how much of a map it leaves to signs and balls."""
    truth = problems.near_boundary(d, sizes.checked)
    code = filtered(lay_out(truth.walls).points)
    wrong = (code < OPEN) & ((code == STABLE) != truth.stable)
    error = float(np.max(truth.distance, initial=0.0, where=wrong)), int(wrong.sum()), int(wrong.size)
    walls = problems.grid(d, _fewer(sizes.map_points, d))
    points = lay_out(walls).points
    first, warm = clock(lambda: filtered(points))
    # Walls without stiffness are left to signs.
    left = float(np.mean((filtered(points) == OPEN)[:, points.alpha[0] > 0]))
    rate = walls.points / warm
    return Row("stable", FILTER, "float64", "map", d, walls.points, first, rate, *error, open=left)


def _radii(d: float, sizes: Sizes) -> Iterator[Row]:
    for method in ("newton", "bisection", "companion"):
        if not _possible(method, d):
            continue
        accuracy = None if method == "companion" else _RADIUS_ACCURACY

        def radius(walls: Walls, method: Any = method, accuracy: float | None = accuracy) -> Any:
            return spectral_radius(*walls, method=method, accuracy=accuracy)

        error = radius_error(radius, d, sizes.roots)
        largest = {"newton": sizes.map_points // 4}.get(method, 20_000)
        for layout, make in (("map", problems.grid), ("scattered", problems.scattered)):
            walls = make(d, _fewer(largest if layout == "map" else min(largest, 100_000), d))
            first, warm = clock(lambda radius=radius, walls=walls: radius(walls))
            yield Row("spectral_radius", method, "float64", layout, d, walls.points, first, walls.points / warm, *error)
        if method == "companion":
            yield from _smaller_loops(d, error)
    for name, tool in available().items():
        if d > 50 or (tool.only_whole and d != int(d)):
            continue
        error = radius_error(tool.radius, d, sizes.roots)
        walls = problems.scattered(d, max(20, _fewer(tool.points, d)))
        first, warm = clock(lambda tool=tool, walls=walls: tool.radius(walls))
        rate = walls.points / warm
        yield Row("spectral_radius", name, "float64", "scattered", d, walls.points, first, rate, *error, baseline=True)


def _smaller_loops(d: float, error: tuple[float, int, int]) -> Iterator[Row]:
    """All poles where a part of the loop is missing; the errors are those of the whole loop."""
    walls = problems.grid(d, _fewer(20_000, d))
    for name, smaller in (
        (NO_BETA, walls._replace(beta=0 * walls.beta)),
        (NO_DELTA, walls._replace(delta=np.zeros(1))),
    ):
        listed = smaller.listed()
        first, warm = clock(lambda listed=listed: spectral_radius(*listed, method="companion"))
        yield Row("spectral_radius", name, "float64", "map", d, listed.points, first, listed.points / warm, *error)


def ridge_error(d: float, method: RidgeMethod = "newton") -> tuple[float, int, int]:
    """The least relative distance at which walls short of the ridge and beyond it are proved stable and unstable.

    They lie on the line from the start of the boundary, (0, -delta), through the ridge: straight below a corner, walls
    of the same beta may be unstable.
    """
    # For stronger damping the stable walls below the corner lie closer together than float64 numbers beta.
    delta = np.concatenate([[0.0], 10.0 ** np.linspace(-8, 1, 37)])
    top = alpha_max(delta, d, method=method)
    alpha, beta = np.asarray(top.alpha), np.asarray(top.beta)
    error = np.full(delta.size, np.inf)
    for distance in (1e-6, 1e-9, 1e-11, 1e-12, 1e-13, 1e-14, 4e-15, 1e-15):
        below, above = (
            certified_stable(scale * alpha, scale * (beta + delta) - delta, delta, d)
            for scale in (1 - distance, 1 + distance)
        )
        error[below.stable & ~above.stable & (below.status == 0) & (above.status == 0)] = distance
    return float(error.max()), 0, delta.size


def _ridges(d: float) -> Iterator[Row]:
    cases: tuple[tuple[RidgeMethod, int], ...] = (("newton", 200_000), ("kkt", 2_000))
    for method, points in cases:
        delta = 10.0 ** np.linspace(-4, 2, points)
        if method == "kkt" and d > 50:
            continue
        error = ridge_error(d, method)
        first, warm = clock(lambda delta=delta, method=method: alpha_max(delta, d, method=method).alpha)
        yield Row("alpha_max", method, "float64", "scattered", d, points, first, points / warm, *error)


def _growing_maps(sizes: Sizes) -> Iterator[Row]:
    points = 10_000
    while points <= sizes.largest_map:
        walls = problems.grid(4.0, points)
        first, warm = clock(lambda walls=walls: is_stable(*walls, method="boundary"))
        error = label_error(lambda walls: is_stable(*walls, method="boundary"), 4.0, sizes.checked)
        yield Row("stable", "boundary", "float64", "map", 4.0, walls.points, first, walls.points / warm, *error)
        points *= 10


def can_measure() -> bool:
    """Whether what errors are measured against is installed."""
    return balls.available()
