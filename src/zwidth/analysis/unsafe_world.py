"""Find a passive virtual world and a passive hand with which a virtual coupling is unstable.

The *coupling* is a spring K and a damper B between the device and the *world*, a tool with a mass and, in some cases, a
spring to ground. A coupling that violates the condition of `is_safe_for_every_world` is unstable with some world and
some hand. The search constructs both from the frequencies w (rad per period) that violate the condition
(docs/theory/passivity.md, U8). With the impedance C of the coupling, g = Re(1/C) and a delay of n periods, the world
that extracts the most energy at w is lossless. Its impedance Z_w follows from the impedance Z of coupling and world
together,

    1/Z = g (1 + j cot((n + 1) w/2)),     1/Z_w = 1/Z - 1/C

If the imaginary part X of Z_w is positive, the world is a mass, otherwise a mass with a spring to ground. The hand is a
mass, with a spring to ground so stiff that device and hand oscillate at w. In this module the sampling period and the
mass of the device are the units of time and mass: ``alpha = K T^2/m``, ``beta = B T/m``, ``delta = b T/m``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zwidth.analysis.coupling import find_delay, is_safe_for_every_world
from zwidth.analysis.walls import read_single_wall
from zwidth.core.status import Status
from zwidth.model.estimate import Estimate
from zwidth.model.mechanism import Body, Chain
from zwidth.plant.composed_plant import add_plants
from zwidth.plant.factored_plant import FactoredPlant, factor_chain
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.poles import compute_dominant_poles
from zwidth.stability.linear.roots import LoopRoots
from zwidth.stability.linear.rows import label_walls
from zwidth.units.display import compact_repr

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene
    from zwidth.analysis.walls import Wall

NODES = 800  # number of frequencies at which the condition of `is_safe_for_every_world` is evaluated
LOWEST = 1e-4  # lowest tested frequency, in rad per period
MAX_FREQUENCIES = 24  # largest number of frequencies that violate the condition and for which worlds are tested
MAX_MASSES = 6  # number of masses of the hand that are tested per frequency
HEAVIEST = 1e4  # ratio of the largest to the smallest tested mass of the hand
LEAST_GROWTH = 1e-13  # smallest logarithm of the spectral radius that counts as unstable, above rounding errors
TOOL_MASSES = 1e-6, 1e9  # smallest and largest mass of the tool, relative to the mass of the device


@compact_repr(
    tool_mass="kg", tool_stiffness="N/m", hand_mass="kg", hand_stiffness="N/m", frequency="Hz", spectral_radius="1"
)
class UnsafeWorld(NamedTuple):
    """A passive tool and a passive hand with which a virtual coupling is unstable; NaN if none is known."""

    tool_mass: float  # mass M of the tool in kg
    tool_stiffness: float  # stiffness k of the tool to ground in N/m
    hand_mass: float  # mass in kg that the hand adds to the device
    hand_stiffness: float  # stiffness of the hand to ground in N/m
    frequency: float  # frequency of the growing oscillation in Hz
    spectral_radius: float  # spectral radius of the loop, > 1
    status: Status  # OK; UNREACHABLE if the coupling is safe; NOT_CONVERGED if no world was found


class _World(NamedTuple):
    """Masses and stiffnesses of an `UnsafeWorld` in units in which sampling period and mass of the device are 1."""

    tool_mass: float
    tool_stiffness: float
    hand_mass: float
    hand_stiffness: float


def unsafe_world(scene: Scene, stiffness: Wall = None, virtual_damping: Wall = None) -> UnsafeWorld:
    """Return a passive tool and a passive hand with which a virtual coupling is unstable.

    Both exist if the coupling violates the condition of `is_safe_for_every_world`. The tool is a mass M with a spring k
    to ground. Its program integrates by the trapezoidal rule, so the tool is lossless: from the force f of the
    coupling, the velocity v, the force s of the spring and the position y, it computes the new values
    ``v' = v + T/(2M) (f' - s' + f - s)``, ``s' = s + k T/2 (v' + v)`` and ``y' = y + T v'``. The hand is a mass and a
    spring to ground, rigidly connected to the device. The tool and the operator of the scene have no effect.

    Args:
        stiffness: K of the coupling in N/m, one number; default: the stiffness of the scene's wall.
        virtual_damping: B of the coupling in N s/m, one number; default: the damping of the scene's wall.

    Returns:
        The tool and the hand with the largest spectral radius that the search found. ``status`` is OK only if the
        radius exceeds 1 and a count of the poles confirms that the loop is unstable. ``status`` is UNREACHABLE if the
        coupling is safe, and NOT_CONVERGED if the search found no world; the other fields are then NaN.

    Raises:
        InputError: as `is_safe_for_every_world`; or the coupling is not one pair of finite numbers.

    Numerics:
        With B = 0, the search finds a world if K exceeds about 1.00001 times the safe stiffness. With the B of the
        stiffest safe coupling, K must exceed 1.07 times (one period of delay) or 1.04 times (two periods) the safe
        stiffness, because a hand with a single resonance is not the worst operator at high frequencies. The search
        takes about 1 s.

    References:
        Colgate, Schenkel 1994 (the operator that destabilizes a wall that is not passive).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> world = scene.unsafe_world(5500, 0)
        >>> print(f"tool {world.tool_mass:.3f} kg, hand {world.hand_mass:.3f} kg, {world.spectral_radius > 1}")
        tool 0.085 kg, hand 0.000 kg, True
    """
    K, B = read_single_wall(*scene.normalize_walls(stiffness, virtual_damping))
    n_delay, mass, period = find_delay(scene), float(scene.device.mass), float(scene.timing.period)
    units = scene.units
    if is_safe_for_every_world(scene, K * units.stiffness, B * units.virtual_damping).item():
        return _report_none(Status.UNREACHABLE)
    share = float(scene.mass) / mass
    alpha, beta, delta = K * share, B * share, float(scene.device.damping) * period / mass
    found = _search(alpha, beta, delta, n_delay)
    if found is None:
        return _report_none(Status.NOT_CONVERGED)
    world, log_radius, angle = found
    unit, frequency = mass / period**2, angle / (2.0 * math.pi * period)
    return UnsafeWorld(
        world.tool_mass * mass,
        world.tool_stiffness * unit,
        world.hand_mass * mass,
        world.hand_stiffness * unit,
        frequency,
        math.exp(log_radius),
        Status.OK,
    )


def _report_none(status: Status) -> UnsafeWorld:
    """Return an `UnsafeWorld` with the given status whose other fields are NaN."""
    nan = math.nan
    return UnsafeWorld(nan, nan, nan, nan, nan, nan, status)


def _search(alpha: float, beta: float, delta: float, n_delay: int) -> tuple[_World, float, float] | None:
    """Return the world with the largest spectral radius, the logarithm of this radius, and the angle of its pole.

    The result is None if no world has a spectral radius above 1, or if pole counts confirm none of these worlds as
    unstable.
    """
    results = []
    for world in _list_worlds(alpha, beta, delta, n_delay):
        loop, share = _build_loop(world, delta, n_delay)
        log, angle = compute_dominant_poles(loop, np.array([alpha / share]), np.array([beta / share]))
        if log[0] > LEAST_GROWTH:
            results.append((float(log[0]), float(angle[0]), world))
    for log_radius, angle, world in sorted(results, reverse=True):
        loop, share = _build_loop(world, delta, n_delay)
        if not label_walls(Boundary.trace(loop), np.array([alpha / share]), np.array([beta / share]))[0]:
            return world, log_radius, angle
    return None


def _list_worlds(alpha: float, beta: float, delta: float, n_delay: int) -> list[_World]:
    """Return worlds to test: for each selected frequency, one tool, combined with hands of several masses."""
    w = np.union1d(np.geomspace(LOWEST, np.pi, NODES // 2), np.linspace(LOWEST, np.pi, NODES // 2))[:-1]
    one_minus_inverse = 1.0 - np.exp(-1j * w)
    coupling = beta + alpha / one_minus_inverse
    g = (1.0 / coupling).real
    phase = 0.5 * (n_delay + 1) * w
    excess = np.sin(phase) ** 2 / g - delta
    bad = np.flatnonzero(excess > 0)
    evenly = np.linspace(0, bad.size - 1, MAX_FREQUENCIES if bad.size else 0).astype(int)
    chosen = np.unique([*bad[evenly], np.argmax(excess)])
    with np.errstate(all="ignore"):
        susceptance = g / np.tan(phase) - (1.0 / coupling).imag
        X = -1.0 / susceptance
        stiffness = one_minus_inverse * np.exp(-1j * n_delay * w) / (1.0 / coupling + 1j * susceptance)
    # Stiffness of coupling and world at w: the real part of the ratio of the held force to the position of the device
    spring = (stiffness * one_minus_inverse / (1j * w)).real
    worlds = []
    for k in chosen.tolist():
        # The world needs the reactance X; a mass M has the reactance 2 M tan(w/2). If X < 0, combine a mass with the
        # reactance -X and a spring with the reactance 2 X.
        half = math.tan(0.5 * w[k])
        tool = float(np.clip(np.nan_to_num(abs(X[k]) / (2.0 * half), nan=np.inf), *TOOL_MASSES))
        spring_to_ground = -4.0 * X[k] * half if X[k] < 0 and tool < TOOL_MASSES[1] else 0.0
        lightest = max(1.0, spring[k] / w[k] ** 2)
        for mass in (lightest * np.geomspace(1.0, HEAVIEST, MAX_MASSES)).tolist():
            to_ground = max(mass * w[k] ** 2 - spring[k], 0.0)
            worlds.append(_World(tool, float(spring_to_ground), mass - 1.0, float(to_ground)))
    return worlds


def _build_loop(world: _World, delta: float, n_delay: int) -> tuple[LoopRoots, float]:
    """Return the loop of the coupling with a world, and its unit of mass: the mass of device and hand together."""
    M, k, hand_mass, hand_stiffness = world
    total = 1.0 + hand_mass
    body = Body(1.0, delta / total, hand_stiffness / total)
    device = factor_chain(Chain((body,), (), (), None, 0, float(n_delay), n_delay, Estimate()))
    # The tool has the response z (z + 1)/(2 M zeta^2 + (k/2) (z + 1)^2) from force to position, with zeta = z - 1.
    inertia, spring = 2.0 * M / total, 0.5 * k / total
    poles = -np.roots([inertia + spring, 4.0 * spring, 4.0 * spring]) if spring else np.zeros(2)
    tool = FactoredPlant(1.0 / (inertia + spring), 0, np.array([1.0, 2.0], complex), poles.astype(complex))
    return LoopRoots(**vars(add_plants(device, tool)), estimate=Estimate()), total
