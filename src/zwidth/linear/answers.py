"""What a scene answers beside its verdicts, in SI units: poles, state space, frequency response."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64
from zwidth.errors import InputError
from zwidth.linear import state_space
from zwidth.linear.chain import Chain
from zwidth.linear.poles import all_poles, log_size
from zwidth.linear_loop import LinearLoop, circle

if TYPE_CHECKING:
    import control


class StateSpace(NamedTuple):
    """``x[k+1] = A x[k] + B u[k]``, ``y[k] = C x[k] + D u[k]``, a step every ``dt`` seconds."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float


class PoleTable(NamedTuple):
    """Poles, the slowest first, and the motions they stand for; arrays with a last axis of poles."""

    z: np.ndarray
    frequency: np.ndarray  # at which it oscillates, in Hz; half the sampling rate for a negative real pole
    damping_ratio: np.ndarray  # -Re s/|s| with s = log(z)/T; negative for a growing motion
    time_constant: np.ndarray  # -1/Re s in s; negative for a growing one, infinite on the unit circle


def pole_table(loop: LinearLoop, alpha: np.ndarray, beta: np.ndarray, period: float) -> PoleTable:
    """The poles of walls of one shape."""
    zeta: Array = all_poles(loop, alpha, beta)
    size = log_size(zeta)
    order = np.argsort(-size, axis=-1, kind="stable")
    zeta, size = (np.take_along_axis(values, order, -1) for values in (zeta, size))
    turn = np.abs(np.arctan2(zeta.imag, 1.0 + zeta.real))
    with np.errstate(all="ignore"):
        # A pole at z = 0 is gone after one period.
        ratio = np.where(np.isinf(size), 1.0, -size / np.hypot(size, turn))
        ratio = np.where((size == 0) & (turn == 0), 0.0, ratio)
        return PoleTable(1.0 + zeta, turn / (2.0 * np.pi * period), ratio, -period / size)


def frequency_response(
    loop: LinearLoop, alpha: np.ndarray, beta: np.ndarray, frequency: ArrayLike, period: float
) -> Array:
    """``L = (alpha + beta F) G`` at frequencies in Hz up to half the sampling rate; NaN for others."""
    try:
        hertz, a, b = np.broadcast_arrays(as_float64("frequency", frequency), alpha, beta)
    except ValueError as error:
        raise InputError(
            f"shapes do not broadcast: frequency {np.shape(frequency)}, walls {alpha.shape}; make each axis equal or 1"
        ) from error
    w = 2.0 * np.pi * hertz * period
    # Half the sampling rate is half a turn, whatever the rounding of the quotient.
    w = np.where(np.abs(w - np.pi) < 1e-14, np.pi, w)
    inside = (w > 0) & (w <= np.pi)
    at = circle(np.where(inside, w, 1.0))
    with np.errstate(all="ignore"):
        value = -(a + b * loop.estimate.jet(at).value) / loop.needed(at).value
    return np.where(inside, value, complex(np.nan, np.nan))[()]


def closed_loop_si(chain: Chain, alpha: float, beta: float, mass: float, period: float) -> StateSpace:
    """From a force in N held on the device to the sensed position in m."""
    return _in_si(chain, state_space.closed_loop(chain, alpha, beta), period, mass, period * period / mass)


def open_loop_si(chain: Chain, alpha: float, beta: float, mass: float, period: float) -> StateSpace:
    """From the position that the wall is given to the one that its force answers, both in m."""
    return _in_si(chain, state_space.open_loop(chain, alpha, beta), period, mass, 1.0)


def _in_si(chain: Chain, loop: state_space.Matrices, period: float, mass: float, unit: float) -> StateSpace:
    """States in m, m/s and N in place of units of the period and the mass."""
    count = len(chain.bodies)
    waiting = state_space.delayed_device(chain).A.shape[0] - 2 * count
    filtered = loop.A.shape[0] - 2 * count - waiting
    scale = np.concatenate(
        [np.ones(filtered + count), np.full(count, 1.0 / period), np.full(waiting, mass / period**2)]
    )
    return StateSpace(
        loop.A * scale[:, None] / scale, loop.B * scale[:, None] * unit, loop.C / scale, loop.D * unit, period
    )


def to_control(scene: Any, stiffness: float = 0.0, virtual_damping: float = 0.0) -> control.StateSpace:
    """Return the closed loop of a scene and a wall as a model of python-control.

    From a force held on the device (N) to the sensed position (m), exactly discretized: ``scene.state_space``.

    Args:
        scene: a `zwidth.Scene`.
        stiffness: K of the wall in N/m, one number.
        virtual_damping: B of the wall in N s/m, one number.

    Returns:
        control.StateSpace with ``dt`` the sampling period; states in m, m/s and N.

    Raises:
        InputError: python-control is not installed.

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
    """The numbers of a single wall."""
    if alpha.size != 1 or not (np.isfinite(alpha).all() and np.isfinite(beta).all()):
        raise InputError(f"stiffness, virtual_damping: got shape {alpha.shape}; one wall of finite numbers is needed")
    return float(alpha.reshape(())), float(beta.reshape(()))
