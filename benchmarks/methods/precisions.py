"""Evaluate functions inside `jit` in float64, float32 and mixed precision, and draw walls to measure their errors.

A wall has four numbers: its normalized stiffness alpha and damping beta, and the normalized damping delta and the delay
d (in periods) of its device.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from methods.problems import Walls
from zwidth.core.errors import PrecisionWarning
from zwidth.stability.rigid.boundary import boundary, boundary_point, sample_lobe
from zwidth.stability.rigid.dominant.spectral_radius import spectral_radius
from zwidth.stability.rigid.margins import margins
from zwidth.stability.rigid.passivity import passivity_margin
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.stiffness_limit import row_limits
from zwidth.stability.rigid.verdict import is_stable

SEED = 20060901
DELTAS = (0.0, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0)
DELAYS = (0.0, 0.5, 1.0, 2.0, 3.25, 8.0, 50.0, 500.0)
# Smallest and largest decade (exponent of 10) of the relative distance in alpha between walls and stability boundary.
NEAREST, FARTHEST = -7, -1


def find_alpha(_alpha: Any, _beta: Any, delta: Any, d: Any) -> Any:
    """Return the maximum stable alpha of the device of each wall; alpha and beta of the wall have no effect."""
    return alpha_max(delta, d).alpha


# For each precision, the function that labels walls stable or unstable, and the number type of its arguments.
LABELS: dict[str, tuple[Callable[..., Any], str]] = {
    "float64": (is_stable, "float64"),
    "float32": (is_stable, "float32"),
    "mixed": (partial(is_stable, precision="mixed"), "float64"),
}
# For each quantity, the function of walls that computes it, and the unit of its errors; "1" means relative errors.
QUANTITIES: dict[str, tuple[Callable[..., Any], str]] = {
    "spectral radius": (spectral_radius, "1"),
    "`alpha_max`": (find_alpha, "1"),
    "`boundary_point`, alpha for a given beta": (
        lambda _alpha, beta, delta, d: boundary_point(delta, d, beta=beta).alpha,
        "1",
    ),
    "gain margin": (lambda *wall: margins(*wall).gain_margin, "1"),
    "phase margin": (lambda *wall: margins(*wall).phase_margin, "deg"),
    "delay margin": (lambda *wall: margins(*wall).delay_margin, "periods"),
    "modulus margin": (lambda *wall: margins(*wall).modulus_margin, "absolute"),
    "passivity margin": (passivity_margin, "absolute"),
}


def prepare(function: Callable[..., Any], walls: Any, dtype: str) -> Callable[[], Any]:
    """Return a function that evaluates ``function`` inside `jit` at all walls, with arguments of the type ``dtype``."""
    enabled, columns = dtype == "float64", np.broadcast_arrays(*walls)
    with jax.enable_x64(enabled):
        program, arrays = jax.jit(function), [jnp.asarray(np.ravel(column), dtype) for column in columns]

    def call() -> Any:
        with jax.enable_x64(enabled), warnings.catch_warnings():
            warnings.simplefilter("ignore", PrecisionWarning)
            return jax.block_until_ready(program(*arrays))

    return call


def evaluate_walls(function: Callable[..., Any], walls: Any, dtype: str) -> np.ndarray:
    """Return the values of a function inside `jit` at all walls, as a Boolean or float64 array."""
    values = np.asarray(prepare(function, walls, dtype)())
    return values if values.dtype == bool else values.astype(float)


def draw_rounded_walls(delta: float, d: float, points: int) -> tuple[Walls, np.ndarray]:
    """Return walls of one device, rounded to float32, and their relative distances in alpha from the boundary.

    The walls lie next to random points of the stability boundary, between 2 and 99.5 % of its range of frequencies. The
    distances are computed in float64 from the rounded walls.
    """
    generator = np.random.default_rng([SEED, round(1e6 * delta), round(1e6 * d)])
    delta = float(np.float32(delta))
    omega = generator.uniform(0.02, 0.995, points) * float(sample_lobe(delta, d, points=16)[0][-1])
    point = boundary(omega, delta, d)
    offset = 10.0 ** generator.uniform(NEAREST, FARTHEST + 1, points) * generator.choice([-0.9, 0.9], points)
    columns = np.asarray(point.alpha) * (1.0 + offset), np.asarray(point.beta), np.full(points, delta)
    alpha, beta, delta_column = (np.float32(column).astype(float) for column in columns)
    walls = Walls(alpha, beta, delta_column, np.full(points, float(d)))
    return walls, np.abs(walls.alpha / row_limits(*walls[1:]) - 1.0)
