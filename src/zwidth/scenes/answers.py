"""What a scene answers of its walls, in SI units: labels, poles, margins, passivity, state space, responses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from zwidth.arrays.evaluate import are_numbers, as_float64, broadcast_traced, join_shapes
from zwidth.loops.linear.held import realize_closed_loop, realize_device, realize_open_loop
from zwidth.loops.linear.passivity import find_unsupported_reason
from zwidth.loops.linear.rows import Island
from zwidth.loops.rigid.verdict import STABILITY_METHODS, StabilityMethod
from zwidth.parts.checks import read_texts
from zwidth.parts.linear_device import WholeDevice
from zwidth.parts.state_space import StateSpace
from zwidth.parts.wall import resolve_wall
from zwidth.scenes.base import SceneParts
from zwidth.words.errors import InputError, check_choice
from zwidth.words.results import Margins, Stability
from zwidth.words.showing import shown
from zwidth.words.types import Array, ArrayLike
from zwidth.words.xp import is_traced, namespace

if TYPE_CHECKING:
    import control

# K or B of walls, texts with a unit as well; None means those of the scene's own wall.
Walls: TypeAlias = ArrayLike | None
Wall: TypeAlias = float | str | None


@shown(phase_margin="degrees", delay_margin="s", phase_crossover="Hz", gain_crossover="Hz", modulus_frequency="Hz")
class SceneMargins(Margins):
    """`zwidth.Margins` of a wall of a scene, with the delay margin in s and the frequencies in Hz."""


class SceneAnswers(SceneParts):
    """The methods of `zwidth.Scene` that evaluate walls.

    Without a stiffness and a damping, each method evaluates the wall of the scene (`zwidth.parts.wall.resolve_wall`). A
    quantity may be a text with a unit, such as "10 kN/m".
    """

    def normalize_walls(self, stiffness: Walls = None, virtual_damping: Walls = None) -> tuple[np.ndarray, np.ndarray]:
        """Return alpha and beta of walls in SI units, as arrays that broadcast; by default of the wall of the scene."""
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
        """Return alpha and beta of walls given in SI units, broadcast to a common shape."""
        walls = self.normalize_walls(stiffness, virtual_damping)
        self._check_traceable(*walls)
        return namespace(*walls).broadcast_arrays(*walls)

    def _check_traceable(self, *values: Any) -> None:
        """Raise `InputError` if JAX traces a value and the loop is not traceable."""
        if is_traced(*values) and not self.loop.traceable:
            raise InputError(
                f"{self.traced_path or 'stiffness, virtual_damping'}: got a value that JAX traces, which needs a rigid "
                "device with the backward difference; pass numbers, outside of jit, vmap and grad"
            )

    def poles(self, stiffness: Walls = None, virtual_damping: Walls = None) -> np.ndarray:
        """All poles of walls, along a new last axis and in no particular order; NaN where a wall is out of range.

        Eigenvalues of the companion matrix, then Aberth's steps on the factored polynomial around z = 1: a simple pole
        is right to about 1e-15 times its condition, a k-fold one to about 1e-16^(1/k). O(degree^3) a wall.
        """
        return self.loop.poles(*self._broadcast_walls(stiffness, virtual_damping))

    def spectral_radius(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """The largest pole magnitude of walls, below 1 exactly where `is_stable` is true; NaN where not known.

        From all poles; beyond 150 of them by counting poles in circles, at a cost that does not grow with the delay.
        """
        return self.loop.radius(*self._broadcast_walls(stiffness, virtual_damping))

    def islands(self, *, negative_damping: bool | None = None) -> list[Island]:
        """The islands: pieces of the stable set that no path of stable walls leads to from soft ones.

        A wall on an island is stable, but as its stiffness falls it becomes unstable before it is soft, whatever B does
        meanwhile. It does not count for `max_stiffness`.

        Args:
            negative_damping: as for `max_stiffness`; False leaves out islands that lie in B <= 0.

        Returns:
            A list, the stiffest first; ``stiffness`` in N/m and ``virtual_damping`` in N s/m are pairs, the least and
            the largest of the island. Empty for a rigid scene, whose stable walls are one piece.

        Example:
            >>> import zwidth
            >>> timing, window = zwidth.Timing(period=1e-3, delay=1e-3), zwidth.WindowedDifference(samples=24)
            >>> (island,) = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=window).islands()
            >>> print("{:.0f} to {:.0f} N/m".format(*island.stiffness))
            7537 to 9037 N/m
        """
        units = np.array([self.units.stiffness, self.units.virtual_damping])[:, None]
        found = self.loop.islands(-np.inf if allows_negative(self, negative_damping) else 0.0)
        return [Island(*(tuple(pair.tolist()) for pair in np.array(one) * units)) for one in found]

    def state_space(self, stiffness: Wall = None, virtual_damping: Wall = None) -> StateSpace:
        """The closed loop with one wall, from a force held on the device (N) to the sensed position (m).

        Exactly discretized, with the estimate and the forces on their way as states: A, B, C, D and the period dt.
        """
        compliance = self.timing.period**2 / float(self.mass)
        return _realize(self, realize_closed_loop, compliance, *self.normalize_walls(stiffness, virtual_damping))

    def open_loop(self, stiffness: Wall = None, virtual_damping: Wall = None) -> StateSpace:
        """The open loop L with one wall, as `state_space`; closed by negative feedback it is that loop."""
        return _realize(self, realize_open_loop, 1.0, *self.normalize_walls(stiffness, virtual_damping))

    def frequency_response(
        self, stiffness: Walls = None, virtual_damping: Walls = None, frequency: ArrayLike | None = None
    ) -> Array:
        """The open loop ``L = (K + B F) G``, complex, at frequencies in Hz up to half the sampling rate.

        All three broadcast; the wall is stable or not by how L winds around -1. NaN for other frequencies.
        """
        if frequency is None:
            raise InputError("frequency: none is given; give frequencies in Hz, up to half the sampling rate")
        alpha, beta = np.broadcast_arrays(*self.normalize_walls(stiffness, virtual_damping))
        hertz = as_float64("frequency", read_texts("frequency", frequency, "Hz"))
        join_shapes([("frequency", hertz.shape), ("stiffness", alpha.shape), ("virtual_damping", beta.shape)])
        hertz, alpha, beta = np.broadcast_arrays(hertz, alpha, beta)
        w = 2.0 * np.pi * hertz * self.timing.period
        # Half the sampling rate is half a turn, whatever the rounding of the quotient.
        w = np.where(np.abs(w - np.pi) < 1e-14, np.pi, w)
        inside = (w > 0) & (w <= np.pi)
        value = self.loop.open_loop(alpha, beta, np.where(inside, w, 1.0))
        return np.where(inside, value, complex(np.nan, np.nan))[()]

    def is_stable(
        self, stiffness: Walls = None, virtual_damping: Walls = None, *, method: StabilityMethod = "auto"
    ) -> Array:
        """Whether walls are stable: every pole strictly inside the unit circle.

        Args:
            stiffness: K in N/m.
            virtual_damping: B in N s/m. Both broadcast; neither means the scene's own wall.
            method: as for `decide_stability`, which has the statuses as well.

        Returns:
            Boolean array of the broadcast shape, False for what is NaN or, in arrays, out of range.

        Raises:
            InputError: a single wall is out of range; it is not said which wall is meant. K alone, with B = 0, is meant
                where the scene has no wall.

        Numerics:
            Closed form for a rigid device with the backward difference. Otherwise by the signed crossings of each
            row (`loops.linear.boundary`): the first call lays out the boundary (some 5 to 20 ms), then each damping
            costs some microseconds and a stiffness next to nothing.
        """
        if method != "auto":
            return self.decide_stability(stiffness, virtual_damping, method=method).stable
        walls = self.normalize_walls(stiffness, virtual_damping)
        self._check_traceable(*walls)
        return self.loop.labels(*walls)

    def stable_stiffness(self, virtual_damping: ArrayLike | None = None) -> np.ndarray:
        """Return all stable intervals of the stiffness at a damping.

        Args:
            virtual_damping: B in N s/m, a number or an array; by default that of the wall of the scene, or 0 without a
                wall.

        Returns:
            Array of shape (n, 2) in N/m; for an array of dampings, of shape (*shape, n, 2), with NaN if a damping has
            fewer intervals. The intervals are open.
        """
        given = self.wall.virtual_damping if virtual_damping is None else virtual_damping
        damping = read_texts("virtual_damping", given, self.unit_system["N s/m"])
        beta = as_float64("virtual_damping", damping) / self.units.virtual_damping
        both = self.loop.row(beta.reshape(-1)) * self.units.stiffness
        return both.reshape(*beta.shape, *both.shape[1:])

    def stable_damping(self, stiffness: Wall = None) -> np.ndarray:
        """Return all stable intervals of the virtual damping at one stiffness.

        Args:
            stiffness: K in N/m; by default that of the wall of the scene.

        Returns:
            Array of shape (n, 2) in N s/m. The intervals are open.
        """
        stiffness = resolve_wall(self.wall, None, None, self.unit_system)[0] if stiffness is None else stiffness
        alpha, _ = one_wall(*self.normalize_walls(stiffness, 0.0))
        return self.loop.column(alpha) * self.units.virtual_damping

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
        return self.loop.dampers() * self.units.virtual_damping

    def decide_stability(
        self, stiffness: Walls = None, virtual_damping: Walls = None, *, method: StabilityMethod = "auto"
    ) -> Stability:
        """Return the label, status and method of each wall, as `zwidth.decide_stability` does.

        "auto" and "crossover" sum the signed crossings of each line of constant B; "companion" computes all poles;
        "certified" decides in ball arithmetic of python-flint for exactly the given parameters, or returns UNDECIDED
        or ON_BOUNDARY.
        """
        check_choice("method", method, STABILITY_METHODS)
        alpha, beta = np.broadcast_arrays(*self.normalize_walls(stiffness, virtual_damping))
        walls = (
            np.asarray(part, float) for part in resolve_wall(self.wall, stiffness, virtual_damping, self.unit_system)
        )
        K, B = np.broadcast_arrays(*walls)
        return self.loop.decide(alpha, beta, method, (K, B))

    def explain_undecided(self, stiffness: Walls = None, virtual_damping: Walls = None) -> list[str]:
        """Why the measured response of a device leaves one wall UNDECIDED, and at which frequencies to measure.

        A sentence each; none where the wall is decided, as it is of every device that is a model.
        """
        return self.loop.explain(*one_wall(*self.normalize_walls(stiffness, virtual_damping)))

    def passivity_margin(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """The device's own damping in excess of what a passive wall needs, in N s/m; NaN where a wall is out of range.

        Colgate's condition for any velocity estimate and delay, with the largest need proved over all frequencies
        (`loops.linear.passivity`); exact for a rigid device, whatever the hand. With a coupling and the sensor at the
        motor the motor's own damping counts, which is sufficient and not necessary; with the sensor at the tip, with an
        actuator and with modes there is no such condition, and InputError says so. A wall that pushes has at most its
        K T.
        """
        if obstacle := find_unsupported_reason(**vars(self.device)):
            raise InputError(f"passivity {obstacle}")
        alpha, beta = self._broadcast_walls(stiffness, virtual_damping)
        return self.loop.passivity_margin(alpha, beta) * self.units.virtual_damping

    def is_passive(self, stiffness: Walls = None, virtual_damping: Walls = None) -> Array:
        """Whether walls are passive by their `passivity_margin`: then no passive hand makes them unstable."""
        margin = self.passivity_margin(stiffness, virtual_damping)
        return (margin if is_traced(margin) else np.asarray(margin)) > 0

    def margins(self, stiffness: Walls = None, virtual_damping: Walls = None) -> SceneMargins:
        """Gain, phase, delay and modulus margin of walls, with the frequencies where they are taken, in Hz.

        Of several crossovers the nearest counts, as in python-control: ``gain_margin`` is the factor nearest to 1 on K
        and B together, and ``phase_margin`` the least turn in degrees, that bring a pole to the unit circle; the turn
        is negative for an unstable wall. ``delay_margin`` in s is the least extra delay that does, held as the hardware
        does it, fraction by fraction with the exact loop (0 for an unstable wall, NaN where poles counted before and
        beyond do not confirm it); ``modulus_margin`` is the least distance of L from -1. Where no factor, turn or delay
        brings a pole there, the first three are infinite for a stable wall, and 0, NaN and 0 for an unstable one.
        Walls out of range are NaN. A rigid scene answers by `zwidth.margins`. A wall takes some milliseconds, its
        delay margin some 0.1 s.
        """
        alpha, beta = self._broadcast_walls(stiffness, virtual_damping)
        hertz = 1.0 / (2.0 * np.pi * self.timing.period)
        found = SceneMargins._make(self.loop.margins(alpha, beta))
        return found._replace(
            delay_margin=found.delay_margin * self.timing.period,
            phase_crossover=found.phase_crossover * hertz,
            gain_crossover=found.gain_crossover * hertz,
            modulus_frequency=found.modulus_frequency * hertz,
        )


def allows_negative(scene: SceneParts, negative_damping: bool | None) -> bool:
    """Return whether walls with B < 0 count.

    By default they count for a `zwidth.Device` whose velocity is a positive multiple of the difference of two samples.
    They do not count for a device given as a whole system: its true damping is unknown, so a wall with B < 0 would
    cancel modeled damping that may not exist.
    """
    if negative_damping is None and isinstance(scene.device, WholeDevice):
        return False
    if negative_damping is None:
        estimate = scene.velocity.estimate(scene.timing.period)
        return estimate.is_difference and bool(is_traced(estimate.gain) or estimate.gain > 0)
    if not isinstance(negative_damping, bool | np.bool_):
        raise InputError(f"negative_damping: got {negative_damping!r}; it is True, False or None")
    return bool(negative_damping)


def _realize(scene: SceneParts, build: Callable[..., StateSpace], unit: float, alpha: Any, beta: Any) -> StateSpace:
    """A loop with one wall, its states in m, m/s and N in place of units of the period and the mass."""
    chain, period, mass = scene.loop.chain, scene.timing.period, float(scene.mass)
    loop = build(chain, *one_wall(alpha, beta))
    force = mass / period**2
    own = np.array(chain.state_units(1.0 / period, force))
    waiting = realize_device(chain).A.shape[0] - own.size
    filtered = loop.A.shape[0] - own.size - waiting
    scale = np.concatenate([np.ones(filtered), own, np.full(waiting, force)])
    A, B = loop.A * scale[:, None] / scale, loop.B * scale[:, None] * unit
    return StateSpace(A, B, loop.C / scale, loop.D * unit, period)


def to_control(scene: SceneAnswers, stiffness: Wall = None, virtual_damping: Wall = None) -> control.StateSpace:
    """Return the closed loop of a scene and a wall as a model of python-control.

    From a force held on the device (N) to the sensed position (m), exactly discretized: ``scene.state_space``.

    Args:
        scene: a `zwidth.Scene`.
        stiffness: K of the wall in N/m, one number; the scene's own wall where neither is given.
        virtual_damping: B of the wall in N s/m, one number.

    Returns:
        control.StateSpace with ``dt`` the sampling period; states in m, m/s and N.

    Raises:
        InputError: python-control is not installed; it is not said which wall is meant.

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
        raise InputError("to_control: python-control is not installed; pip install control") from error
    return control.StateSpace(*scene.state_space(stiffness, virtual_damping))


def one_wall(alpha: np.ndarray, beta: np.ndarray) -> tuple[float, float]:
    """Return K and B (or alpha and beta) of one wall as floats; raise `InputError` for several walls."""
    alpha, beta = np.broadcast_arrays(alpha, beta)
    if alpha.size != 1:
        raise InputError(f"stiffness, virtual_damping: got shape {alpha.shape}; one wall of finite numbers is needed")
    for name, value in (("stiffness", alpha), ("virtual_damping", beta)):
        if not np.isfinite(value).all():
            raise InputError(f"{name}: got {value.item():g}; a finite number is needed")
    return float(alpha.reshape(())), float(beta.reshape(()))
