"""Step response of the rigid device in contact with the wall: a simulation, and when it has settled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zwidth._types import Samples
from zwidth.batching import as_float64
from zwidth.errors import InputError
from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.scene import Scene
from zwidth.settling import settling_time


class StepResponse(NamedTuple):
    """The response to a constant force that sets in at time 0; arrays of one time axis."""

    time: Samples
    position: Samples
    velocity: Samples
    wall_force: Samples
    final_position: float
    settling_time: float


def step_response(
    alpha: float, beta: float, delta: float, d: float, *, periods: int = 100, substeps: int = 10, force: float = 1.0
) -> StepResponse:
    """Return the response, from force to position, of the device that rests in contact with the wall.

    The force pushes on the mass itself from time 0 on; the wall answers with
    ``-(alpha x_k + beta (x_k - x_(k-1)))``, computed at sample k and acting from k + d to k + d + 1 (held).

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not. All four single numbers.
        periods: how many sampling periods to simulate, >= 1.
        substeps: instants in each period, >= 1; 1 gives the samples alone.
        force: the constant force in units of m/T^2 times a length unit.

    Returns:
        StepResponse: ``time`` in periods; ``position``; ``velocity`` in position a period; ``wall_force``, what the
        wall applies then; all (periods * substeps,). ``final_position`` is force/alpha, NaN for alpha = 0.
        ``settling_time`` in periods is the last instant of all outside 2 % of it, however long was simulated: it comes
        from the poles, see `zwidth.settling`. NaN where the wall is not stable, and beyond d = 500.

    Numerics:
        That of `zwidth.simulate`: exact between force changes up to rounding. An unstable response that outgrows
        float64 ends as inf or NaN.

    References:
        Hulin, Preusche, Hirzinger 2006, section VIII, Fig. 11, eqs. (2), (6).

    Example:
        >>> import zwidth
        >>> response = zwidth.step_response(0.108, 0.425, 0.0, 1)
        >>> print(f"{response.position[-1] * 0.108:.2f}")
        1.00
    """
    arguments = {"alpha": alpha, "beta": beta, "delta": delta, "d": d, "force": force}
    numbers = {name: as_float64(name, value) for name, value in arguments.items()}
    for name, number in numbers.items():
        if number.ndim or not np.isfinite(number):
            raise InputError(f"{name}: got {arguments[name]!r}; a single finite number is needed")
        if name in ("delta", "d") and number < 0:
            raise InputError(f"{name}: got {arguments[name]!r}; it must be at least 0")
    for name, count in {"periods": periods, "substeps": substeps}.items():
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise InputError(f"{name}: got {count!r}; a whole number of at least 1 is needed")
    alpha, beta, delta, d, force = (float(number) for number in numbers.values())
    scene = Scene(Device(mass=1.0, damping=delta), Timing(period=1.0, delay=d))
    motion = scene.simulate(alpha, beta, push=force, periods=periods, substeps=substeps)
    final = force / alpha if alpha != 0 else math.nan
    settled = settling_time(alpha, beta, delta, d) if force != 0 else 0.0
    return StepResponse(motion.time, motion.position, motion.velocity, motion.wall_force, final, settled)
