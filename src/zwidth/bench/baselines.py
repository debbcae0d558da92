"""The tools people would use otherwise, called as they would call them."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.bench.problems import Walls
from zwidth.loop import char_poly


def companions(walls: Walls) -> np.ndarray:
    """The companion matrices of every wall, of shape (points, degree, degree)."""
    flat = [np.ravel(part) for part in np.broadcast_arrays(*walls)]
    monic = np.asarray(char_poly(*flat))
    size = monic.shape[1] - 1
    matrices = np.zeros((monic.shape[0], size, size))
    matrices[:, 0, :] = -monic[:, 1:]
    matrices[:, np.arange(1, size), np.arange(size - 1)] = 1.0
    return matrices


def numpy_eigvals(walls: Walls) -> np.ndarray:
    """Spectral radii by one batched ``np.linalg.eigvals``."""
    return np.abs(np.linalg.eigvals(companions(walls))).max(axis=1)


def numpy_roots(walls: Walls) -> np.ndarray:
    """Spectral radii by a loop over ``np.roots``."""
    flat = [np.ravel(part) for part in np.broadcast_arrays(*walls)]
    return np.array([np.abs(np.roots(row)).max() for row in np.asarray(char_poly(*flat))])


_jax_radius = jax.jit(lambda matrices: jnp.abs(jnp.linalg.eigvals(matrices)).max(axis=1))


def jax_eigvals(walls: Walls) -> np.ndarray:
    """Spectral radii by one batched ``jnp.linalg.eigvals``."""
    with jax.enable_x64(True):
        return np.asarray(_jax_radius(companions(walls)))


def python_control(walls: Walls) -> np.ndarray:
    """Spectral radii as a user of python-control finds them: discretize, close the loop, ask for the poles."""
    import control

    flat = [np.ravel(part) for part in np.broadcast_arrays(*walls)]
    radii = []
    for alpha, beta, delta, d in zip(*flat, strict=True):
        device = control.ss([[0.0, 1.0], [0.0, -delta]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
        plant = control.c2d(device, 1.0, "zoh")
        # (alpha z + beta (z - 1)) / z^(1 + d): the wall with its delay.
        denominator = [1.0] + [0.0] * (1 + int(d))
        wall = control.tf2ss(control.tf([alpha + beta, -beta], denominator, 1.0))
        radii.append(np.abs(control.feedback(plant, wall).poles()).max())
    return np.array(radii)


def available() -> dict[str, tuple[Callable[[Walls], Any], int]]:
    """Every baseline that is installed, with the largest batch that is worth its time."""
    found: dict[str, tuple[Callable[[Walls], Any], int]] = {
        "np.linalg.eigvals": (numpy_eigvals, 20_000),
        "jnp.linalg.eigvals": (jax_eigvals, 20_000),
        "np.roots loop": (numpy_roots, 1_000),
    }
    if find_spec("control"):
        found["python-control"] = (python_control, 50)
    return found
