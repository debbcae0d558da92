"""Compute the masses of a simulated tool with which a virtual coupling is stable.

The *coupling* is a spring K and a damper B between the device and the *tool*, a mass M that the computer simulates. The
closed loop is ``1 + C G + C_t G_t = 0`` with the responses G of the device and G_t of the tool, ``C = K + B F`` and
``C_t = K + B V_t`` with the velocity estimates F and V_t of device and tool. It has a pole at z = e^(jw) on the unit
circle if ``1/G_t = R`` with ``R = -C_t/(1 + C G)``. Because 1/G_t is affine in M (`model.tool`), this equation yields
one complex M at each angle w. If this M is real and positive, it is a *critical mass*. Between two neighboring critical
masses, the coupling is stable with every mass or with none (docs/theory/passivity.md, U6).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zwidth.analysis.walls import read_single_wall, refuse_slow_tool
from zwidth.core.errors import check_choice
from zwidth.core.status import Status
from zwidth.model.circle_functions import circle_points
from zwidth.model.tool import Integrator, Tool
from zwidth.numerics.root_finding import find_zeros_between
from zwidth.stability.linear.composition import find_roots
from zwidth.stability.linear.curve import place_nodes
from zwidth.units.display import compact_repr
from zwidth.units.quantities import CHOICES, SI_RANGE

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene
    from zwidth.analysis.walls import Wall

REFINEMENT = 8  # steps of the angle w between two neighboring points of the loop's frequency grid
# Factor between the largest (or smallest) critical mass and the mass that is tested in place of all larger (or smaller)
# masses.
OUTSIDE = 4.0


@compact_repr(mass="kg", heaviest="kg", intervals="kg")
class LightestTool(NamedTuple):
    """Range of tool masses in kg with which a virtual coupling is stable, from the lightest to the heaviest tool."""

    mass: float  # lower end of the highest stable interval; 0 if it contains arbitrarily light tools
    heaviest: float  # upper end of the highest stable interval; infinite if it contains arbitrarily heavy tools
    intervals: tuple[tuple[float, float], ...]  # lower and upper end of each stable interval, ascending
    status: Status  # OK, or NO_BOUNDARY if no mass is stable


def lightest_tool(
    scene: Scene,
    stiffness: Wall = None,
    virtual_damping: Wall = None,
    *,
    integrator: Integrator | None = None,
) -> LightestTool:
    """Return the smallest mass of a simulated tool with which a virtual coupling is stable.

    Only the mass of the tool varies. Its damping and its stiffness to ground are those of the scene's tool, or 0 if the
    scene has no tool.

    Args:
        stiffness: K of the coupling in N/m, one number; default: the stiffness of the scene's wall.
        virtual_damping: B of the coupling in N s/m, one number; default: the damping of the scene's wall.
        integrator: "semi-implicit" or "implicit"; default: the integrator of the scene's tool, or "semi-implicit".

    Returns:
        ``intervals`` contains all intervals of masses in kg with which the coupling is stable. ``mass`` and
        ``heaviest`` are the ends of the highest interval. ``mass`` is 0 if this interval contains arbitrarily light
        tools. ``heaviest`` is infinite if the coupling is also stable with a fixed tool, i.e. as a wall. If the
        coupling is unstable with every tool, both are NaN and ``status`` is NO_BOUNDARY.

    Raises:
        InputError: the device is given by a measured response, the scene's tool makes one step per several periods
            (``every`` > 1), or the coupling is not one pair of finite numbers.

    Numerics:
        The critical masses, at which a pole is on the unit circle, are computed. They divide all masses into intervals,
        and a count of the unstable poles at one mass decides whether an interval is stable.

    References:
        Colgate, Stanley, Brown 1995, Proc. IROS, vol. 3 (smallest tool mass with a virtual coupling).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> print(f"{1e3 * scene.lightest_tool(4900, 2).mass:.2f} g")
        2.22 g
        >>> scene.lightest_tool(4900, 2, integrator="implicit").mass
        0.0
    """
    refuse_slow_tool(scene, "lightest_tool")
    tool = scene.tool or Tool(1.0)
    integrator = integrator or tool.integrator
    check_choice("integrator", integrator, CHOICES["tool.integrator"].names)
    K, B = read_single_wall(*scene.normalize_walls(stiffness, virtual_damping))
    units = scene.units
    masses = _find_critical_masses(scene, Tool(1.0, tool.damping, tool.stiffness, integrator), K, B)
    ends = np.concatenate([[0.0], masses, [np.inf]])
    inner = np.sqrt(masses[1:] * masses[:-1])
    tested = np.concatenate([masses[:1] / OUTSIDE, inner, masses[-1:] * OUTSIDE]) if masses.size else np.ones(1)
    stable = np.array(
        [
            bool(
                scene.replace(tool=Tool(mass, tool.damping, tool.stiffness, integrator)).is_stable(
                    K * units.stiffness, B * units.virtual_damping
                )
            )
            for mass in tested.tolist()
        ]
    )
    bounds = np.diff(np.pad(stable.astype(int), 1))
    intervals = tuple(zip(ends[:-1][bounds[:-1] > 0].tolist(), ends[bounds < 0].tolist(), strict=True))
    return (
        LightestTool(*intervals[-1], intervals, Status.OK)
        if intervals
        else LightestTool(math.nan, math.nan, (), Status.NO_BOUNDARY)
    )


def _find_critical_masses(scene: Scene, tool: Tool, alpha: float, beta: float) -> np.ndarray:
    """Return the masses of the tool in kg, ascending, at which the closed loop has a pole on the unit circle.

    ``alpha`` and ``beta`` are the normalized K and B of the coupling; the mass of ``tool`` has no effect.
    """
    chain = scene.replace(tool=None).loop.chain
    loop, of_tool = find_roots(chain), chain.estimate if chain.estimates is None else chain.estimates.of_tool
    mass, period = float(scene.mass), float(scene.timing.period)
    one, three = (Tool(m * mass, tool.damping, tool.stiffness, tool.integrator).respond(mass, period) for m in (1, 3))

    def find_mass(w: np.ndarray) -> np.ndarray:
        """Return the complex M that solves 1/G_t = R at each angle w, in units of the mass of the device."""
        points = circle_points(w)
        with np.errstate(all="ignore"):
            controller, coupling = (alpha + beta * each.jet(points).value for each in (loop.estimate, of_tool))
            target = -coupling / (1.0 + controller * loop.evaluate_response(points).value)
            first, third = (
                ((r.a2 * points.z_minus_1 + r.a1) * points.z_minus_1 + r.a0) / (r.gain * points.z**r.power)
                for r in (one, three)
            )
            return 1.0 + 2.0 * (target - first) / (third - first)

    nodes = place_nodes(loop)
    w = np.unique(np.interp(np.arange(REFINEMENT * (nodes.size - 1) + 1) / REFINEMENT, np.arange(nodes.size), nodes))
    values = np.imag(find_mass(w))
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    angles = np.concatenate([find_zeros_between(lambda w: np.imag(find_mass(w)), w, values, k), [w[0], np.pi]])
    masses = np.unique(np.real(find_mass(angles))) * mass
    return masses[(masses > SI_RANGE[0] * OUTSIDE) & (masses < SI_RANGE[1] / OUTSIDE)]
