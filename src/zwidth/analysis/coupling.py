"""Virtual couplings of a scene that are stable with every passive virtual world (`stability.rigid.virtual_coupling`).

A virtual coupling is a spring K and a damper B between the device and a tool, an object that the computer simulates.
If the tool were fixed, the coupling would be a wall; by default, K and B are therefore those of the scene's wall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zwidth.analysis.walls import refuse_slow_tool
from zwidth.core.errors import InputError
from zwidth.stability.rigid.virtual_coupling import find_margin, find_stiffest
from zwidth.units.display import compact_repr

# Relative distance of the stiffest safe coupling from the limit; the search for the limit is accurate to about 1e-15.
INWARD = 1e-12

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene
    from zwidth.analysis.walls import Walls


@compact_repr()
class SafeCoupling(NamedTuple):
    """The stiffest virtual coupling that is stable with every passive virtual world, in N/m and N s/m."""

    stiffness: float
    virtual_damping: float


def is_safe_for_every_world(scene: Scene, stiffness: Walls = None, virtual_damping: Walls = None) -> np.ndarray:
    """Return whether virtual couplings are stable with every passive tool, virtual world and operator.

    The condition is ``b (B + KT/2) >= sin^2((n+1)w/2) [(B + KT/2)^2 + (KT/2)^2 cot^2(w/2)]`` at all frequencies w
    (rad per period), with the damping b of the device, the period T and a delay of n periods; the mass has no effect.
    The velocity of a tool is the backward difference ``(y_k - y_(k-1))/T`` of its position. A simulated tool is passive
    if the real part of its impedance, i.e. of coupling force divided by this velocity, is negative at no frequency.
    Tools that are integrated by the implicit Euler method are passive. Tools whose velocity v follows from the
    trapezoidal rule are passive if the position follows from the new velocity, ``y += T v``. **Tools that are
    integrated by the semi-implicit Euler method, which most physics engines use, are not passive.** Tools whose
    velocity and position both follow from the trapezoidal rule are not passive, either. If a tool is light and not
    passive, the coupling can be unstable although this function returns True.

    Args:
        stiffness: K in N/m, >= 0; default: the stiffness of the scene's wall.
        virtual_damping: B in N s/m, >= 0; default: the damping of the scene's wall.

    Returns:
        Boolean array of the broadcast shape; False for couplings out of range.

    Raises:
        InputError: the device is not rigid, the velocity estimate is not the backward difference, or the delay is not
            an integer number of periods; the condition is not known for them.

    References:
        Colgate, Schenkel 1994, applied to all impedances with Re(1/Z) >= Re(1/(B + K T/(1 - 1/z))).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> scene.is_safe_for_every_world([4900, 5100, 7600], [0, 0, 2.83])
        array([ True, False,  True])
    """
    n_delay = find_delay(scene)
    alpha, beta = np.broadcast_arrays(*scene.normalize_walls(stiffness, virtual_damping))
    delta = float(scene.device.damping) / scene.units.virtual_damping
    with np.errstate(all="ignore"):
        safe = find_margin(0.5 * alpha / delta, beta / delta, n_delay) >= 0
    # Without physical damping, the only safe coupling is none, K = B = 0.
    return safe if delta > 0 else (alpha == 0) & (beta == 0)


def max_safe_coupling(scene: Scene) -> SafeCoupling:
    """Return the stiffest virtual coupling with B >= 0 that is stable with every passive tool, world and operator.

    The stiffness is ``k b/T`` and the damping ``r b``, with the damping b of the device, the period T, and factors k
    and r that depend only on the delay: k = 2 without delay, 0.770 with one period of delay. For the condition, for
    simulated worlds that are not passive, and for errors, see `is_safe_for_every_world`.

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> scene.max_safe_coupling()
        SafeCoupling(stiffness=7.698 kN/m, virtual_damping=2.81766 N s/m)
    """
    spring, damper = find_stiffest(find_delay(scene))
    # Reduce the stiffness slightly, so that `is_safe_for_every_world` is true in spite of rounding errors.
    spring *= 1.0 - INWARD
    damping = float(scene.device.damping)
    return SafeCoupling(2.0 * spring * damping / float(scene.timing.period), damper * damping)


def find_delay(scene: Scene) -> int:
    """Return the delay, an integer number of periods; raise `InputError` if no condition is known for the scene."""
    refuse_slow_tool(scene, "the condition for every passive world")
    # Ignore the operator and the tool of the scene, because the condition holds for every passive operator and tool.
    unsupported = [part for part in scene.nonrigid_parts if part not in ("operator", "tool")]
    if unsupported:
        raise InputError(
            f"{unsupported[0]}: the condition is known only for a rigid device with the backward difference; "
            "use is_stable of a scene with the tool"
        )
    delay = float(scene.timing.d)
    if delay != round(delay):
        raise InputError(
            f"delay: got {delay:g} periods; the condition is known only for integer delays; use is_stable of a "
            "scene with the tool"
        )
    return round(delay)
