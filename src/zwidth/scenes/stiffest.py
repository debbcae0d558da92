"""What is best on a scene: its stiffest wall, what buys more, what a stiffness requires, the damping that suits it."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np

from zwidth.arrays.roots import find_global_minimum
from zwidth.loops.linear.margins import OpenLoop
from zwidth.loops.linear.ridge import SceneSensitivities
from zwidth.parts.checks import read_texts
from zwidth.parts.wall import resolve_wall
from zwidth.scenes.answers import SceneAnswers, allows_negative
from zwidth.words.errors import InputError, check_choice, describe_choice
from zwidth.words.quantities import FIELDS, WALL
from zwidth.words.showing import shown
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array
from zwidth.words.units import to_float
from zwidth.words.xp import is_jax, is_traced

# By what share a row may end below the stiffest wall that is on it.
_ROUNDED = 1e-6


@shown(frequency="Hz", kind=RidgeKind)
class StiffestWall(NamedTuple):
    """The stiffest stable wall: N/m, N s/m, Hz, and the codes of `zwidth.RidgeKind` and `zwidth.Status`."""

    stiffness: Array
    virtual_damping: Array
    frequency: Array
    kind: Array
    status: Array


def explain_missing(scene: SceneAnswers, status: Any) -> str:
    """Return the reason why a scene has no stiffest wall, from the status of the search."""
    if status == Status.NO_BOUNDARY:
        return "no stiffness is stable at any damping"
    explained = scene.loop.explain_limit() if status == Status.UNDECIDED else ""
    return explained or Status(int(status)).message


def choose_damping(scene: SceneAnswers, top: StiffestWall, stiffness: float) -> float:
    """A damping with which a softer wall than the stiffest is stable, where it can be so without leaving its piece."""
    # That of the stiffest wall, if all walls of that damping between the two are stable; else the middle of the widest
    # interval of dampings.
    damping = float(top.virtual_damping)
    row = scene.stable_stiffness(damping)
    if np.any((row[:, 0] < stiffness) & (row[:, 1] > (1.0 - _ROUNDED) * top.stiffness)):
        return damping
    column = soft_dampings(scene, stiffness)
    low, high = max(column, key=lambda ends: ends[1] - ends[0], default=(math.nan, math.nan))
    return 0.5 * (low + high) * scene.units.virtual_damping if column else damping


def soft_dampings(
    scene: SceneAnswers, stiffness: float, negative_damping: bool | None = None
) -> list[tuple[float, float]]:
    """The intervals of beta with which walls of a stiffness are stable in a piece with soft walls."""
    least = -math.inf if allows_negative(scene, negative_damping) else 0.0
    return scene.loop.soft_column(stiffness / scene.units.stiffness, least)


# How far the range reaches to both sides of the present value where none is given, and its points.
_REACH, _POINTS = 30.0, 25
# Delays so long are looked at, in periods, where none longer is there.
_MOST_PERIODS = 1000.0
# Closer than that a value and the present one are the same.
_SAME = 1e-9
# By what share of the value both sides of a crossing are proved, the closest that tells them apart.
_BESIDE = (1e-11, 1e-9, 1e-7, 1e-5)

# How close, in logarithms, its highest and lowest values are sought.
_TURN = {"xatol": 1e-6}

# The logarithm of a stiffness that counts as none.
_HARDLY_ANY = 60.0

Side = Literal["above", "below", "everywhere", "nowhere"]


class Crossing(NamedTuple):
    """A value of a parameter at which K_max passes the wanted stiffness, and on which side of it there is enough."""

    value: float
    enough: Side


@shown()
class RequiredValue(NamedTuple):
    """The value to choose, the side on which there is enough, and every crossing in the range, ascending."""

    value: float
    enough: Side
    crossings: tuple[Crossing, ...]
    range: tuple[float, float]
    status: Status


def _read_stiffness(given: Any, unit: str) -> float:
    """Return a required stiffness in its SI unit."""
    stiffness = read_texts("stiffness", given, unit)
    if not (isinstance(stiffness, int | float | np.number) and math.isfinite(to_float(stiffness)) and stiffness > 0):
        raise InputError(f"stiffness: got {stiffness!r}; it must be finite and greater than 0 (in {unit})")
    return float(stiffness)


def _present_value(scene: SceneAnswers, parameter: str) -> float:
    known = {path: value for path, value in scene.parameters().items() if path not in WALL}
    known["rate"] = 1.0 / known["period"]
    if not isinstance(parameter, str) or parameter not in known:
        raise InputError(f"parameter: {describe_choice(parameter, tuple(known))}")
    if isinstance(known[parameter], int | np.integer):
        raise InputError(f"parameter: got {parameter!r}, a whole number; try its few values one by one")
    return float(known[parameter])


def _range(scene: SceneAnswers, parameter: str, now: float, within: tuple[Any, Any] | None) -> tuple[float, float]:
    """Return the range of a parameter to search: ``within`` if given, otherwise around the present value ``now``."""
    if within is None:
        timing = scene.timing
        if not now > 0:
            raise InputError(f"within: {parameter} is 0 now; give the range to search, as within=(0.1, 10)")
        # The run time increases with the square of the delay in periods; a cutoff is below the Nyquist frequency.
        fixed = 0.0 if timing.in_periods else timing.delay
        longest = max(float(timing.delay / timing.period), _MOST_PERIODS)
        ends = {
            "delay": (0.0, longest * timing.period),
            "period": (fixed / longest, math.inf),
            "rate": (0.0, longest / fixed if fixed else math.inf),
            "velocity.cutoff": (0.0, 0.499 / (getattr(scene.velocity, "coded_period", None) or timing.period)),
        }
        low, high = ends.get(parameter, (0.0, math.inf))
        return max(now / _REACH, float(low)), min(now * _REACH, float(high))
    low, high = (to_float(end) for end in read_texts("within", within, scene.unit_system[FIELDS[parameter].unit]))
    if not 0 < low < high < math.inf:
        raise InputError(f"within: got {within!r}; two finite numbers with 0 < low < high are needed")
    return low, high


def _find_turns(surplus: Callable[[float], float], grid: list[float], values: list[float]) -> list[float]:
    """Where K_max is highest between values that all have too little, and lowest between values that have enough."""
    from scipy.optimize import minimize_scalar

    found = []
    for k in range(1, len(grid) - 1):
        side = 1.0 if values[k] >= 0 else -1.0
        if side * values[k - 1] > side * values[k] < side * values[k + 1]:
            ends = math.log(grid[k - 1]), math.log(grid[k + 1])
            turn = minimize_scalar(
                lambda x, side=side: side * surplus(math.exp(x)), bounds=ends, method="bounded", options=_TURN
            )
            found.append(math.exp(turn.x))
    return found


def _cross(surplus: Callable[[float], float], low: float, high: float) -> Crossing | None:
    """The crossing between two values, proved by a value on each side of it; None where it cannot be."""
    from scipy.optimize import brentq

    try:
        root = brentq(lambda x: surplus(min(max(math.exp(x), low), high)), math.log(low), math.log(high))
    except ValueError:
        # On the way there is a value whose K_max cannot be computed.
        return None
    place = math.exp(cast("float", root))
    for share in _BESIDE:
        ends = place * (1.0 - share), place * (1.0 + share)
        below, above = (surplus(end) >= 0 for end in ends)
        if below != above:
            return Crossing(ends[1], "above") if above else Crossing(ends[0], "below")
    return None


Goal = Literal["fast", "robust"]

# Samples across a column.
_SAMPLES = 66


@shown()
class BestDamping(NamedTuple):
    """A virtual damping in N s/m, the spectral radius and the modulus margin there, and the `zwidth.Status`."""

    virtual_damping: float
    spectral_radius: float
    modulus_margin: float
    status: Status


class SceneOptima(SceneAnswers):
    """The questions of `zwidth.Scene` that look for a wall, or for a device that bears it."""

    def max_stiffness(self, *, negative_damping: bool | None = None) -> StiffestWall:
        """Return the stiffest stable wall connected to K = 0, and the kind of its optimum.

        K_max is ``sup {K : some B is stable}`` over the pieces of the stable set that are connected to K = 0 by paths
        of stable walls. All other pieces are `islands`. If the device is unstable without a wall, no piece may be
        connected to K = 0; then the piece with the softest stable walls counts. With parts the stable set may be
        inclined near its tip, so that no softer wall is stable at the damping of the stiffest; `recommend` returns a
        wall to set.

        Args:
            negative_damping: whether walls with B < 0 count. By default they count only for a `Device` with the
                backward difference. With a filter a negative B is a lead compensator; with a `LinearDevice` or a
                `MeasuredDevice` it would cancel damping of the model, which is unsafe. The pieces of the stable set do
                not depend on this argument: a path may lead through B < 0.

        Returns:
            ``stiffness`` in N/m; ``virtual_damping`` in N s/m; ``frequency`` in Hz of the pole pair on the unit circle,
            of the higher one at a corner; ``kind``, a code of `zwidth.RidgeKind`; ``status`` of `zwidth.Status`, with
            NaN where it is not 0: NO_BOUNDARY where no such wall with K > 0 is stable.

        Numerics:
            Closed form for a rigid device. Otherwise the highest point of all edges of the stable set, about 1e-13
            relative (a mode that decays by less than 1e-3 in a period costs digits, but for one without damping),
            refused where rows of the plane contradict it. Inside a JAX transformation it is finished by optimistix,
            with implicit derivatives in every parameter of every part. The delay and, with one, the period must be
            plain numbers there (`TracedDelayError`).

        Example:
            >>> import zwidth
            >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=100))
            >>> print(f"{scene.max_stiffness().stiffness:.0f} N/m")
            11942 N/m
        """
        alpha, beta, omega, kind, status = self.loop.stiffest(allows_negative(self, negative_damping))
        mass, period = (value if is_traced(value) else float(value) for value in (self.mass, self.timing.period))
        rate = mass / period
        # In the order of `zwidth.max_stiffness`, for the same last digit.
        values = (alpha * rate / period, beta * rate, omega / (2.0 * math.pi * period), kind, status)
        return StiffestWall(*(value if is_jax(value) else np.asarray(value)[()] for value in values))

    def sensitivities(self, *, negative_damping: bool | None = None) -> SceneSensitivities:
        """What a little more of every parameter of every part buys.

        Args:
            negative_damping: as for `max_stiffness`.

        Returns:
            ``stiffness``, K_max in N/m; ``per``, its derivatives by dotted path ("mass", "velocity.cutoff",
            "operator.mass", ...) in N/m per SI unit, each with all others held fixed (the delay in seconds or in
            periods, as it was given); ``status``, NOT_CONVERGED if a derivative is NaN; without a K_max all
            are NaN. Whole numbers and coefficients of a filter have no derivative. At a value of zero, and at an
            integer delay of a linear system without inertia, the derivatives are one-sided, for an increase; for all
            others both sides agree.

        Numerics:
            Closed form for a rigid device; otherwise implicit derivatives of the conditions that bind, some ms a
            parameter: right to 1e-6, or where one is nearly 0, to 1e-11 of K_max over the parameter (1e-9 beside a
            spring ten million times as stiff as the wall).

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> print(f"{scene.sensitivities().per['damping']:.0f} N/m per N s/m")
            572 N/m per N s/m
        """
        return self.loop.sensitivities(allows_negative(self, negative_damping))

    def required(
        self,
        parameter: str,
        stiffness: float | str,
        *,
        within: tuple[Any, Any] | None = None,
        negative_damping: bool | None = None,
    ) -> RequiredValue:
        """The value of one parameter at which K_max reaches a wanted stiffness, all others as they are.

        Args:
            parameter: its dotted path, such as "damping", "velocity.cutoff" or "rate".
            stiffness: wanted, in N/m, > 0.
            within: the range that is searched, 0 < low < high; by default a thirtieth to 30 times the present value,
                where the delay is no longer than 1,000 periods or than it is.
            negative_damping: as for `max_stiffness`.

        Returns:
            ``value``, the nearest to the present one, itself enough; ``enough``, the side of it on which there is
            enough ("above", "below"), or "everywhere" in the range (then ``value`` is the present one, or the end next
            to it), or "nowhere"; ``crossings``, all that were found, each proved by a K_max on either side; ``range``;
            ``status``, UNREACHABLE with NaN where the range never reaches the stiffness.

        Numerics:
            The present value and 25 across the range, and where K_max turns between them without passing the stiffness
            the place where it does; then each crossing to 1e-11 relative. Peaks and dips narrower than the values are
            apart are not seen.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> needed = scene.required("damping", 25e3)
            >>> print(f"{needed.value:.2f} N s/m or {needed.enough}")
            18.62 N s/m or above
        """
        stiffness = _read_stiffness(stiffness, self.unit_system["N/m"])
        now = _present_value(self, parameter)
        low, high = _range(self, parameter, now, within)

        def surplus(value: float) -> float:
            """How K_max compares with the wanted stiffness, in logarithms; NaN where it cannot be computed."""
            wall = self.replace(**{parameter: value}).max_stiffness(negative_damping=negative_damping)
            if wall.status == Status.NO_BOUNDARY:
                return -_HARDLY_ANY
            return math.log(wall.stiffness / stiffness) if wall.status == Status.OK else math.nan

        tried, known = np.geomspace(low, high, _POINTS), {}
        if low <= now <= high:
            tried = np.append(tried[np.abs(tried / now - 1.0) > _SAME], now)
        for value in tried.tolist():
            # The range ends where values are refused, as for a cut-off at half the sampling rate.
            with suppress(InputError):
                known[value] = surplus(value)
        if not known:
            raise InputError(f"within: {parameter} cannot have any value from {low:g} to {high:g}")
        grid = sorted(known)
        known |= {turn: surplus(turn) for turn in _find_turns(surplus, grid, [known[value] for value in grid])}
        grid = sorted(known)
        values = [known[value] for value in grid]
        low, high = grid[0], grid[-1]
        enough = [value >= 0 for value in values]
        if not any(enough):
            status = Status.NOT_CONVERGED if any(map(math.isnan, values)) else Status.UNREACHABLE
            return RequiredValue(math.nan, "nowhere", (), (low, high), status)
        if all(enough):
            return RequiredValue(min(max(now, low), high), "everywhere", (), (low, high), Status.OK)
        found = tuple(
            _cross(surplus, grid[k], grid[k + 1])
            for k in range(len(grid) - 1)
            if (values[k] >= 0) != (values[k + 1] >= 0) and not math.isnan(values[k] + values[k + 1])
        )
        proved = tuple(crossing for crossing in found if crossing is not None)
        if not proved or len(proved) < len(found):
            return RequiredValue(math.nan, "nowhere", proved, (low, high), Status.NOT_CONVERGED)
        middle = now if now > 0 else low
        best = min(proved, key=lambda crossing: abs(math.log(crossing.value / middle)))
        ends = sorted((middle, best.value))
        if any(ends[0] <= value <= ends[1] and math.isnan(known[value]) for value in grid):
            # A nearer crossing may hide where K_max could not be computed.
            return RequiredValue(math.nan, "nowhere", proved, (low, high), Status.NOT_CONVERGED)
        return RequiredValue(best.value, best.enough, proved, (low, high), Status.OK)

    def best_damping(
        self, stiffness: float | str | None = None, *, goal: Goal = "fast", negative_damping: bool | None = None
    ) -> BestDamping:
        """The virtual damping that suits a stiffness best.

        Args:
            stiffness: K in N/m, > 0; that of the scene's own wall where left out.
            goal: "fast", the smallest spectral radius, with which the wall settles fastest; "robust", the largest
                modulus margin, with which it bears the largest unknown change of the loop at every frequency.
            negative_damping: as for `max_stiffness`, as is the piece of the stable set that is meant.

        Returns:
            ``virtual_damping`` in N s/m; ``spectral_radius`` and ``modulus_margin`` there; ``status``, NO_BOUNDARY with
            NaN where no damping is stable in that piece.

        Numerics:
            Samples across the stable dampings, then golden section round the three lowest dips: the optimum is usually
            a kink, where poles meet. The radius is right to about 1e-8 where two poles meet; 0.1 to 1 s.

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
            return self.spectral_radius(stiffness, beta * units.virtual_damping)

        @np.vectorize
        def margin(beta: float) -> float:
            loop = self.loop
            wall = OpenLoop.tabulate(loop.roots, stiffness / units.stiffness, beta, loop.boundary.w)
            return wall.find_least_distance()[0]

        cost: Callable[[Any], np.ndarray] = radius if goal == "fast" else lambda beta: -margin(beta)
        columns = soft_dampings(self, stiffness, negative_damping)
        if not columns:
            return BestDamping(math.nan, math.nan, math.nan, Status.NO_BOUNDARY)
        _, best = min(find_global_minimum(cost, *ends, _SAMPLES) for ends in columns)
        return BestDamping(best * units.virtual_damping, float(radius(best)), float(margin(best)), Status.OK)
