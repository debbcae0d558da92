"""Measurements: every method on maps, scattered walls and single walls, for short and long delays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from methods import precisions, problems
from methods.baselines import available
from methods.clock import time_calls
from methods.problems import Walls
from zwidth.stability.rigid import certified
from zwidth.stability.rigid.dominant.spectral_radius import spectral_radius
from zwidth.stability.rigid.passivity import is_passive, passivity_margin
from zwidth.stability.rigid.poles import poles
from zwidth.stability.rigid.ridge import RidgeMethod, alpha_max
from zwidth.stability.rigid.verdict import StabilityMethod, decide_stability, is_stable

# Minimum total time in s and minimum number of repetitions of a measurement.
_SECONDS = 0.4
_LEAST, _MOST = 3, 40
# Beyond these delays, a method takes minutes to compile or days to run.
_LONGEST = {"companion": 50, "aberth": 21, "kkt": 50}
_LONGEST_BASELINE = 50


@dataclass(frozen=True)
class Row:
    """Measurements of one method on one problem.

    The error of "stable" is the largest relative distance in alpha from the boundary at which a label was wrong, 0 if
    none was. For other quantities it is the largest relative error, for "passive" that of the required damping.
    """

    quantity: str  # "stable", "spectral_radius", "passive" or "alpha_max"
    method: str  # name of the tool for baselines
    layout: str  # "map" (axes of one device), "scattered" (one device per point) or "one" (a single number)
    d: float
    points: int  # computed in one call
    first_seconds: float  # additional time of the first call: compilation with a cold cache
    rate: float  # points per second, median of later calls
    error: float
    wrong: int  # number of wrong labels, or of spectral radii that are NaN; 0 for other quantities
    checked: int  # number of points at which the error was measured, in extended precision
    baseline: bool = False  # whether the method is an alternative tool


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements."""

    delays: tuple[float, ...]
    map_points: int
    largest_map: int
    checked: int
    roots: int


# In the full benchmark, grids and lists of walls have enough points for compiled code; NumPy computes fewer points.
FULL = Sizes((0.0, 1.0, 4.0, 8.0, 50.0, 500.0, 10_000.0), 4_000_000, 100_000_000, 6_000, 60)
QUICK = Sizes((0.0, 4.0, 500.0), 250_000, 1_000_000, 240, 20)

# Errors of one method: largest error, number of wrong labels, number of checked points.
Error = tuple[float, int, int]


def clock(call: Callable[[], Any]) -> tuple[float, float]:
    """Return the additional time of the first call and the median time of later calls, in s."""
    first = time_calls(call, 1)[0].item()
    warm = float(np.median(time_calls(call, _LEAST, _MOST, _SECONDS)[0]))
    return max(0.0, first - warm), warm


def measure(sizes: Sizes, tell: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Run all measurements; ``tell`` is called with the name of the next one.

    Errors are measured against ball arithmetic, which requires python-flint (extra ``certified``).
    """
    rows = []
    for d in sizes.delays:
        tell(f"d = {d:g}: stable or not")
        rows += _labels(d, sizes)
        tell(f"d = {d:g}: spectral radius")
        rows += _radii(d, sizes)
        tell(f"d = {d:g}: passive or not")
        rows += _passive(d, sizes)
        tell(f"d = {d:g}: stiffest wall")
        rows += _ridges(d, sizes)
        tell(f"d = {d:g}: float32 and mixed precision")
        rows += _precisions(d, sizes)
    tell("size of the map")
    rows += _growing_maps(sizes)
    return rows


def _fewer(points: int, d: float) -> int:
    """Return the number of points for about equal time if all poles are computed."""
    return max(16, int(points / (1.0 + d / 8.0) ** 2))


def _possible(method: str, d: float) -> bool:
    return d <= _LONGEST.get(method, np.inf)


def label_error(classify: Callable[[Walls], Any], d: float, points: int) -> Error:
    """Return the largest distance of a wrong label, the number of wrong labels, and of checked labels."""
    truth = problems.near_boundary(d, points)
    wrong = np.asarray(classify(truth.walls)) != truth.stable
    return float(np.max(truth.distance, initial=0.0, where=wrong)), int(wrong.sum()), int(wrong.size)


def radius_error(radius: Callable[[Walls], Any], d: float, points: int) -> Error:
    """Return the largest relative error of spectral radii, and the number of radii that are NaN."""
    walls, exact = problems.with_radius(d, points)
    error = np.abs(np.asarray(radius(walls)) - exact) / exact
    known = ~np.isnan(error)
    return float(np.max(error, initial=0.0, where=known)), int((~known).sum()), exact.size


def map_error(radius: Any, walls: Walls, checked: int = 2_000) -> Error:
    """Return the largest relative error of some radii of a map, compared with computing these walls alone."""
    picked = np.random.default_rng(5).choice(radius.size, min(checked, radius.size), replace=False)
    place = np.unravel_index(picked, radius.shape)
    alone = spectral_radius(*(np.broadcast_to(part, radius.shape)[place] for part in walls))
    known = np.isfinite(alone)
    return float(np.max(np.abs(radius[place] / alone - 1.0)[known])), 0, int(known.sum())


def largest(z: Any) -> np.ndarray:
    """Return the largest modulus of the poles of each wall."""
    return np.abs(z).max(axis=-1)


def passive_error(d: float, points: int) -> Error:
    """Return the largest relative error of the damping required for passivity."""
    walls, exact = problems.with_needed_damping(d, points)
    needed = -np.asarray(passivity_margin(*walls))
    return float(np.max(np.abs(needed - exact) / exact)), 0, exact.size


def _time_layouts(
    quantity: str, method: str, d: float, error: Error, call: Callable[[Walls], Any], points: dict[str, int]
) -> Iterator[Row]:
    """Return one row per layout with its number of points."""
    make = {"map": problems.grid, "scattered": problems.scattered, "one": problems.single}
    for layout, count in points.items():
        walls = make[layout](d, count)
        first, warm = clock(partial(call, walls))
        yield Row(quantity, method, layout, d, walls.points, first, walls.points / warm, *error)


def _labels(d: float, sizes: Sizes) -> Iterator[Row]:
    methods: tuple[StabilityMethod, ...] = ("crossover", "companion", "certified")
    for method in methods:
        if not _possible(method, d):
            continue

        def classify(walls: Walls, method: StabilityMethod = method) -> Any:
            return is_stable(*walls, method=method)

        slow = method == "companion"
        error = label_error(classify, d, min(sizes.checked, 1_200) if slow else sizes.checked)
        points = {"map": sizes.map_points, "scattered": sizes.map_points // 4, "one": 1}
        if slow:
            points = {"map": _fewer(20_000, d), "scattered": _fewer(20_000, d)}
        elif method == "certified":
            points = {"map": sizes.map_points // 4, "scattered": sizes.map_points // 4}
        yield from _time_layouts("stable", method, d, error, classify, points)


def _radii(d: float, sizes: Sizes) -> Iterator[Row]:
    few, many = _fewer(20_000, d), sizes.map_points // 4
    some = min(many, 8 * few)
    cases: tuple[tuple[str, Callable[[Walls], Any], dict[str, int]], ...] = (
        ("newton", lambda walls: spectral_radius(*walls, method="newton"), {"map": many, "scattered": many, "one": 1}),
        ("companion", lambda walls: spectral_radius(*walls, method="companion"), {"map": few, "scattered": few}),
        # All poles, as from the companion matrix; the reference is for their largest modulus.
        ("aberth", lambda walls: largest(poles(*walls, method="aberth")), {"map": some, "scattered": some}),
    )
    for method, radius, points in cases:
        if not _possible(method, d):
            continue
        yield from _time_layouts("spectral_radius", method, d, radius_error(radius, d, sizes.roots), radius, points)
    # Speed and accuracy of maps: the same walls at each accuracy, compared with single calls.
    plane = problems.grid(d, sizes.map_points)
    for accuracy in (1e-9, 1e-12):
        call = partial(spectral_radius, *plane, accuracy=accuracy)
        first, warm = clock(call)
        error = map_error(call(), plane)
        yield Row("spectral_radius", f"map to {accuracy:g}", "map", d, plane.points, first, plane.points / warm, *error)
    for name, tool in available().items():
        if d > _LONGEST_BASELINE or (tool.only_whole and d != int(d)):
            continue
        error = radius_error(tool.radius, d, sizes.roots)
        walls = problems.scattered(d, max(20, _fewer(tool.points, d)))
        first, warm = clock(partial(tool.radius, walls))
        rate = walls.points / warm
        yield Row("spectral_radius", name, "scattered", d, walls.points, first, rate, *error, baseline=True)


def _passive(d: float, sizes: Sizes) -> Iterator[Row]:
    points = {"map": sizes.map_points // 4, "scattered": sizes.map_points // 4, "one": 1}
    # The reference refines all maxima of a bound that oscillates d times.
    error = passive_error(d, min(sizes.roots, 20))
    yield from _time_layouts("passive", "worst frequency", d, error, lambda walls: is_passive(*walls), points)


def ridge_error(d: float, find_maximum: Callable[[np.ndarray, float], Any]) -> Error:
    """Return the smallest relative distance at which a wall below alpha_max is certified stable, one above unstable.

    Both walls lie on the line from the start of the stability boundary, (alpha, beta) = (0, -delta), through the
    maximum, because walls of the same beta just below a corner of the boundary may be unstable.

    Args:
        d: delay in periods.
        find_maximum: function that returns alpha_max and its beta for an array delta, whose values are exact in
            float32, and the delay d.
    """
    # For stronger damping, the stable range of beta below the corner is narrower than the float64 spacing.
    delta = np.float32(np.concatenate([[0.0], 10.0 ** np.linspace(-8, 1, 37)])).astype(float)
    alpha, beta = (np.asarray(part, float) for part in find_maximum(delta, d)[:2])
    error = np.full(delta.size, np.inf)
    for distance in (1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7, 1e-9, 1e-11, 1e-12, 1e-13, 1e-14, 4e-15, 1e-15):
        below, above = (
            decide_stability(scale * alpha, scale * (beta + delta) - delta, delta, d, method="certified")
            for scale in (1 - distance, 1 + distance)
        )
        error[below.stable & ~above.stable & (below.status == 0) & (above.status == 0)] = distance
    return float(error.max()), 0, delta.size


def _ridges(d: float, sizes: Sizes) -> Iterator[Row]:
    cases: tuple[tuple[RidgeMethod, int], ...] = (("newton", sizes.map_points // 4), ("kkt", 2_000))
    for method, points in cases:
        if not _possible(method, d):
            continue
        error = ridge_error(d, partial(alpha_max, method=method))
        for layout, count in (("scattered", points), ("one", 1))[: 2 if method == "newton" else 1]:
            delta: Any = 10.0 ** np.linspace(-4, 2, count) if count > 1 else problems.MAP_DELTA
            first, warm = clock(partial(alpha_max, delta, d, method=method))
            yield Row("alpha_max", method, layout, d, count, first, count / warm, *error)


def _precisions(d: float, sizes: Sizes) -> Iterator[Row]:
    """Return one row per quantity and precision, for functions inside `jit` and JAX arrays of scattered walls."""
    walls = problems.scattered(d, sizes.map_points // 4)

    def measured(quantity: str, precision: str, function: Any, dtype: str, points: int, error: Error) -> Row:
        first, warm = clock(precisions.prepare(function, [part[:points] for part in walls], dtype))
        return Row(quantity, f"jit {precision}", "scattered", d, points, first, points / warm, *error)

    for precision, (labels, dtype) in precisions.LABELS.items():
        error = label_error(lambda some, f=labels, t=dtype: precisions.evaluate_walls(f, some, t), d, sizes.checked)
        yield measured("stable", precision, labels, dtype, walls.points, error)
    for dtype in ("float64", "float32"):
        error = radius_error(lambda some, t=dtype: precisions.evaluate_walls(spectral_radius, some, t), d, sizes.roots)
        yield measured("spectral_radius", dtype, spectral_radius, dtype, walls.points // 16, error)

        def find_maximum(delta: Any, d: Any, dtype: str = dtype) -> Any:
            return precisions.prepare(alpha_max, (delta, d), dtype)()

        error = ridge_error(d, find_maximum)
        yield measured("alpha_max", dtype, precisions.find_alpha, dtype, walls.points // 4, error)


def _growing_maps(sizes: Sizes) -> Iterator[Row]:
    error = label_error(lambda walls: is_stable(*walls), 4.0, sizes.checked)
    points = 10_000
    while points <= sizes.largest_map:
        yield from _time_layouts("stable", "crossover", 4.0, error, lambda walls: is_stable(*walls), {"map": points})
        points *= 10


def can_measure() -> bool:
    """Return True if the reference implementation, python-flint, is installed."""
    return certified.available() and find_spec("mpmath") is not None
