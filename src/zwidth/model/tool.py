"""Model of a simulated tool: a mass with a damper and a spring to its rest position, integrated by the control program.

A *virtual coupling*, a spring K and a damper B, connects the tool to the device. Each period, the program samples the
position x of the device, computes the force f of the coupling from x and the position y of the tool, commands -f to the
device, and integrates the tool by one step of length T. With the mass M, the damping c and the stiffness k of the tool,
the response G_t = y/f of the tool is (docs/theory/passivity.md, U4)

    semi-implicit Euler   G_t = (T^2/M) z/(zeta^2 + (p + q) zeta + q)
    implicit Euler        G_t = (T^2/M) z^2/((1 + p + q) zeta^2 + (p + 2 q) zeta + q)

with zeta = z - 1, p = c T/M and q = k T^2/M.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, get_args

from zwidth.model.checks import Part

Integrator = Literal["semi-implicit", "implicit"]


class ToolResponse(NamedTuple):
    """The response ``gain z^power/(a2 zeta^2 + a1 zeta + a0)`` from the coupling force to the position of the tool."""

    gain: Any
    power: int
    a2: Any
    a1: Any
    a0: Any


class ToolStep(NamedTuple):
    """One step of a tool, which adds w to its position y: ``w = decay w - spring y + gain f; y = y + w``."""

    decay: Any
    spring: Any
    gain: Any
    implicit: Any  # True if the force f of the coupling is computed from the new y, False if from the old y
    every: Any  # number of sampling periods per step


@dataclass(frozen=True, repr=False)
class Tool(Part):
    """A simulated tool (proxy, avatar) that a virtual coupling connects to the device.

    In a scene with a tool, the stiffness K and the damping B of the wall are those of the coupling. The force of the
    coupling at sample k is ``f = K (x - y) + B (v_x - v_y)`` with the sampled position x of the device and the position
    y of the tool. The velocity v_x - v_y is the velocity estimate of the scene, applied to x - y. The force acts on the
    tool in the same period, without delay, because the program also simulates the tool. The force acts on the device
    with the delay of the scene.

    If the scene has a position estimate P, the coupling uses P x in place of x. If an observer or PLL estimates the
    velocity v_x, then v_y is the backward difference of y. Further feedback acts on the device only.

    Args:
        mass: mass M of the tool in kg, > 0.
        damping: damping c between tool and ground in N s/m, >= 0.
        stiffness: stiffness k between tool and ground in N/m, >= 0.
        integrator: integration method, with one step per period. "semi-implicit" Euler, the usual method of physics
            engines, computes ``v += T (f - c v - k y)/M; y += T v``, where f is computed from the old y. "implicit"
            Euler evaluates f, c v and k y at the new values of v and y, so the program solves for f and y together.

    Numerics:
        A tool that is integrated by semi-implicit Euler is not passive: without damping, the real part of its impedance
        at the angular frequency w is ``M (cos(w T) - 1)/T < 0``. Therefore `Scene.is_safe_for_every_world` is not valid
        for this tool. A tool that is integrated by implicit Euler is passive.

        With ``every`` = N > 1, the loop has the period N T (docs/theory/passivity.md, U9). The methods of a scene that
        return stability, spectral radius, poles, stable intervals or the maximum stiffness compute the eigenvalues of
        its monodromy matrix, which maps the state of the loop over N periods. Methods that need the stability boundary
        raise `InputError`. `Scene.poles` returns these eigenvalues. Spectral radius and decay rate refer to one period.
        The frequency of the dominant pole is between 0 and ``1/(2 N T)``, because an eigenvalue does not determine
        multiples of ``1/(N T)``. `Scene.max_stiffness` searches couplings with B >= 0 on a grid with at least 96 values
        of B and 32 values of K per decade, and refines the highest values. It does not find regions that are narrower
        than the grid. It takes about 0.5 s.

    References:
        Colgate, Stanley, Brown 1995, Proc. IROS, vol. 3 (virtual coupling); Adams, Hannaford 1999, IEEE Trans. Robotics
        and Automation 15 (coupling with a tool).

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3)
        >>> print(f"{zwidth.Scene(device, timing, tool=zwidth.Tool(mass=0.3)).max_stiffness().stiffness:.0f} N/m")
        22201 N/m
        >>> slow = zwidth.Scene(device, timing, tool=zwidth.Tool(mass=0.3, every=16))  # 62.5 Hz
        >>> print(f"K < {slow.stable_stiffness(0)[0, 1]:.0f} N/m at B = 0")
        K < 1282 N/m at B = 0
    """

    _owner = "tool"
    # Presets of the tool on the page of ``zwidth explore``: constructor arguments, keyed by the name of the preset.
    usual: ClassVar[dict[str, dict[str, Any]]] = {
        name: {"mass": 0.3, "damping": 0.0, "stiffness": 0.0, "integrator": name} for name in get_args(Integrator)
    }

    mass: Any
    damping: Any = 0.0
    stiffness: Any = 0.0
    integrator: Integrator = "semi-implicit"
    every: int = 1

    def respond(self, mass: Any, period: Any) -> ToolResponse:
        """Return the response G_t = y/f of the tool divided by T^2/m, its unit in m/N.

        Args:
            mass: m in kg, the unit of mass of the scene.
            period: sampling period T in s; ``every`` must be 1.
        """
        rate = period / self.mass
        p, q = self.damping * rate, self.stiffness * (rate * period)
        if self.integrator == "implicit":
            return ToolResponse(mass / self.mass, 2, p + q + 1.0, p + q + q, q)
        return ToolResponse(mass / self.mass, 1, p * 0.0 + 1.0, p + q, q)

    def compute_step(self, mass: Any, period: Any) -> ToolStep:
        """Return the integration step of the tool in normalized units: f is the force multiplied by T^2/m.

        Args:
            mass: m in kg, the unit of mass of the scene.
            period: sampling period T in s.
        """
        every = self.every
        rate = every * period / self.mass
        p, q, gain = self.damping * rate, self.stiffness * (rate * every * period), every**2 * mass / self.mass
        if self.integrator == "implicit":
            scale = 1.0 / (1.0 + p + q)
            return ToolStep(scale, q * scale, gain * scale, True, every)
        return ToolStep(1.0 - p, q, gain, False, every)
