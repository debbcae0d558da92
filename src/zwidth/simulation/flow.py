"""Exact motion of a mechanism over given times, and the energy that its dampers dissipate (docs/theory/simulation.md).

With the state x, constant forces u and ``z = (x, u)``: over a time t the state changes by ``change @ z``, and the
dampers dissipate ``z @ loss @ z`` (T1, T6). Both follow from a series for a fraction of t and repeated doubling, for
all times and mechanisms at once. With an actuator or modes the command is the first force, and the last force acts on
the first body directly. Units: the sampling period and the mass of the first body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.chain import Resonance, body_position
from zwidth.parts.system import System
from zwidth.words.errors import InputError

TERMS = 15  # of the series; for a norm of 1/2 its error is below 1e-18 in the motion and 5e-14 in the loss
DIGITS = 53  # binary digits of a time below 2 periods: 1, 1/2, ... 2^-52


class Flow(NamedTuple):
    """Change of the state and dissipated energy over a time, along leading axes."""

    change: np.ndarray  # (..., n, n + forces)
    loss: np.ndarray  # (..., n + forces, n + forces)


class Mechanics(NamedTuple):
    """Matrices of mechanisms of one structure."""

    rate: np.ndarray  # (scenes, n, n + forces): x' = rate @ (x, u)
    held: np.ndarray  # (scenes, n, n + forces): the same while friction holds the first body
    place: np.ndarray  # (bodies, n): positions of the bodies, equal for all scenes
    motion: np.ndarray  # (bodies, n): their velocities
    energy: np.ndarray  # (scenes, n, n): kinetic and elastic energy x @ energy @ x
    drain: np.ndarray  # (scenes, n + forces, n + forces): power that the dampers dissipate


def build_mechanics(chains: Sequence[Any]) -> Mechanics:
    """Return the matrices of chains that differ in their parameters only, or of one linear system."""
    first: Any = chains[0]
    if isinstance(first, System):
        return _build_system(chains)
    parts = {
        name: tuple(_stack(parts) for parts in zip(*(getattr(chain, name) for chain in chains), strict=True))
        for name in ("bodies", "links", "modes")
    }
    lags = [chain.actuator for chain in chains]
    lag = _stack(lags) if isinstance(lags[0], Resonance) else None if lags[0] is None else np.array(lags, float)
    A, B, push = replace(first, **parts, actuator=lag).realize()
    forces = [push] if first.plain else [B, push]
    rate = np.moveaxis(np.concatenate([A, np.stack(forces, 1)], 1), -1, 0)
    bodies, links, modes = parts.values()
    first_mode, count, size = len(bodies), len(bodies) + len(modes), len(A)
    place = np.zeros((len(bodies), size))
    for body in range(len(bodies)):
        for entry, sign in body_position(body, first.sensor, len(bodies), len(modes)):
            place[body, entry] = sign
    motion = np.roll(place, count, axis=1)
    axes = np.eye(size)
    stretch, swing = axes[1:first_mode], axes[first_mode:count]
    # A mode that is driven and measured at points of equal displacement has the energy of its modal mass.
    inertia = [np.abs(mode.mass) for mode in modes]
    springs = [mass * mode.rate**2 for mass, mode in zip(inertia, modes, strict=True)]
    dampers = [2.0 * mass * mode.damping_ratio * mode.rate for mass, mode in zip(inertia, modes, strict=True)]

    def weigh(rows: np.ndarray, weights: list[np.ndarray]) -> np.ndarray:
        return np.einsum("ki,kd,kj->dij", rows, np.reshape(weights, (len(rows), len(chains))), rows)

    def differentiate(rows: np.ndarray) -> np.ndarray:
        return np.roll(rows, count, axis=1)

    energy = weigh(motion, [body.mass for body in bodies]) + weigh(place, [body.stiffness for body in bodies])
    energy = energy + weigh(stretch, [link.stiffness for link in links]) + weigh(swing, springs)
    energy = energy + weigh(differentiate(swing), inertia)
    drain = weigh(motion, [body.damping for body in bodies]) + weigh(differentiate(swing), dampers)
    drain = drain + weigh(differentiate(stretch), [link.damping for link in links])
    # The holding force acts on the first body as the last force does (T4), and the mass of that body is the unit.
    held = rate - rate[..., -1:] * (motion[0] @ rate)[:, None, :]
    wide = (0, len(forces))
    return Mechanics(rate, held, place, motion, 0.5 * energy, np.pad(drain, ((0, 0), wide, wide)))


def _build_system(systems: Sequence[Any]) -> Mechanics:
    """Return the matrices of one linear system with several delays: one position, the output; energies set to 0."""
    A, _, push = systems[0].realize()
    if systems[0].sampled:
        raise InputError(
            "device: got a discrete-time system, whose motion between samples is unknown; use a continuous one"
        )
    if push[0] != 0:
        raise InputError("device: got a system whose velocity jumps with the force; add the missing mass or lag")
    size = len(A)
    rate = np.repeat(np.concatenate([A, push[:, None]], 1)[None], len(systems), 0)
    unknown = np.zeros((len(systems), size, size)), np.zeros((len(systems), size + 1, size + 1))
    return Mechanics(rate, rate, np.eye(1, size), A[:1], *unknown)


def _stack(parts: Sequence[Any]) -> Any:
    """Return named tuples of one type as a single one, with an array over the tuples in each field."""
    return type(parts[0])(*(np.array(column, float) for column in zip(*parts, strict=True)))


def flow(rate: np.ndarray, drain: np.ndarray, times: np.ndarray) -> Flow:
    """Return the flow of ``x' = rate @ (x, u)`` over times of shape (scenes, ...); ``drain``: power of the dampers."""
    count, size = rate.shape[-2:]
    inner = (rate.shape[0], *(1,) * (times.ndim - 1), size, size)
    whole = np.concatenate([rate, np.zeros((rate.shape[0], size - count, size))], 1).reshape(inner)
    norm = float(np.abs(whole).sum(-1).max() * np.max(times, initial=0.0))
    doublings = max(0, int(np.ceil(np.log2(max(2.0 * norm, 1.0)))))
    small = times[..., None, None] / 2.0**doublings
    power = np.broadcast_to(np.eye(size), (*times.shape, size, size))
    drained = small * drain.reshape(inner)
    step, lost = np.zeros(power.shape), np.zeros(power.shape)
    for k in range(1, TERMS + 1):
        power = power @ whole * (small / k)
        step = step + power
        lost = lost + drained
        drained = (whole.mT @ drained + drained @ whole) * (small / (k + 1))
    for _ in range(doublings):
        moved = step.mT @ lost
        lost = 2.0 * lost + moved + moved.mT + moved @ step
        # Double e^A - 1 instead of e^A, to keep the digits of slow motions.
        step = 2.0 * step + step @ step
    return Flow(step[..., :count, :], lost)
