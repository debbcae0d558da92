"""Build the matrices of mechanisms: the equations of motion, energies, and the power that their dampers dissipate.

A *mechanism* is the linear model ``x' = rate @ (x, u)`` of the bodies, links, modes and actuator of a scene, with the
state x and constant forces u (docs/theory/simulation.md, T1 and T6). With an actuator or modes, u consists of the
command and of the external force on the first body, otherwise of their sum. Units are the sampling period and the mass
of the first body. n is the length of x, and ``z = (x, u)``. `plant.transition` integrates the equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.linear_plant import System
from zwidth.model.mechanism import Resonance, express_body_position


class Mechanics(NamedTuple):
    """Matrices of the mechanisms of scenes with equal structure."""

    rate: np.ndarray  # (scenes, n, n + forces): x' = rate @ z while the first body slips
    held: np.ndarray  # (scenes, n, n + forces): x' = held @ z while friction holds the first body
    place: np.ndarray  # (bodies, n): positions place @ x of the bodies; equal for all scenes
    motion: np.ndarray  # (bodies, n): velocities motion @ x of the bodies; equal for all scenes
    energy: np.ndarray  # (scenes, n, n): kinetic and elastic energy x @ energy @ x
    drain: np.ndarray  # (scenes, n + forces, n + forces): power z @ drain @ z dissipated by the dampers


def build_mechanics(chains: Sequence[Any]) -> Mechanics:
    """Return the matrices of the mechanisms of scenes.

    Args:
        chains: open loops of the scenes (`model.mechanism`), with equal numbers of bodies, links, modes and actuator
            states; or one linear system (`model.linear_plant.System`) with several delays.
    """
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
    forces = [push] if first.drives_body_only else [B, push]
    rate = np.moveaxis(np.concatenate([A, np.stack(forces, 1)], 1), -1, 0)
    bodies, links, modes = parts.values()
    first_mode, count, size = len(bodies), len(bodies) + len(modes), len(A)
    place = np.zeros((len(bodies), size))
    for body in range(len(bodies)):
        for entry, sign in express_body_position(body, first.sensor, len(bodies), len(modes)):
            place[body, entry] = sign
    motion = np.roll(place, count, axis=1)
    axes = np.eye(size)
    stretch, swing = axes[1:first_mode], axes[first_mode:count]
    # Compute the energies with the absolute values of the modal masses, because a modal mass may be negative. These
    # energies are exact for a mode with equal displacements at the actuator and at the sensor.
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
    # Add the holding force, which makes the acceleration of the first body 0 (T4). It acts at the same place as the
    # last of the forces u. No division by a mass is needed, because the mass of the first body is 1.
    held = rate - rate[..., -1:] * (motion[0] @ rate)[:, None, :]
    wide = (0, len(forces))
    return Mechanics(rate, held, place, motion, 0.5 * energy, np.pad(drain, ((0, 0), wide, wide)))


def _build_system(systems: Sequence[Any]) -> Mechanics:
    """Return the matrices of one linear system with several delays; its position is the output, its energies are 0.

    Raises:
        InputError: the system is a discrete-time one, or its velocity jumps with the force.
    """
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
    """Return one named tuple whose fields are the stacked fields of the given named tuples."""
    return type(parts[0])(*(np.array(column, float) for column in zip(*parts, strict=True)))
