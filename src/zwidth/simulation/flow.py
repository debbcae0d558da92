"""The exact motion of a chain over given times, and the energy that its dampers take (docs/theory/simulation.md).

With the state x and a constant force u, ``z = (x, u)``: over a time t the state changes by ``change @ z`` and the
dampers take ``z @ loss @ z`` (T1, T6). Both by series for a small part of t and doubling, all times of all chains at
once. Where a command does not act on the first body alone and at once, it stands before u, the force that does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.chain import Resonance, body_position
from zwidth.parts.system import System
from zwidth.words.errors import InputError

# Of series in a matrix of norm up to 1/2: the first term left out is below 1e-19 of the whole.
_TERMS = 15
# Binary digits of a time below 2 periods: 1, 1/2, ... 2^-52.
DIGITS = 53


class Flow(NamedTuple):
    """What a time does to ``z = (x, u)``, of one force or two, along leading axes."""

    change: np.ndarray  # (..., n, n + forces)
    loss: np.ndarray  # (..., n + forces, n + forces)


class Mechanics(NamedTuple):
    """Chains of one structure as matrices, one a scene along the first axis, in units of T and of the first mass."""

    rate: np.ndarray  # (scenes, n, n + forces): x' = rate @ (x, u)
    held: np.ndarray  # the same while friction holds the first body
    place: np.ndarray  # (bodies, n): the position of every body, the same for all
    motion: np.ndarray  # (bodies, n): its velocity
    energy: np.ndarray  # (scenes, n, n): kinetic and elastic energy x @ energy @ x
    drain: np.ndarray  # (scenes, n + forces, n + forces): the power that dampers take


def mechanics(chains: Sequence[Any]) -> Mechanics:
    """The matrices of chains with equally many bodies and modes, the sensor on the same body; or of one system."""
    first: Any = chains[0]
    if isinstance(first, System):
        return _follow(chains)
    together = {
        name: tuple(_stack(parts) for parts in zip(*(getattr(chain, name) for chain in chains), strict=True))
        for name in ("bodies", "links", "modes")
    }
    lags = [chain.actuator for chain in chains]
    lag = _stack(lags) if isinstance(lags[0], Resonance) else None if lags[0] is None else np.array(lags, float)
    A, B, push = replace(first, **together, actuator=lag).realize()
    forces = [push] if first.plain else [B, push]
    rate = np.moveaxis(np.concatenate([A, np.stack(forces, 1)], 1), -1, 0)
    bodies, links, modes = together.values()
    here, count, size = len(bodies), len(bodies) + len(modes), len(A)
    place = np.zeros((here, size))
    for body in range(here):
        for entry, sign in body_position(body, first.sensor, here, len(modes)):
            place[body, entry] = sign
    motion = np.roll(place, count, axis=1)
    axes = np.eye(size)
    stretch, stretching = axes[1:here], axes[count + 1 : count + here]
    swing, swinging = axes[here:count], axes[count + here : 2 * count]
    # Driven and sensed at equally large places, a mode has the energy of its modal mass.
    inertia = [np.abs(mode.mass) for mode in modes]
    springs = [size * mode.rate**2 for size, mode in zip(inertia, modes, strict=True)]
    dampers = [2.0 * size * mode.damping_ratio * mode.rate for size, mode in zip(inertia, modes, strict=True)]

    def weigh(rows: np.ndarray, weights: list[np.ndarray]) -> np.ndarray:
        return np.einsum("ki,kd,kj->dij", rows, np.reshape(weights, (len(rows), len(chains))), rows)

    energy = weigh(motion, [body.mass for body in bodies]) + weigh(place, [body.stiffness for body in bodies])
    energy = energy + weigh(stretch, [link.stiffness for link in links]) + weigh(swing, springs)
    drain = weigh(motion, [body.damping for body in bodies]) + weigh(stretching, [link.damping for link in links])
    energy, drain = energy + weigh(swinging, inertia), drain + weigh(swinging, dampers)
    # The force that holds the first body acts where the wall's does (T4), and its mass is the unit.
    held = rate - rate[..., -1:] * (motion[0] @ rate)[:, None, :]
    wide = (0, len(forces))
    return Mechanics(rate, held, place, motion, 0.5 * energy, np.pad(drain, ((0, 0), wide, wide)))


def _follow(systems: Sequence[Any]) -> Mechanics:
    """The same of one linear system at any delays: one place is known, that the sensor sees, and no energy."""
    A, _, push = systems[0].realize()
    if systems[0].sampled:
        raise InputError("device: got a system from sample to sample, whose motion between them is not known")
    if push[0] != 0:
        raise InputError("device: a force moves its velocity at once; add the mass or the lag that is missing")
    size = len(A)
    rate = np.repeat(np.concatenate([A, push[:, None]], 1)[None], len(systems), 0)
    unknown = np.zeros((len(systems), size, size)), np.zeros((len(systems), size + 1, size + 1))
    return Mechanics(rate, rate, np.eye(1, size), A[:1], *unknown)


def _stack(parts: Sequence[Any]) -> Any:
    return type(parts[0])(*(np.array(column, float) for column in zip(*parts, strict=True)))


def flow(rate: np.ndarray, drain: np.ndarray, times: np.ndarray) -> Flow:
    """The flow of ``x' = rate @ (x, u)`` over some times, ``(scenes, ...)``."""
    count, size = rate.shape[-2:]
    inner = (rate.shape[0], *(1,) * (times.ndim - 1), size, size)
    whole = np.concatenate([rate, np.zeros((rate.shape[0], size - count, size))], 1).reshape(inner)
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
    return Flow(step[..., :count, :], lost)
