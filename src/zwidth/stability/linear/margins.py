"""Compute gain, phase, modulus and delay margin of walls in any linear loop, from all crossovers of the open loop.

The open loop is ``L = G (alpha + beta F)`` with the plant G and the velocity estimate F of `stability.linear.roots`,
for a wall with the normalized stiffness alpha and damping beta. `stability.open_loop` computes the crossovers of L and
the distance of L from -1, for many walls at once. All walls share the *nodes*, the angles at which L is tabulated:
those of `stability.linear.curve`, which resolve G and F, and further nodes that resolve the controller ``alpha + beta
F`` and gain crossovers at low frequencies. A *chain* is the plant of a scene with its delay (`plant.sampled_states`).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import within
from zwidth.model.circle_functions import CirclePoints, Jet, circle_points
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.polynomials import abs2
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.delay_margin import find_delay_margins
from zwidth.stability.linear.roots import POLE_AT_ONE, LoopRoots
from zwidth.stability.linear.rows import label_walls
from zwidth.stability.open_loop import (
    OpenLoop,
    evaluate_open_loop,
    find_gain_crossovers,
    find_nearest_angle,
    find_phase_crossovers,
    select_gain_margin,
    select_phase_margin,
    tabulate_open_loop,
)
from zwidth.stability.results import Margins
from zwidth.units.quantities import WALL_RANGE

BATCH_WALLS = 128  # walls per batch; so many that array operations take most of the time, not the Python interpreter
# Largest number of halvings of an interval between two nodes near a zero of the controller alpha + beta F.
MAX_HALVINGS = 40
MAX_CONTROLLER_CHANGE = 0.25  # largest relative change of the controller between neighboring nodes


def list_gains(terms: Sequence[Any], alpha: Array, beta: Array) -> list[Array]:
    """Return the factors of P, V and, if present, R in the controller ``alpha P + beta V + R``: alpha, beta and 1."""
    return [alpha, beta, *(np.ones_like(alpha) for _ in terms[2:])]


def evaluate_walls(loop: LoopRoots, alpha: Array, beta: Array, points: CirclePoints) -> Jet:
    """Return L of walls and its derivative in w at points of the unit circle; walls and points broadcast."""
    plant, terms = loop.terms
    return evaluate_open_loop(points, plant.evaluate_response, terms, list_gains(terms, alpha, beta))


def tabulate(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray, nodes: np.ndarray) -> OpenLoop:
    """Return L of each wall, tabulated at the nodes of the loop and at further nodes that the walls need."""
    (plant, terms), w = loop.terms, np.append(nodes[nodes < np.pi], np.pi)
    n_integrators = int(np.count_nonzero(np.abs(loop.open_poles) <= POLE_AT_ONE))
    if n_integrators:
        # If the device has poles at z = 1, |L| grows without limit as w -> 0. With a small stiffness, the gain
        # crossover may lie below all nodes, so add nodes at lower angles.
        gains = np.abs(evaluate_walls(loop, alpha, beta if len(terms) > 2 else 0.0 * beta, circle_points(w[:1])).value)
        gains = gains[(gains > 0) & (gains < 1)]
        octaves = 1.0 - np.log2(gains.min(initial=1.0)) / n_integrators if gains.size else 0.0
        w = np.concatenate([w[0] * np.exp2(-np.linspace(octaves, 1.0, int(np.ceil(octaves)))), w])
    columns = alpha[:, None], beta[:, None]
    for _ in range(MAX_HALVINGS):
        values = [np.broadcast_to(term(circle_points(w)).value, w.shape) for term in terms]
        parts = [gain * value for gain, value in zip(list_gains(terms, *columns), values, strict=True)]
        controller, step = np.abs(sum(parts)), np.diff(w)
        change = sum(np.abs(np.diff(part)) for part in parts)
        wide = change > MAX_CONTROLLER_CHANGE * np.maximum(controller[:, :-1], controller[:, 1:])
        wide = wide.any(0) & (step > 1e-9 * w[1:])
        if not wide.any():
            break
        w = np.sort(np.concatenate([w, w[:-1][wide] + 0.5 * step[wide]]))
    return tabulate_open_loop(w, plant.evaluate_response, terms, list_gains(terms, alpha, beta))


def find_modulus_margins(wall: OpenLoop) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum of ``|1 + L|`` of each wall, and the angle of this minimum, 0 for z = 1."""
    w = find_nearest_angle(wall.respond, wall.w, abs2(1.0 + wall.L.value))
    distance = np.abs(1.0 + wall.respond(w[:, None]).value[:, 0])
    at_one = np.abs(1.0 + evaluate_at_one(wall))
    is_at_one = at_one < distance
    return np.where(is_at_one, at_one, distance), np.where(is_at_one, 0.0, w)


def evaluate_at_one(wall: OpenLoop) -> np.ndarray:
    """Return L at z = 1 for each wall; NaN if it is infinite or 0."""
    value = wall.respond(np.zeros((1, 1))).value[:, 0]
    return np.where(np.isfinite(value) & (value.real != 0), value.real, np.nan)


def compute_margins(
    chain: AnyChain, boundary: Boundary, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str]
) -> Margins:
    """Return the margins of walls, with delays in periods and angles in rad per sample.

    Args:
        chain: device and delay.
        boundary: the stability boundary of the loop.
        alpha: normalized stiffness, any shape.
        beta: normalized damping, the same shape.
        wanted: names of the margins; the others are NaN.

    Returns:
        Margins of the shape of ``alpha``; NaN for walls out of range.
    """
    shape, stable = alpha.shape, label_walls(boundary, alpha, beta).reshape(-1)
    alpha, beta = alpha.reshape(-1), beta.reshape(-1)
    out = {name: np.full(alpha.size, np.nan) for name in Margins._fields}
    in_range = np.flatnonzero(within(alpha, WALL_RANGE) & within(beta, WALL_RANGE))
    for start in range(0, in_range.size, BATCH_WALLS):
        part = in_range[start : start + BATCH_WALLS]
        for name, values in _compute_batch(boundary, alpha[part], beta[part], stable[part], wanted).items():
            out[name][part] = values
    # Leave the delay margin of a sampled system NaN, because its response is not defined at fractional delays.
    if "delay_margin" in wanted and not chain.sampled:
        limited = in_range[stable[in_range]]
        out["delay_margin"][in_range] = 0.0
        out["delay_margin"][limited] = find_delay_margins(chain, tabulate, alpha[limited], beta[limited])
    return Margins(*(part.reshape(shape)[()] for part in out.values()))


def _compute_batch(
    boundary: Boundary, alpha: np.ndarray, beta: np.ndarray, stable: np.ndarray, wanted: Container[str]
) -> dict[str, np.ndarray]:
    """Return the margins of one batch of walls by name, without the delay margin; see `compute_margins`."""
    wall, out = tabulate(boundary.loop, alpha, beta, boundary.w), {}
    with np.errstate(all="ignore"):
        if "gain_margin" in wanted:
            w, at_one = find_phase_crossovers(wall), evaluate_at_one(wall)[:, None]
            w = np.concatenate([w, np.where(at_one < 0, 0.0, np.nan)], -1)
            gains = np.concatenate([np.abs(wall.respond(w[:, :-1]).value), -at_one], -1)
            out["gain_margin"], out["phase_crossover"] = select_gain_margin(stable, w, gains)
        if "phase_margin" in wanted:
            w = find_gain_crossovers(wall)
            phases = np.angle(-wall.respond(w).value)
            out["phase_margin"], out["gain_crossover"] = select_phase_margin(stable, w, phases)
        if "modulus_margin" in wanted:
            out["modulus_margin"], out["modulus_frequency"] = find_modulus_margins(wall)
    return out
