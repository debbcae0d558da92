"""Spectral radii of walls by common alternative tools, called as their users would call them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from methods.problems import Walls
from zwidth.stability.rigid.poles import char_poly


class Baseline(NamedTuple):
    """Function of a tool, and the largest batch that it computes in reasonable time at degree 4."""

    radius: Callable[[Walls], np.ndarray]
    points: int
    only_whole: bool = False


def _coefficients(walls: Walls) -> np.ndarray:
    return np.asarray(char_poly(*walls.listed()))


def companions(walls: Walls) -> np.ndarray:
    """Return the companion matrices of all walls, of shape (points, degree, degree)."""
    monic = _coefficients(walls)
    size = monic.shape[1] - 1
    matrices = np.zeros((monic.shape[0], size, size))
    matrices[:, 0, :] = -monic[:, 1:]
    matrices[:, np.arange(1, size), np.arange(size - 1)] = 1.0
    return matrices


def _numpy_eigvals(walls: Walls) -> np.ndarray:
    return np.abs(np.linalg.eigvals(companions(walls))).max(axis=1)


def _numpy_roots(walls: Walls) -> np.ndarray:
    return np.array([np.abs(np.roots(row)).max() for row in _coefficients(walls)])


@cache
def _jax_radius() -> Any:
    return jax.jit(lambda matrices: jnp.abs(jnp.linalg.eigvals(matrices)).max(axis=1))


def _jax_eigvals(walls: Walls) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(_jax_radius()(companions(walls)))


def _python_control(walls: Walls) -> np.ndarray:
    """Return spectral radii by discretization and feedback in python-control."""
    control: Any = import_module("control")
    radii = []
    for alpha, beta, delta, d in zip(*walls.listed(), strict=True):
        device = control.ss([[0.0, 1.0], [0.0, -delta]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
        plant = control.c2d(device, 1.0, "zoh")
        # Wall with delay: (alpha z + beta (z - 1)) / z^(1 + d).
        denominator = [1.0] + [0.0] * (1 + int(d))
        wall = control.tf2ss(control.tf([alpha + beta, -beta], denominator, 1.0))
        radii.append(np.abs(control.feedback(plant, wall).poles()).max())
    return np.array(radii)


def available() -> dict[str, Baseline]:
    """Return all installed baselines."""
    found = {
        "np.linalg.eigvals": Baseline(_numpy_eigvals, 20_000),
        "jnp.linalg.eigvals": Baseline(_jax_eigvals, 20_000),
        "np.roots loop": Baseline(_numpy_roots, 1_000),
    }
    if find_spec("control"):
        found["python-control"] = Baseline(_python_control, 50, only_whole=True)
    return found
