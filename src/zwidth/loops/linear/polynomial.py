"""The closed loop of any linear scene as polynomials and as roots."""

from __future__ import annotations

import numpy as np

from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.rigid.polynomial import Affine


def _product(*offsets: np.ndarray) -> np.ndarray:
    """The monic polynomial of roots given by their offsets from 1; real, for they come in pairs."""
    return np.atleast_1d(np.poly(1.0 - np.concatenate(offsets))).real


def estimate_polynomials(loop: LoopRoots) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of the velocity estimate."""
    f = loop.estimate
    top, bottom = f.gain * _product(f.zeros), _product(f.poles)
    if f.window:
        difference = np.zeros(f.window + 1)
        difference[[0, -1]] = 1.0 / f.window, -1.0 / f.window
        top = np.convolve(top, difference)
    turns = f.window + f.lag
    return (top, _raised(bottom, turns)) if turns >= 0 else (_raised(top, -turns), bottom)


def _raised(polynomial: np.ndarray, power: int) -> np.ndarray:
    return np.concatenate([polynomial, np.zeros(power)])


def affine_polynomial(loop: LoopRoots) -> Affine:
    """D, N1 and N2 of the closed loop."""
    top, bottom = estimate_polynomials(loop)
    device, answer = _product(loop.poles), loop.gain * _product(loop.zeros)
    if loop.lag >= 0:
        device = _raised(device, loop.lag)
    else:
        answer = _raised(answer, -loop.lag)
    parts = [np.convolve(device, bottom), np.convolve(answer, bottom), np.convolve(answer, top)]
    length = max(part.size for part in parts)
    return Affine(*(np.concatenate([np.zeros(length - part.size), part]) for part in parts))


def closed_loop_roots(loop: LoopRoots, alpha: float, beta: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Zeros, poles, gain and lag of ``P = z^lag prod(z - poles) + gain prod(z - zeros)`` for one wall."""
    top, bottom = estimate_polynomials(loop)
    length = max(top.size, bottom.size)
    wall = alpha * np.concatenate([np.zeros(length - bottom.size), bottom])
    wall = wall + beta * np.concatenate([np.zeros(length - top.size), top])
    lead = np.flatnonzero(wall)
    if not lead.size:
        wall_zeros, gain = np.zeros(0), 0.0
    else:
        wall_zeros, gain = np.roots(wall), float(wall[lead[0]])
    f = loop.estimate
    turns = f.window + f.lag
    zeros = np.concatenate([1.0 - loop.zeros, wall_zeros])
    poles = np.concatenate([1.0 - loop.poles, 1.0 - f.poles])
    lag = loop.lag + max(turns, 0)
    if lag < 0:
        zeros, lag = np.concatenate([zeros, np.zeros(-lag)]), 0
    return zeros, poles, gain * loop.gain, lag
