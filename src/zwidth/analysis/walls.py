"""Analyses of the walls of a scene in SI units: stability, poles, margins, passivity, state space, frequency response.

`SceneAnalysis` adds these methods to the parts of a scene (`zwidth.analysis.base`). They check and broadcast the walls,
convert them to the normalized alpha and beta, call the loop of the scene (`zwidth.analysis.loop`), and convert the
results back. K and B are the stiffness and damping of the wall, F(z) is the velocity estimate, G(z) the plant, and
``L = (K + B F) G`` the open loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.analysis.base import SceneParts
from zwidth.analysis.loop import LinearLoop
from zwidth.core.errors import InputError, check_choice
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_traced, namespace
from zwidth.model.checks import read_texts
from zwidth.model.linear_device import ResponseDevice
from zwidth.model.position import has_velocity
from zwidth.model.state_space import StateSpace
from zwidth.model.wall import resolve_wall
from zwidth.numerics.evaluate import are_numbers, as_float64, broadcast_traced, join_shapes
from zwidth.plant.sampled_states import sample_states
from zwidth.stability.linear.closed_loop import realize_closed_loop, realize_open_loop
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.stability.linear.rows import Island
from zwidth.stability.results import Margins, Stability
from zwidth.stability.rigid.verdict import STABILITY_METHODS, StabilityMethod
from zwidth.units.display import compact_repr

if TYPE_CHECKING:
    import control

# Types of the arguments K and B, for several walls and for one wall. A text states its unit, such as "10 kN/m". None
# selects the value of the wall of the scene.
Walls: TypeAlias = ArrayLike | None
Wall: TypeAlias = float | str | None


@compact_repr(
    phase_margin="degrees", delay_margin="s", phase_crossover="Hz", gain_crossover="Hz", modulus_frequency="Hz"
)
class SceneMargins(Margins):
    """Gain, phase, delay and modulus margin of walls, with the delay margin in s and the frequencies in Hz."""


@compact_repr(decay_rate="1/s", angle="rad", frequency="Hz")
class ScenePole(NamedTuple):
    """Dominant pole (pole of largest magnitude) of the closed loop with a wall; fields are arrays for several walls."""

    radius: Array  # magnitude of the pole, the spectral radius
    angle: Array  # angle of the pole in rad per period, from 0 to pi
    decay_rate: Array  # decay rate in 1/s
    frequency: Array  # frequency in Hz, ``angle/(2 pi T)``; 0 if the response does not oscillate
    status: Array  # code of `zwidth.Status`


class SceneAnalysis(SceneParts):
    """Base class of `zwidth.Scene` with the methods that evaluate walls.

    Without a stiffness and a damping, each method evaluates the wall of the scene (`zwidth.model.wall.resolve_wall`). A
    quantity may be a text with a unit, such as "10 kN/m".
    """

    def normalize_walls(self, stiffness: Walls = None, virtual_damping: Walls = None) -> tuple[np.ndarray, np.ndarray]:
        """Convert K in N/m and B in N s/m to alpha and beta, as arrays that broadcast; default: the scene's wall."""
        units, both = self.units, resolve_wall(self.wall, stiffness, virtual_damping, self.unit_system)
        if are_numbers(*both):
            both = np.float64(both[0]), np.float64(both[1])
        elif is_traced(*both):
            both = broadcast_traced({"stiffness": both[0], "virtual_damping": both[1]})
        else:
            both = as_float64("stiffness", both[0]), as_float64("virtual_damping", both[1])
            join_shapes([("stiffness", both[0].shape), ("virtual_damping", both[1].shape)])
        with np.errstate(all="ignore"):
            return both[0] / units.stiffness, both[1] / units.virtual_damping

    def _broadcast_walls(self, stiffness: Walls, virtual_damping: Walls) -> Sequence[Array]:
        """Convert K in N/m and B in N s/m to arrays alpha and beta of a common shape."""
        walls = self.normalize_walls(stiffness, virtual_damping)
        return namespace(*walls).broadcast_arrays(*walls)

    def _loop_for(self, *values: Any) -> LinearLoop:
        """Return the loop of the scene, or `traced_loop` if JAX traces the given walls or frequencies."""
        return self.traced_loop if is_traced(*values) and not self.loop.traceable else self.loop

    def poles(self, stiffness: Walls = None, virtual_damping: Walls = None) -> np.ndarray:
        """Return all poles of the closed loop, along a new last axis in no particular order.

        Walls out of range have NaN. The eigenvalues of the companion matrix are refined by Aberth's iteration on the
        factored polynomial, expanded around z = 1. The error is about 1e-15 times the condition number for a simple
        pole and 1e-16^(1/k) for a k-fold one. The run time per wall is O(degree^3).
        """
        walls = self._broadcast_walls(stiffness, virtual_damping)
        return self._loop_for(*walls).poles(*walls)

    def spectral_radius(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """Return the largest magnitude of the closed-loop poles of each wall.

        The result is below 1 if and only if the wall is stable, and NaN for walls out of range and for a device given
        by a measured response. If the loop has at most 150 poles, all are computed; otherwise the method counts the
        poles inside circles, with a run time that does not increase with the delay.
        """
        walls = self._broadcast_walls(stiffness, virtual_damping)
        return self._loop_for(*walls).radius(*walls)

    def dominant_pole(self, stiffness: Walls = None, virtual_damping: Walls = None) -> ScenePole:
        """Return the dominant pole of the closed loop with each wall, i.e. the pole of largest magnitude.

        After faster components have decayed, the response oscillates with ``frequency`` in Hz and decays with
        ``decay_rate`` in 1/s. The radius and the method are those of `spectral_radius`; if several poles have the same
        magnitude, the angle is that of one of them. Values that cannot be computed are NaN, and their ``status`` is
        not 0.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> print(f"{scene.dominant_pole(5000, 10).frequency:.1f} Hz")
            37.3 Hz
        """
        walls = self._broadcast_walls(stiffness, virtual_damping)
        radius, angle, rate, status = self._loop_for(*walls).dominant_poles(*walls)
        period = self.timing.period
        return ScenePole(radius, angle, rate / period, angle / (2.0 * np.pi * period), status)

    def islands(self, *, negative_damping: bool | None = None) -> list[Island]:
        """Return the islands: the pieces of the stable set that are not connected to K = 0 by paths of stable walls.

        A wall on an island is stable, but on the way to K = 0 it becomes unstable, however B changes along the path.
        Islands do not count for `max_stiffness`.

        Args:
            negative_damping: as for `max_stiffness`; False omits islands with B <= 0.

        Returns:
            A list, the stiffest first; ``stiffness`` in N/m and ``virtual_damping`` in N s/m are pairs: the smallest
            and the largest value on the island. Empty for a rigid scene, whose stable set is connected.

        Raises:
            InputError: couplings with arbitrarily large K are stable with a tool integrated by implicit Euler.

        Example:
            >>> import zwidth
            >>> timing, window = zwidth.Timing(period=1e-3, delay=1e-3), zwidth.WindowedDifference(samples=24)
            >>> (island,) = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=window).islands()
            >>> print("{:.0f} to {:.0f} N/m".format(*island.stiffness))
            7537 to 9037 N/m
        """
        units = np.array([self.units.stiffness, self.units.virtual_damping])[:, None]
        islands = self.loop.islands(-np.inf if allows_negative(self, negative_damping) else 0.0)
        return [Island(*(tuple(pair.tolist()) for pair in np.array(one) * units)) for one in islands]

    def state_space(self, stiffness: Wall = None, virtual_damping: Wall = None) -> StateSpace:
        """Return a state-space model of the closed loop with one wall, from external force to sensed position.

        The input is the force on the device in N, the output the position in m. The force is constant within each
        period (zero-order hold), and the discretization is exact. The states include those of the velocity estimate and
        the delayed forces. The result has A, B, C, D and the period dt.
        """
        refuse_slow_tool(self, "the state-space model of the closed loop")
        compliance = self.timing.period**2 / float(self.mass)
        tool = self.tool and self.tool.respond(float(self.mass), self.timing.period)
        build = partial(realize_closed_loop, tool=tool)
        return _realize(self, build, compliance, *self.normalize_walls(stiffness, virtual_damping))

    def open_loop(self, stiffness: Wall = None, virtual_damping: Wall = None) -> StateSpace:
        """Return a state-space model of the open loop L with one wall; negative feedback closes the loop."""
        if self.tool is not None:
            raise InputError("tool: the state-space model of the open loop excludes a tool; use frequency_response")
        return _realize(self, realize_open_loop, 1.0, *self.normalize_walls(stiffness, virtual_damping))

    def frequency_response(
        self, stiffness: Walls = None, virtual_damping: Walls = None, frequency: ArrayLike | None = None
    ) -> Array:
        """Return the complex open loop ``L = (K + B F) G`` at frequencies in Hz up to the Nyquist frequency.

        All arguments broadcast. The result is NaN for frequencies out of range. The winding number of L around -1
        decides stability.
        """
        if frequency is None:
            raise InputError("frequency: missing; pass frequencies in Hz, up to half the sampling rate")
        alpha, beta = np.broadcast_arrays(*self.normalize_walls(stiffness, virtual_damping))
        hertz = as_float64("frequency", read_texts("frequency", frequency, "Hz"))
        join_shapes([("frequency", hertz.shape), ("stiffness", alpha.shape), ("virtual_damping", beta.shape)])
        hertz, alpha, beta = np.broadcast_arrays(hertz, alpha, beta)
        w = 2.0 * np.pi * hertz * self.timing.period
        # Map the Nyquist frequency to exactly pi, because the product of frequency and period may be rounded to a
        # larger value.
        w = np.where(np.abs(w - np.pi) < 1e-14, np.pi, w)
        inside = (w > 0) & (w <= np.pi)
        value = self.loop.open_loop(alpha, beta, np.where(inside, w, 1.0))
        return np.where(inside, value, complex(np.nan, np.nan))[()]

    def is_stable(
        self, stiffness: Walls = None, virtual_damping: Walls = None, *, method: StabilityMethod = "auto"
    ) -> Array:
        """Return whether walls are stable, i.e. all poles of the closed loop lie strictly inside the unit circle.

        Args:
            stiffness: K in N/m.
            virtual_damping: B in N s/m. Both broadcast. Without both, the wall of the scene is evaluated. If the scene
                has no wall, ``virtual_damping`` may be omitted and is then 0.
            method: as for `decide_stability`, which also returns a status.

        Returns:
            Boolean array of the broadcast shape; False for NaN and for entries of arrays that are out of range.

        Raises:
            InputError: a single wall is out of range, or it is ambiguous which wall is meant.

        Numerics:
            Closed form for a rigid device with the backward difference. Otherwise by the signed crossings on each line
            of constant B (`stability.linear.boundary`). The first call traces the boundary (5 to 20 ms); then each
            value of B takes some microseconds, and each further K much less.
        """
        if method != "auto":
            return self.decide_stability(stiffness, virtual_damping, method=method).stable
        walls = self.normalize_walls(stiffness, virtual_damping)
        return self._loop_for(*walls).labels(*walls)

    def stable_stiffness(self, virtual_damping: ArrayLike | None = None) -> np.ndarray:
        """Return all intervals of the stiffness K in which the walls with a given damping B are stable.

        Args:
            virtual_damping: B in N s/m, a number or an array; by default that of the wall of the scene, or 0 without a
                wall.

        Returns:
            Array of shape (n, 2) in N/m; for an array of dampings, of shape (*shape, n, 2), with NaN if a damping has
            fewer intervals. The intervals are open.
        """
        value = self.wall.virtual_damping if virtual_damping is None else virtual_damping
        damping = read_texts("virtual_damping", value, self.unit_system["N s/m"])
        beta = as_float64("virtual_damping", damping) / self.units.virtual_damping
        intervals = self.loop.find_stable_alpha(beta.reshape(-1)) * self.units.stiffness
        return intervals.reshape(*beta.shape, *intervals.shape[1:])

    def stable_damping(self, stiffness: Wall = None) -> np.ndarray:
        """Return all intervals of the virtual damping B in which the walls with one stiffness K are stable.

        Args:
            stiffness: K in N/m; by default that of the wall of the scene.

        Returns:
            Array of shape (n, 2) in N s/m. The intervals are open.
        """
        stiffness = resolve_wall(self.wall, None, None, self.unit_system)[0] if stiffness is None else stiffness
        alpha, _ = read_single_wall(*self.normalize_walls(stiffness, 0.0))
        return self.loop.find_stable_beta(alpha) * self.units.virtual_damping

    def damper_range(self) -> np.ndarray:
        """Return the intervals of B in which a pure damper (K = 0) is stable except for its pole at z = 1.

        With K = 0 no force restores the position of a free device: one pole stays at z = 1, so `is_stable` returns
        False for every B. In the returned intervals all other poles lie inside the unit circle. A device with a spring
        to ground has no such pole; its intervals equal those of `stable_damping` at K = 0.

        Returns:
            Array of shape (n, 2) in N s/m. The intervals are open.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> print("{:.2f} to {:.2f} N s/m".format(*scene.damper_range()[0]))
            -10.00 to 90.48 N s/m
        """
        return self.loop.find_damper_intervals() * self.units.virtual_damping

    def decide_stability(
        self, stiffness: Walls = None, virtual_damping: Walls = None, *, method: StabilityMethod = "auto"
    ) -> Stability:
        """Return for each wall whether it is stable, a status code, and the method that decided its stability.

        `zwidth.decide_stability` returns the same type. "auto" and "crossover" sum the signed crossings on each line of
        constant B; "companion" computes all poles; "certified" decides in ball arithmetic of python-flint for exactly
        the given parameters, or returns UNDECIDED or ON_BOUNDARY.
        """
        check_choice("method", method, STABILITY_METHODS)
        alpha, beta = np.broadcast_arrays(*self.normalize_walls(stiffness, virtual_damping))
        walls = (
            np.asarray(part, float) for part in resolve_wall(self.wall, stiffness, virtual_damping, self.unit_system)
        )
        K, B = np.broadcast_arrays(*walls)
        return self.loop.decide(alpha, beta, method, (K, B))

    def explain_undecided(self, stiffness: Walls = None, virtual_damping: Walls = None) -> list[str]:
        """Return texts with the reasons why the stability of one wall is undecided and the frequencies to measure.

        Only a measured response can leave a wall undecided. The list is empty if the wall is decided.
        """
        return self.loop.explain(*read_single_wall(*self.normalize_walls(stiffness, virtual_damping)))

    def passivity_margin(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """Return the damping of the device minus the damping that a passive wall requires, in N s/m.

        The margin is NaN for walls out of range. This is Colgate's condition for any velocity estimate and delay; the
        required damping is the certified maximum over all frequencies (`stability.linear.passivity`). For a rigid
        device the condition is necessary and sufficient for any operator. With a coupling and the sensor at the motor
        it uses the damping of the motor and is only sufficient. No condition is known for a sensor at the tip, an
        actuator or modes (`InputError`). For K < 0 the margin is at most K T, because such a wall supplies energy
        without limit.
        """
        if obstacle := find_obstacle(self):
            raise InputError(f"passivity {obstacle}")
        alpha, beta = self._broadcast_walls(stiffness, virtual_damping)
        return self._loop_for(alpha, beta).passivity_margin(alpha, beta) * self.units.virtual_damping

    def is_passive(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """Return whether walls are passive (positive `passivity_margin`), i.e. stable with every passive operator."""
        margin = self.passivity_margin(stiffness, virtual_damping)
        return (margin if is_traced(margin) else np.asarray(margin)) > 0

    def margins(self, stiffness: Walls = None, virtual_damping: Walls = None) -> SceneMargins:
        """Return gain, phase, delay and modulus margin of walls, with their frequencies in Hz.

        With several crossovers, the nearest counts, as in python-control. ``gain_margin`` is the factor nearest to 1 on
        K and B together, ``phase_margin`` the smallest change of phase in degrees, and ``delay_margin`` the smallest
        additional delay in s that moves a pole onto the unit circle. ``modulus_margin`` is the smallest distance of L
        from -1. The factor and the phase apply to the whole force of the controller, including further feedback; with a
        simulated tool, they apply to the force of the coupling, without further feedback. The phase margin of an
        unstable wall is negative, its delay margin 0. The delay margin is computed with the exact discretization of
        every fractional delay, and is NaN if counts of poles below and above it do not confirm it. If no factor, phase
        or delay moves a pole onto the unit circle, the first three margins are infinite for a stable wall, and 0, NaN
        and 0 for an unstable one. Walls out of range are NaN. A rigid scene uses `zwidth.margins`. For other scenes,
        one wall takes about 0.1 s, and many walls in one call some ms per wall. With a simulated tool, the delay margin
        takes another 0.05 s per wall.
        """
        alpha, beta = self._broadcast_walls(stiffness, virtual_damping)
        hertz = 1.0 / (2.0 * np.pi * self.timing.period)
        margins = SceneMargins._make(self._loop_for(alpha, beta).margins(alpha, beta))
        return margins._replace(
            delay_margin=margins.delay_margin * self.timing.period,
            phase_crossover=margins.phase_crossover * hertz,
            gain_crossover=margins.gain_crossover * hertz,
            modulus_frequency=margins.modulus_frequency * hertz,
        )


def allows_negative(scene: SceneParts, negative_damping: bool | None) -> bool:
    """Return whether searches for the stiffest wall and for islands include walls with B < 0.

    By default such walls are included for a `zwidth.Device` whose velocity estimate is a positive multiple of the
    difference of two samples. They are excluded for a device given as a whole system: its true damping is unknown, so a
    wall with B < 0 would cancel modeled damping that may not exist. They are also excluded if the wall is the virtual
    coupling to a simulated tool.
    """
    if negative_damping is not None and not isinstance(negative_damping, bool | np.bool_):
        raise InputError(f"negative_damping: got {negative_damping!r}; pass True, False or None")
    if negative_damping is None and scene.tool is None and not isinstance(scene.device, ResponseDevice):
        if not scene.nonrigid_parts:
            return True
        if has_velocity(scene.position):
            return False
        estimate = scene.velocity.estimate(scene.timing.period)
        return bool(estimate.is_difference and estimate.gain > 0)
    return bool(negative_damping)


def refuse_slow_tool(scene: SceneParts, result: str) -> None:
    """Raise `InputError` if the tool has ``every`` > 1; ``result`` is the name of the unavailable result."""
    if scene.tool is not None and scene.tool.every != 1:
        raise InputError(f"tool.every: got {scene.tool.every}, but {result} needs one step per period; set every=1")


def _realize(scene: SceneParts, build: Callable[..., StateSpace], unit: float, alpha: Any, beta: Any) -> StateSpace:
    """Return a state-space model of the open or closed loop with one wall, with states in m, m/s and N.

    Args:
        scene: the scene.
        build: function that returns the model in normalized units for a chain of masses, alpha and beta.
        unit: SI value of one normalized unit of the ratio of output to input.
        alpha: normalized stiffness of the wall.
        beta: normalized damping of the wall.
    """
    chain, period, mass = scene.loop.chain, scene.timing.period, float(scene.mass)
    loop = build(chain, *read_single_wall(alpha, beta))
    force = mass / period**2
    device = np.array(chain.state_units(1.0 / period, force))
    n_delayed = int(sample_states(chain).lag)
    n_filter = loop.A.shape[0] - device.size - n_delayed
    # Units of the states in their order: states of the velocity estimate, states of the device, delayed forces.
    scale = np.concatenate([np.ones(n_filter), device, np.full(n_delayed, force)])
    A, B = loop.A * scale[:, None] / scale, loop.B * scale[:, None] * unit
    return StateSpace(A, B, loop.C / scale, loop.D * unit, period)


def to_control(scene: SceneAnalysis, stiffness: Wall = None, virtual_damping: Wall = None) -> control.StateSpace:
    """Return the closed loop of a scene and a wall as a model of python-control.

    The input is an external force on the device (N), the output the sensed position (m); see ``scene.state_space``.

    Args:
        scene: a `zwidth.Scene`.
        stiffness: K of the wall in N/m, one number. Without K and B, the wall of the scene is used.
        virtual_damping: B of the wall in N s/m, one number.

    Returns:
        control.StateSpace with ``dt`` the sampling period; states in m, m/s and N.

    Raises:
        InputError: python-control is not installed, or it is ambiguous which wall is meant.

    References:
        Fuller, Greiner, Moore, Murray, van Paassen, Yorke 2021 (python-control).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3))
        >>> zwidth.to_control(scene, 10e3, 5).dt
        0.001
    """
    try:
        import control
    except ImportError as error:
        raise InputError("to_control: python-control is not installed; run pip install control") from error
    return control.StateSpace(*scene.state_space(stiffness, virtual_damping))


def read_single_wall(alpha: np.ndarray, beta: np.ndarray) -> tuple[float, float]:
    """Return K and B (or alpha and beta) of one wall as floats; raise `InputError` for several walls."""
    alpha, beta = np.broadcast_arrays(alpha, beta)
    if alpha.size != 1:
        raise InputError(f"stiffness, virtual_damping: got shape {alpha.shape}; pass one wall of finite numbers")
    for name, value in (("stiffness", alpha), ("virtual_damping", beta)):
        if not np.isfinite(value).all():
            raise InputError(f"{name}: got {value.item():g}; pass a finite number")
    return float(alpha.reshape(())), float(beta.reshape(()))
