"""The public class `Scene`: device, timing, velocity estimate, operator and wall, with all analyses as methods.

The parts are checked in `zwidth.analysis.base`; the analyses are in `zwidth.analysis.walls` (one wall), `optimization`
(optimal walls) and `recommendation`. This module adds the stability boundary, the stable region and the simulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from zwidth.analysis.base import WallSI, wrap_methods
from zwidth.analysis.coupling import is_safe_for_every_world, max_safe_coupling
from zwidth.analysis.coupling_code import write_program
from zwidth.analysis.lightest_tool import lightest_tool
from zwidth.analysis.recommendation import SceneAdvice
from zwidth.analysis.unsafe_world import unsafe_world
from zwidth.core.errors import InputError
from zwidth.core.types import ArrayLike
from zwidth.core.xp import is_traced, namespace
from zwidth.model.checks import check_limit, read_texts
from zwidth.model.measured_device import MeasuredDevice
from zwidth.numerics.evaluate import as_float64
from zwidth.simulation.simulate import simulate
from zwidth.stability.linear.regions import Outline
from zwidth.units.display import ResultList
from zwidth.units.formatting import format_wall


@dataclass(frozen=True, repr=False)
class Scene(SceneAdvice):
    """A control loop that renders a virtual wall: device, timing, wall, velocity estimate and operator.

    Args:
        device: mass and damping, rigid or with a coupling, modes and an actuator; or a linear system; or a measured
            frequency response.
        timing: sampling period and delay.
        wall: the wall that `zwidth.assess` evaluates, and the default wall of the methods below. It may be omitted.
        velocity: velocity estimate; the backward difference by default.
        operator: the hand that holds the device; None for a released device.
        safe_limit: stiffest wall that measurements of the device support, usually set by a fit. `recommend` respects
            it; stability and maximum stiffness do not depend on it.
        position: position estimate from which the spring force is computed, such as a filter, an observer or a
            phase-locked loop (PLL); None for the measured position. The velocity is estimated from this position, or
            from the measured position with the argument ``velocity_from="measured"`` of the filter. An observer or PLL
            has its own velocity estimate, so ``velocity`` must be omitted.
        feedback: further force of the controller in addition to spring and damper, such as that of an integral gain;
            None for no such force.
        tool: simulated tool that a virtual coupling connects to the device. The stiffness and the damping of the wall
            are then those of the coupling. None for a fixed wall.

    Numerics:
        A scene is a JAX pytree whose leaves are its numbers, so that it can be an argument of functions inside ``jit``,
        ``vmap``, ``grad`` and other transformations. Inside these, `boundary`, `is_passive`, `is_stable`, `margins`,
        `max_stiffness`, `passivity_margin`, `required`, `sensitivities` and `spectral_radius` return the same values
        as direct calls, for every scene except one with a measured device. `poles` works for a rigid scene whose delay
        is not traced. All other methods raise `InputError` for traced values.

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(device, timing, velocity=zwidth.LowPass(cutoff=100))
        >>> scene.is_stable(10e3, [5, 40])
        array([False,  True])
    """

    @cached_property
    def traced_loop(self) -> Any:
        """Loop for parameters and walls that JAX traces, if the scene has no closed form; this property imports JAX."""
        if isinstance(self.device, MeasuredDevice):
            raise InputError("device: got a measured response inside jit, vmap or grad; use a model of the device")
        from zwidth.analysis.traced_loop import TracedLoop

        return TracedLoop(self)

    def boundary(self, omega: ArrayLike) -> WallSI:
        """Return the walls that have a pole pair on the unit circle at a given frequency.

        Args:
            omega: angular frequency in rad/s, between 0 and the Nyquist frequency ``pi/T``; or a text such as "80 Hz".

        Returns:
            ``stiffness`` in N/m and ``virtual_damping`` in N s/m; NaN for other frequencies.
        """
        if not is_traced(omega):
            omega = as_float64("omega", read_texts("omega", omega, "1/s"))
        w = omega * self.timing.period
        inside, units = (w > 0) & (w < np.pi), self.units
        alpha, beta = self._loop_for(w).critical_walls(namespace(w).where(inside, w, 1.0))
        walls = alpha * units.stiffness, beta * units.virtual_damping
        return WallSI(*(namespace(inside, part).where(inside, part, np.nan)[()] for part in walls))

    def stable_region(self) -> list[Outline]:
        """Return the closed boundary curves (outlines) of the set of stable walls, the largest first.

        Returns:
            A list of outlines with ``stiffness`` in N/m and ``virtual_damping`` in N s/m; ``hole`` is True if unstable
            walls lie inside, ``island`` if the outline belongs to one of the `islands`.
        """
        units = self.units
        return ResultList(
            Outline(piece.stiffness * units.stiffness, piece.virtual_damping * units.virtual_damping, *piece[2:])
            for piece in self.loop.outlines()
        )

    def code(
        self,
        stiffness: float | str | None = None,
        virtual_damping: float | str | None = None,
        language: Literal["c", "python"] = "c",
        *,
        max_force: float | str = math.inf,
    ) -> str:
        """Return a stable wall, or a coupling and its tool, as source code for a control loop.

        `Recommendation.code` returns the same code for the recommended wall, whose margins are known. This method
        accepts every stable wall, also one with small margins.

        Args:
            stiffness: K of the wall in N/m. Default: that of the scene.
            virtual_damping: B of the wall in N s/m. Default: that of the scene.
            language: "c" (C99 without any library) or "python".
            max_force: largest force of the motor in N; the code limits the force to it.

        Returns:
            Source code with a state, a function that initializes it at rest, and a function to call once per period.

        Raises:
            InputError: the wall is unstable, the scene has no wall, the language is unknown, or ``max_force`` is not
                positive.

        Example:
            >>> import zwidth
            >>> device, timing = zwidth.Device(mass="100 g", damping=10), zwidth.Timing(rate="1 kHz")
            >>> scene = zwidth.Scene(device, timing, tool=zwidth.Tool("300 g", every=8))
            >>> print(scene.code("1.4 kN/m", 0).splitlines()[1].strip())
            Tool: mass 300.0 g, semi-implicit Euler method, one step every 8 periods.
        """
        wall = {"stiffness": stiffness, "virtual_damping": virtual_damping}
        changes = {name: value for name, value in wall.items() if value is not None}
        scene = self.replace(**changes) if changes else self
        if not scene.is_stable():
            K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
            words = format_wall(K, B, scene.unit_system)
            raise InputError(f"code: the wall {words} is not stable; choose a stable wall by recommend or check")
        return write_program(scene, language, (), check_limit("max_force", max_force, scene.unit_system["N"]))

    is_safe_for_every_world = is_safe_for_every_world
    lightest_tool = lightest_tool
    max_safe_coupling = max_safe_coupling
    unsafe_world = unsafe_world
    simulate = simulate
    """Method that calls `zwidth.simulate` with this scene and all other arguments."""


# Methods that work inside the JAX transformations jit, vmap and grad. `poles` works there only for a rigid scene with
# the backward difference.
TRACEABLE = (
    "boundary",
    "dominant_pole",
    "is_passive",
    "is_stable",
    "margins",
    "max_stiffness",
    "normalize_walls",
    "parameters",
    "passivity_margin",
    "poles",
    "replace",
    "required",
    "sensitivities",
    "spectral_radius",
    "to_si",
)
# Do not wrap the two methods in ``but``: both are traceable and return numbers without units, so a wrapper has no
# effect but would slow down calls for single walls.
wrap_methods(Scene, traceable=TRACEABLE, but=("is_stable", "normalize_walls"))
