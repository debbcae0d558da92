"""Optimal walls of a scene: the stiffest wall, its sensitivities, parameters for a required K_max, the best damping.

K and B are the stiffness and damping of a wall. K_max is the stiffness of the stiffest stable wall that is *connected
to K = 0*, i.e. that a path of stable walls connects to K = 0. The *surplus* of a parameter value is ``log(K_max/K)``
for a required stiffness K: the value is sufficient if the surplus is nonnegative. `SceneOptima.required` samples the
surplus on a grid, refines extrema between grid points that may reach zero, and finds each sign change by Brent's method
(Brent 1973). `SceneOptima.best_damping` minimizes the spectral radius, or maximizes the modulus margin, by a global
one-dimensional search. The computations in alpha and beta (K and B in units of m/T^2 and m/T, with the mass m of the
device and the period T) are those of `zwidth.analysis.loop`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np

from zwidth.analysis.joint_damping import add_joint_dampings
from zwidth.analysis.walls import SceneAnalysis, allows_negative
from zwidth.core.errors import InputError, check_choice, describe_choice
from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import is_jax, is_traced
from zwidth.model.checks import read_texts
from zwidth.model.wall import resolve_wall
from zwidth.numerics.root_finding import find_global_minimum
from zwidth.stability.linear.derivatives import SceneSensitivities
from zwidth.stability.linear.margins import find_modulus_margins, tabulate
from zwidth.units.display import compact_repr
from zwidth.units.parsing import to_float
from zwidth.units.quantities import FIELDS, WALL

# Relative tolerance by which the stable interval of K may end below K_max at the damping of the stiffest wall, because
# K_max has a numerical error.
STIFFNESS_TOLERANCE = 1e-6


@compact_repr(frequency="Hz", kind=RidgeKind)
class StiffestWall(NamedTuple):
    """The stiffest stable wall in SI units, with the kind of its optimum (`zwidth.RidgeKind`) and a `zwidth.Status`."""

    stiffness: Array
    virtual_damping: Array
    frequency: Array
    kind: Array
    status: Array


def explain_missing(scene: SceneAnalysis, status: Any) -> str:
    """Return a text with the reason why a scene has no stiffest wall, from the status code of the search."""
    if status == Status.NO_BOUNDARY:
        allowed = "" if allows_negative(scene, None) else " with B >= 0"
        if scene.loop.has_pieces and scene.islands():
            return f"no stable wall{allowed} is connected to K = 0; the stable walls are on islands"
        return f"no stiffness is stable at any damping{allowed}"
    explained = scene.loop.explain_limit() if status in (Status.UNDECIDED, Status.NOT_CONVERGED) else ""
    return explained or Status(int(status)).message


def choose_damping(scene: SceneAnalysis, top: StiffestWall, stiffness: float) -> float:
    """Choose the damping in N s/m of a wall whose stiffness is below that of the stiffest wall ``top``.

    This is the damping of ``top`` if all walls with this damping between the two stiffnesses are stable. Otherwise it
    is the middle of the widest stable interval that is connected to K = 0, if one exists.
    """
    damping = float(top.virtual_damping)
    intervals = scene.stable_stiffness(damping)
    if np.any((intervals[:, 0] < stiffness) & (intervals[:, 1] > (1.0 - STIFFNESS_TOLERANCE) * top.stiffness)):
        return damping
    connected = find_connected_dampings(scene, stiffness)
    low, high = max(connected, key=lambda ends: ends[1] - ends[0], default=(math.nan, math.nan))
    return 0.5 * (low + high) * scene.units.virtual_damping if connected else damping


def find_connected_dampings(
    scene: SceneAnalysis, stiffness: float, negative_damping: bool | None = None
) -> list[tuple[float, float]]:
    """Return the intervals of beta in which walls with the given K in N/m are stable and connected to K = 0."""
    least = -math.inf if allows_negative(scene, negative_damping) else 0.0
    return scene.loop.find_connected_beta(stiffness / scene.units.stiffness, least)


# Settings of `SceneOptima.required`, which finds the parameter value at which K_max equals a required stiffness.
REACH = 30.0  # default range: from the current value divided by this factor to the current value times it
N_POINTS = 25  # grid points in the range, geometrically spaced
MAX_PERIODS = 1000.0  # longest delay of the default range, in periods, unless the current delay is longer
SAME_VALUE = 1e-9  # relative distance from the current value below which it replaces a grid point
# Relative distances from a crossing at which the surplus is evaluated on both sides. The smallest distance at which
# both values have different signs confirms the crossing.
CONFIRMATION_DISTANCES = (1e-11, 1e-9, 1e-7, 1e-5)
# Options of the bounded minimizer of SciPy; ``xatol`` is the absolute tolerance of the logarithm of the parameter.
EXTREMUM_OPTIONS = {"xatol": 1e-6}
NO_STIFFNESS = 60.0  # negative of the surplus if no wall is stable, which corresponds to K_max = exp(-60) K

Side = Literal["above", "below", "everywhere", "nowhere"]
SIDES: tuple[Side, ...] = get_args(Side)


class Crossing(NamedTuple):
    """A parameter value at which K_max equals the required stiffness, and the side on which K_max is sufficient."""

    value: float
    sufficient_side: Side


@compact_repr()
class RequiredValue(NamedTuple):
    """Required value of a parameter, the side on which K_max is sufficient, and all crossings found, ascending."""

    value: float
    sufficient_side: Side
    crossings: tuple[Crossing, ...]
    range: tuple[float, float]
    status: Status


def _read_stiffness(value: Any, unit: str) -> float:
    """Convert a stiffness, a number or a text with a unit, to a float in the SI unit; raise `InputError` if <= 0."""
    stiffness = read_texts("stiffness", value, unit)
    if not (isinstance(stiffness, int | float | np.number) and math.isfinite(to_float(stiffness)) and stiffness > 0):
        raise InputError(f"stiffness: got {stiffness!r}; it must be finite and greater than 0 (in {unit})")
    return float(stiffness)


def _get_present_value(scene: SceneAnalysis, parameter: str) -> float:
    """Return the current value of a parameter; raise `InputError` if the parameter cannot be varied continuously."""
    values = {path: value for path, value in scene.parameters().items() if path not in WALL}
    values["rate"] = 1.0 / values["period"]
    if not isinstance(parameter, str) or parameter not in values:
        raise InputError(f"parameter: {describe_choice(parameter, tuple(values))}")
    if isinstance(values[parameter], int | np.integer):
        raise InputError(f"parameter: got {parameter!r}, which must be an integer; evaluate its values one by one")
    return float(values[parameter])


def _choose_range(
    scene: SceneAnalysis, parameter: str, now: float, within: tuple[Any, Any] | None
) -> tuple[float, float]:
    """Return the range in which to search a parameter: ``within``, or by default around its current value ``now``."""
    if within is None:
        timing = scene.timing
        if not now > 0:
            raise InputError(f"within: {parameter} is 0 now; pass the range to search, such as within=(0.1, 10)")
        # Limit the range, because the run time increases with the square of the delay in periods, and because a cutoff
        # must be below the Nyquist frequency.
        fixed = 0.0 if timing.in_periods else timing.delay
        longest = max(float(timing.delay / timing.period), MAX_PERIODS)
        ends = {
            "delay": (0.0, longest * timing.period),
            "period": (fixed / longest, math.inf),
            "rate": (0.0, longest / fixed if fixed else math.inf),
            "velocity.cutoff": (0.0, 0.499 / (getattr(scene.velocity, "coded_period", None) or timing.period)),
        }
        low, high = ends.get(parameter, (0.0, math.inf))
        return max(now / REACH, float(low)), min(now * REACH, float(high))
    low, high = (to_float(end) for end in read_texts("within", within, scene.unit_system[FIELDS[parameter].unit]))
    if not 0 < low < high < math.inf:
        raise InputError(f"within: got {within!r}; pass two finite numbers with 0 < low < high")
    return low, high


def _find_extrema(surplus: Callable[[float], float], grid: list[float], values: list[float]) -> list[float]:
    """Return the parameter values at local extrema of the surplus that may differ in sign from nearby grid points.

    These are maxima close to grid points with negative surplus, and minima close to those with nonnegative surplus.
    ``values`` holds the surplus at the parameter values ``grid``.
    """
    from scipy.optimize import minimize_scalar

    extrema = []
    for k in range(1, len(grid) - 1):
        sign = 1.0 if values[k] >= 0 else -1.0
        if sign * values[k - 1] > sign * values[k] < sign * values[k + 1]:
            ends = math.log(grid[k - 1]), math.log(grid[k + 1])
            extremum = minimize_scalar(
                lambda x, sign=sign: sign * surplus(math.exp(x)),
                bounds=ends,
                method="bounded",
                options=EXTREMUM_OPTIONS,
            )
            extrema.append(math.exp(extremum.x))
    return extrema


def _find_crossing(surplus: Callable[[float], float], low: float, high: float) -> Crossing | None:
    """Find the crossing between two values by Brent's method; None unless the signs on both sides confirm it."""
    from scipy.optimize import brentq

    try:
        root = brentq(lambda x: surplus(min(max(math.exp(x), low), high)), math.log(low), math.log(high))
    except ValueError:
        # Return no crossing, because Brent's method has reached a parameter value at which K_max cannot be computed.
        return None
    value = math.exp(cast("float", root))
    for distance in CONFIRMATION_DISTANCES:
        ends = value * (1.0 - distance), value * (1.0 + distance)
        below, above = (surplus(end) >= 0 for end in ends)
        if below != above:
            return Crossing(ends[1], "above") if above else Crossing(ends[0], "below")
    return None


Goal = Literal["fast", "robust"]

N_SAMPLES = 66  # values of B at which `best_damping` evaluates each stable interval before it refines the minima


@compact_repr()
class BestDamping(NamedTuple):
    """Optimal virtual damping in N s/m, with its spectral radius and modulus margin, and a code of `zwidth.Status`."""

    virtual_damping: float
    spectral_radius: float
    modulus_margin: float
    status: Status


class SceneOptima(SceneAnalysis):
    """Base class of `zwidth.Scene` with methods that search for optimal walls and for required parameter values."""

    def max_stiffness(self, *, negative_damping: bool | None = None) -> StiffestWall:
        """Return the stiffest stable wall connected to K = 0, and the kind of its optimum.

        K_max is ``sup {K : some B is stable}`` over the pieces of the stable set that are connected to K = 0 by paths
        of stable walls. All other pieces are `islands`. If the device is unstable without a wall, no piece may be
        connected to K = 0; then the piece with the softest stable walls counts. With filters or flexible parts, the
        stable set may be inclined near the stiffest wall, so that no softer wall with the same damping is stable;
        `recommend` returns a wall for use.

        Args:
            negative_damping: True if walls with B < 0 count. By default they count only for a `Device` with the
                backward difference and without a tool. With a filter a negative B is a lead compensator; with a
                `LinearDevice` or a `MeasuredDevice` it would cancel damping of the model, which is unsafe. The pieces
                of the stable set do not depend on this argument: a path may lead through B < 0.

        Returns:
            ``stiffness`` in N/m; ``virtual_damping`` in N s/m; ``frequency`` in Hz of the pole pair on the unit circle,
            at a corner that of the higher one; ``kind``, a code of `zwidth.RidgeKind`; ``status``, a code of
            `zwidth.Status`. Unless it is 0, all values are NaN; NO_BOUNDARY: no such wall with K > 0 is stable.

        Numerics:
            Closed form for a rigid device. Otherwise the highest point of all edges of the stable set, with a relative
            error of about 1e-13 (larger for modes that decay by less than 1e-3 per period, except undamped ones).
            NOT_CONVERGED if lines of constant B contradict the result. Inside JAX transformations the result is the
            same, with first and second derivatives in every number of the scene, including delay and period.

        Example:
            >>> import zwidth
            >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=100))
            >>> print(f"{scene.max_stiffness().stiffness:.0f} N/m")
            11942 N/m
        """
        if self.nonrigid_parts and self.traced_path is not None:
            alpha, beta, omega, kind, status = self.traced_loop.trace_stiffest(negative_damping)
        else:
            alpha, beta, omega, kind, status = self.loop.stiffest(allows_negative(self, negative_damping))
        mass, period = (value if is_traced(value) else float(value) for value in (self.mass, self.timing.period))
        rate = mass / period
        # Multiply the factors in the same order as `zwidth.max_stiffness`, so that both results are equal.
        values = (alpha * rate / period, beta * rate, omega / (2.0 * math.pi * period), kind, status)
        return StiffestWall(*(value if is_jax(value) else np.asarray(value)[()] for value in values))

    def sensitivities(self, *, negative_damping: bool | None = None) -> SceneSensitivities:
        """Return the derivatives of K_max with respect to every parameter of every part.

        Args:
            negative_damping: as for `max_stiffness`.

        Returns:
            ``stiffness``, K_max in N/m; ``per``, its derivatives by dotted path ("mass", "velocity.cutoff",
            "operator.mass", ...) in N/m per SI unit, each with all other parameters constant (the delay in the unit in
            which it was given, seconds or periods); ``status``, NOT_CONVERGED if a derivative is NaN. Without a K_max
            all derivatives are NaN. Integers and coefficients of a filter have no derivative. For a value of zero, and
            at an integer delay of a linear system without inertia, the derivative is one-sided, for an increase.

        Numerics:
            Closed form for a rigid device. Otherwise implicit derivatives of the active constraints, some ms per
            parameter, with a relative error of 1e-6; if a derivative is nearly 0, the absolute error is 1e-11 times
            K_max divided by the parameter (1e-9 with a spring ten million times as stiff as the wall). Derivatives
            with respect to joint dampings are numerical differences of K_max.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> print(f"{scene.sensitivities().per['damping']:.0f} N/m per N s/m")
            572 N/m per N s/m
        """
        if self.traced_path is not None:
            return self.traced_loop.trace_sensitivities(negative_damping)
        result = self.loop.sensitivities(allows_negative(self, negative_damping))
        return add_joint_dampings(self, result, lambda scene: scene.max_stiffness(negative_damping=negative_damping)[0])

    def required(
        self,
        parameter: str,
        stiffness: float | str,
        *,
        within: tuple[Any, Any] | None = None,
        negative_damping: bool | None = None,
    ) -> RequiredValue:
        """Return the value of one parameter at which K_max reaches a required stiffness, all others unchanged.

        Args:
            parameter: dotted path, such as "damping", "velocity.cutoff" or "rate".
            stiffness: required K_max in N/m, > 0.
            within: range to search, 0 < low < high. By default from 1/30 to 30 times the current value, limited to
                delays of at most 1,000 periods or the current delay.
            negative_damping: as for `max_stiffness`.

        Returns:
            ``value``, the sufficient value closest to the current one; ``sufficient_side``, the side of ``value`` on
            which K_max is sufficient ("above" or "below"), "everywhere" if K_max is sufficient in the whole range
            (``value`` is then the current value, or the closest end of the range), or "nowhere"; ``crossings``, all
            crossings found, each confirmed by K_max on both sides; ``range``, the range searched; ``status``,
            UNREACHABLE with NaN if K_max is below the required stiffness in the whole range. Inside JAX transformations
            ``sufficient_side`` is the index of the side in ("above", "below", "everywhere", "nowhere"), ``crossings``
            is empty, and ``value`` has first and second derivatives with respect to the numbers of the scene and the
            stiffness (NaN if no crossing is found).

        Numerics:
            K_max is computed at the current value, at 25 values across the range, and at extrema between them that may
            reach the stiffness. Crossings are then found to a relative error of 1e-11. Peaks and dips narrower than the
            distance of these values may be missed.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> needed = scene.required("damping", 25e3)
            >>> print(f"{needed.value:.2f} N s/m or {needed.sufficient_side}")
            18.62 N s/m or above
        """
        if self.traced_path is not None or is_traced(stiffness):
            stiffness = read_texts("stiffness", stiffness, self.unit_system["N/m"])
            if within is not None:
                low, high = read_texts("within", within, "")
                within = to_float(low), to_float(high)
            return RequiredValue(*self.traced_loop.trace_required(parameter, stiffness, within, negative_damping))
        stiffness = _read_stiffness(stiffness, self.unit_system["N/m"])
        now = _get_present_value(self, parameter)
        low, high = _choose_range(self, parameter, now, within)

        def compare(K: float, status: int) -> float:
            """Return log(K/stiffness) for K_max = K; -NO_STIFFNESS if no wall is stable, and NaN for other failures."""
            if status == Status.NO_BOUNDARY:
                return -NO_STIFFNESS
            return math.log(K / stiffness) if status == Status.OK else math.nan

        def surplus(value: float) -> float:
            """Return log(K_max/stiffness) for one value of the parameter, by ``compare`` also if K_max is missing."""
            wall = self.replace(**{parameter: value}).max_stiffness(negative_damping=negative_damping)
            return compare(wall.stiffness, wall.status)

        tried = np.geomspace(low, high, N_POINTS)
        if low <= now <= high:
            tried = np.append(tried[np.abs(tried / now - 1.0) > SAME_VALUE], now)
        maxima, _, statuses = self.loop.vary({parameter: tried}).stiffest(allows_negative(self, negative_damping))
        # Skip values that are not allowed, such as a cutoff above the Nyquist frequency.
        surpluses = {
            value: compare(K, status)
            for value, K, status in zip(tried.tolist(), maxima, statuses, strict=True)
            if status != Status.INVALID_INPUT
        }
        if not surpluses:
            raise InputError(f"within: {parameter} has no allowed value from {low:g} to {high:g}")
        grid = sorted(surpluses)
        surpluses |= {
            value: surplus(value) for value in _find_extrema(surplus, grid, [surpluses[value] for value in grid])
        }
        grid = sorted(surpluses)
        values = [surpluses[value] for value in grid]
        low, high = grid[0], grid[-1]
        enough = [value >= 0 for value in values]
        if not any(enough):
            status = Status.NOT_CONVERGED if any(map(math.isnan, values)) else Status.UNREACHABLE
            return RequiredValue(math.nan, "nowhere", (), (low, high), status)
        if all(enough):
            return RequiredValue(min(max(now, low), high), "everywhere", (), (low, high), Status.OK)
        crossings = tuple(
            _find_crossing(surplus, grid[k], grid[k + 1])
            for k in range(len(grid) - 1)
            if (values[k] >= 0) != (values[k + 1] >= 0) and not math.isnan(values[k] + values[k + 1])
        )
        confirmed = tuple(crossing for crossing in crossings if crossing is not None)
        if not confirmed or len(confirmed) < len(crossings):
            return RequiredValue(math.nan, "nowhere", confirmed, (low, high), Status.NOT_CONVERGED)
        middle = now if now > 0 else low
        best = min(confirmed, key=lambda crossing: abs(math.log(crossing.value / middle)))
        ends = sorted((middle, best.value))
        if any(ends[0] <= value <= ends[1] and math.isnan(surpluses[value]) for value in grid):
            # Report no value if K_max could not be computed between the current value and the crossing, because a
            # closer crossing may exist there.
            return RequiredValue(math.nan, "nowhere", confirmed, (low, high), Status.NOT_CONVERGED)
        return RequiredValue(best.value, best.sufficient_side, confirmed, (low, high), Status.OK)

    def best_damping(
        self, stiffness: float | str | None = None, *, goal: Goal = "fast", negative_damping: bool | None = None
    ) -> BestDamping:
        """Find the damping B at which a wall with the given stiffness settles fastest or is most robust.

        Args:
            stiffness: K in N/m, > 0; by default that of the wall of the scene.
            goal: "fast" minimizes the spectral radius, so that the wall settles fastest; "robust" maximizes the modulus
                margin, i.e. the largest unmodeled change of the loop at any frequency with which it stays stable.
            negative_damping: as for `max_stiffness`. Only dampings whose walls are connected to K = 0 are considered.

        Returns:
            ``virtual_damping`` in N s/m, with its ``spectral_radius`` and ``modulus_margin``; ``status``, NO_BOUNDARY
            with NaN if no such damping is stable.

        Numerics:
            Samples in the stable intervals of B, then golden-section search around the three lowest minima, because the
            optimum is usually a kink at which poles meet; the radius then has an error of 1e-7. Run time 0.1 to 1 s.

        References:
            Hulin, Preusche, Hirzinger 2006, section VIII. Landau 1990 (modulus margin).

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> best = scene.best_damping(5e3)
            >>> print(f"{best.virtual_damping:.1f} N s/m, spectral radius {best.spectral_radius:.3f}")
            25.8 N s/m, spectral radius 0.759
        """
        check_choice("goal", goal, get_args(Goal))
        if stiffness is None:
            stiffness = resolve_wall(self.wall, None, None, self.unit_system)[0]
        stiffness = _read_stiffness(stiffness, self.unit_system["N/m"])
        units = self.units

        def radius(beta: Any) -> np.ndarray:
            """Return the spectral radius of walls with this stiffness."""
            return self.spectral_radius(stiffness, beta * units.virtual_damping)

        def margin(beta: Any) -> np.ndarray:
            """Return the modulus margin of walls with this stiffness."""
            loop, beta = self.loop, np.asarray(beta)
            alpha = np.full(beta.size, stiffness / units.stiffness)
            walls = tabulate(loop.roots, alpha, beta.reshape(-1), loop.boundary.w)
            return find_modulus_margins(walls)[0].reshape(beta.shape)

        cost: Callable[[Any], np.ndarray] = radius if goal == "fast" else lambda beta: -margin(beta)
        intervals = find_connected_dampings(self, stiffness, negative_damping)
        if not intervals:
            return BestDamping(math.nan, math.nan, math.nan, Status.NO_BOUNDARY)
        _, best = min(find_global_minimum(cost, *ends, N_SAMPLES) for ends in intervals)
        return BestDamping(best * units.virtual_damping, float(radius(best)), float(margin(best)), Status.OK)
