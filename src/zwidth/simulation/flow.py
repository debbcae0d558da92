"""The exact motion of a chain over given times, and the energy that its dampers take (docs/theory/simulation.md).

With the state x and a constant force u, ``z = (x, u)``: over a time t the state changes by ``change @ z`` and the
dampers take ``z @ loss @ z`` (T1, T6). Both by series for a small part of t and doubling, all times of all chains at
once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.linear.chain import Chain, rates

# Of series in a matrix of norm up to 1/2: the first term left out is below 1e-19 of the whole.
_TERMS = 15
# Binary digits of a time below 2 periods: 1, 1/2, ... 2^-52.
DIGITS = 53


class Flow(NamedTuple):
    """What a time does to ``z = (x, u)``, along leading axes."""

    change: np.ndarray  # (..., n, n + 1)
    loss: np.ndarray  # (..., n + 1, n + 1)


class Mechanics(NamedTuple):
    """Chains of one structure as matrices, one a scene along the first axis, in units of T and of the first mass."""

    rate: np.ndarray  # (scenes, n, n + 1): x' = rate @ (x, u)
    held: np.ndarray  # the same while friction holds the first body
    place: np.ndarray  # (bodies, n): the position of every body, the same for all
    energy: np.ndarray  # (scenes, n, n): kinetic and elastic energy x @ energy @ x
    drain: np.ndarray  # (scenes, n + 1, n + 1): the power that dampers take


def mechanics(chains: Sequence[Chain]) -> Mechanics:
    """The matrices of chains with equally many bodies and the sensor on the same one."""
    bodies = [_stack([chain.bodies[k] for chain in chains]) for k in range(len(chains[0].bodies))]
    links = [_stack([chain.links[k] for chain in chains]) for k in range(len(chains[0].links))]
    count, sensor = len(bodies), chains[0].sensor
    A, B = rates(replace(chains[0], bodies=tuple(bodies), links=tuple(links)))
    rate = np.moveaxis(np.concatenate([A, B[:, None]], 1), -1, 0)
    place = np.zeros((count, 2 * count))
    for body in range(count):
        # The sensed position, and the extensions between it and the body.
        place[body, 0] = 1.0
        place[body, sensor + 1 : body + 1] = 1.0
        place[body, body + 1 : sensor + 1] = -1.0
    motion = np.roll(place, count, axis=1)
    stretch, stretching = np.eye(2 * count)[1:count], np.eye(2 * count)[count + 1 :]

    def weigh(rows: np.ndarray, parts: list[Any], name: str) -> np.ndarray:
        weights = np.array([getattr(part, name) for part in parts]).reshape(len(rows), len(chains))
        return np.einsum("ki,kd,kj->dij", rows, weights, rows)

    energy = weigh(motion, bodies, "mass") + weigh(place, bodies, "stiffness") + weigh(stretch, links, "stiffness")
    drain = weigh(motion, bodies, "damping") + weigh(stretching, links, "damping")
    # The force that holds the first body acts where the wall's does (T4), and its mass is the unit.
    held = rate - rate[..., -1:] * (motion[0] @ rate)[:, None, :]
    return Mechanics(rate, held, place, 0.5 * energy, np.pad(drain, ((0, 0), (0, 1), (0, 1))))


def _stack(parts: Sequence[Any]) -> Any:
    return type(parts[0])(*(np.array(column, float) for column in zip(*parts, strict=True)))


def flow(rate: np.ndarray, drain: np.ndarray, times: np.ndarray) -> Flow:
    """The flow of ``x' = rate @ (x, u)`` over some times, ``(scenes, ...)``."""
    size = rate.shape[-1]
    inner = (rate.shape[0], *(1,) * (times.ndim - 1), size, size)
    whole = np.concatenate([rate, np.zeros((rate.shape[0], 1, size))], 1).reshape(inner)
    norm = float(np.abs(whole).sum(-1).max() * np.max(times, initial=0.0))
    doublings = max(0, int(np.ceil(np.log2(max(2.0 * norm, 1.0)))))
    small = times[..., None, None] / 2.0**doublings
    power = np.broadcast_to(np.eye(size), (*times.shape, size, size))
    drained = small * drain.reshape(inner)
    step, lost = np.zeros(power.shape), np.zeros(power.shape)
    for k in range(1, _TERMS + 1):
        power = power @ whole * (small / k)
        step = step + power
        lost = lost + drained
        drained = (whole.mT @ drained + drained @ whole) * (small / (k + 1))
    for _ in range(doublings):
        moved = step.mT @ lost
        lost = 2.0 * lost + moved + moved.mT + moved @ step
        # e^A - 1 by itself keeps the digits of slow motions.
        step = 2.0 * step + step @ step
    return Flow(step[..., :-1, :], lost)


def digit_flow(rate: np.ndarray, drain: np.ndarray) -> Flow:
    """The flow over the binary digits of time, the longest first."""
    return flow(rate, drain, np.broadcast_to(0.5 ** np.arange(DIGITS), (rate.shape[0], DIGITS)))
