"""Stability and stiffness limits of many variants of a scene, for tolerances and uncertain devices.

A *variant* is the scene with other values of some parameters. `Variants` evaluates any scene, one variant after the
other. `RigidVariants` evaluates all variants of a rigid mass with the backward difference at once, by closed forms on
arrays. Results have one entry per variant. K and B are the stiffness and damping of a wall in SI units; ``rate`` is
m/T, ``delta = b T/m``, and d is the delay in periods T, with the mass m and damping b of the device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from zwidth.numerics.evaluate import FEW
from zwidth.stability.linear.rows import are_connected
from zwidth.stability.rigid.boundary import boundary_point
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.verdict import is_stable

RIGID_PARAMETERS = ("mass", "damping", "period", "delay")
MAX_PIECES = 6  # largest number of pieces of arrays that NumPy evaluates faster than a function compiled by JAX


class Variants:
    """Variants of any scene, evaluated one after the other.

    Args:
        scene: the nominal scene.
        drawn: values of each varied parameter by dotted path, arrays of equal length with one value per variant.
    """

    searched = True  # K_max of each variant needs a search, which takes 10 to 50 ms

    def __init__(self, scene: Any, drawn: dict[str, np.ndarray]) -> None:
        self.scene, self.drawn = scene, drawn
        (self.count,) = {values.size for values in drawn.values()}

    def scenes(self) -> Iterator[Any]:
        """Yield the variants one after the other, each as a scene with its parameter values."""
        for k in range(self.count):
            yield self.scene.replace(**{name: float(values[k]) for name, values in self.drawn.items()})

    def labels(self, stiffness: float, damping: float) -> np.ndarray:
        """Return a boolean array with one entry per variant: True if the wall is stable on this variant."""
        return np.array([bool(scene.is_stable(stiffness, damping)) for scene in self.scenes()])

    def find_stiffness_limits(self, damping: np.ndarray) -> np.ndarray:
        """Return the upper end of the lowest stable interval of K for each variant and each B; 0 if no wall is stable.

        The interval is the one that starts at K = 0. If the device is unstable without a wall, it is the interval with
        the softest walls of K > 0.
        """
        intervals = (np.moveaxis(scene.stable_stiffness(damping), -1, 0) for scene in self.scenes())
        if self.scene.loop.least_stiffness(-np.inf) is not None:
            ends = np.array([np.min(np.where(high > 0, high, np.inf), -1, initial=np.inf) for _, high in intervals])
            return np.where(np.isfinite(ends), ends, 0.0)
        limits = (np.where(are_connected(low, high), high, 0.0) for low, high in intervals)
        return np.array([limit.max(-1, initial=0.0) for limit in limits])

    def stiffest(self) -> tuple[np.ndarray, np.ndarray]:
        """Return K and B of the stiffest stable wall of each variant."""
        walls = np.array([scene.max_stiffness()[:2] for scene in self.scenes()], float)
        return walls[:, 0], walls[:, 1]


class RigidVariants(Variants):
    """Variants of a rigid mass with the backward difference, evaluated at once by closed forms."""

    searched = False

    def __init__(self, scene: Any, drawn: dict[str, np.ndarray]) -> None:
        super().__init__(scene, drawn)
        # Add the mass and damping of a rigidly coupled operator after drawing those of the device, because the operator
        # does not vary.
        operator = {"mass": scene.mass - scene.device.mass, "damping": scene.damping - scene.device.damping}
        nominal = scene.parameters()
        mass, damping, self.period, delay = (
            drawn.get(name, np.full(self.count, nominal[name])) + operator.get(name, 0.0) for name in RIGID_PARAMETERS
        )
        # Ignore divisions by zero, because variants drawn for an uncertain fitted device may have zero mass.
        with np.errstate(all="ignore"):
            self.rate = mass / self.period
            self.delta = damping / self.rate
            # Vary d with the period only if the delay was given in seconds, because a delay given in periods stays
            # constant.
            relevant = {"delay"} if scene.timing.in_periods else {"delay", "period"}
            self.d = delay / self.period if relevant & set(drawn) else np.full(self.count, float(scene.d))

    @np.errstate(all="ignore")
    def labels(self, stiffness: float, damping: float) -> np.ndarray:
        return self.evaluate(is_stable, stiffness / self.rate * self.period, damping / self.rate, self.delta, self.d)

    @np.errstate(all="ignore")
    def find_stiffness_limits(self, damping: np.ndarray) -> np.ndarray:
        rate, delta, d = (values[:, None] for values in (self.rate, self.delta, self.d))
        ends = self.evaluate(lambda delta, d, beta: boundary_point(delta, d, beta=beta).alpha, delta, d, damping / rate)
        return np.where(np.isnan(ends), 0.0, ends * rate / self.period[:, None])

    @np.errstate(all="ignore")
    def find_damping_limits(self, stiffness: float, side: str) -> np.ndarray:
        """Return the smallest ("lower" side) or largest ("upper" side) stable B of each variant at K; NaN if none."""
        alpha = stiffness * self.period / self.rate
        point = self.evaluate(
            lambda *args: boundary_point(*args[:2], alpha=args[2], side=side).beta, self.delta, self.d, alpha
        )
        return point * self.rate

    @np.errstate(all="ignore")
    def stiffest(self) -> tuple[np.ndarray, np.ndarray]:
        alpha, beta = self.evaluate(lambda *args: np.stack(alpha_max(*args)[:2]), self.delta, self.d)
        return alpha * self.rate / self.period, beta * self.rate

    @staticmethod
    def evaluate(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
        """Evaluate a function of arrays, in small pieces if NumPy then takes less time than compilation by JAX.

        A function called with at most ``FEW`` elements runs in NumPy; with more elements JAX compiles it.
        """
        arguments = np.broadcast_arrays(*arrays)
        n_pieces = -(-arguments[0].size // FEW)
        split = [np.array_split(array.ravel(), n_pieces if n_pieces <= MAX_PIECES else 1) for array in arguments]
        values = np.concatenate([np.asarray(function(*piece)) for piece in zip(*split, strict=True)], -1)
        return values.reshape(*values.shape[:-1], *arguments[0].shape)
