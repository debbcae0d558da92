"""Scenes that differ in some parameters alone: what each of them bears, as arrays of closed forms or one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from zwidth.arrays.evaluate import FEW
from zwidth.loops.linear.rows import are_connected
from zwidth.loops.rigid.boundary import boundary_point
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.loops.rigid.verdict import is_stable

RIGID_PARAMETERS = ("mass", "damping", "period", "delay")
# More pieces than these are compiled.
_MOST_PIECES = 6


class Variants:
    """One scene after the other, each a search; of each parameter that varies one value a variant, by dotted path."""

    searched = True

    def __init__(self, scene: Any, drawn: dict[str, np.ndarray]) -> None:
        self.scene, self.drawn = scene, drawn
        (self.count,) = {values.size for values in drawn.values()}

    def scenes(self) -> Iterator[Any]:
        """Each variant as a scene."""
        for k in range(self.count):
            yield self.scene.replace(**{name: float(values[k]) for name, values in self.drawn.items()})

    def labels(self, stiffness: float, damping: float) -> np.ndarray:
        """Which variants bear a wall."""
        return np.array([bool(scene.is_stable(stiffness, damping)) for scene in self.scenes()])

    def row_ends(self, damping: np.ndarray) -> np.ndarray:
        """Return the largest K up to which walls are stable, for each variant and each B; 0 if no wall is stable.

        The stable interval starts at K = 0, or is the softest one with K > 0 if the device is unstable without a wall.
        """
        rows = (np.moveaxis(scene.stable_stiffness(damping), -1, 0) for scene in self.scenes())
        if self.scene.loop.least_stiffness(-np.inf) is not None:
            ends = np.array([np.min(np.where(high > 0, high, np.inf), -1, initial=np.inf) for _, high in rows])
            return np.where(np.isfinite(ends), ends, 0.0)
        firsts = (np.where(are_connected(low, high), high, 0.0) for low, high in rows)
        return np.array([first.max(-1, initial=0.0) for first in firsts])

    def stiffest(self) -> tuple[np.ndarray, np.ndarray]:
        """K and B of the stiffest wall of each variant."""
        found = np.array([scene.max_stiffness()[:2] for scene in self.scenes()], float)
        return found[:, 0], found[:, 1]


class RigidVariants(Variants):
    """Rigid devices as arrays, by closed forms."""

    searched = False

    def __init__(self, scene: Any, drawn: dict[str, np.ndarray]) -> None:
        super().__init__(scene, drawn)
        # The hand of a rigid grasp does not vary with the device.
        held = {"mass": scene.mass - scene.device.mass, "damping": scene.damping - scene.device.damping}
        own = scene.parameters()
        mass, damping, self.period, delay = (
            drawn.get(name, np.full(self.count, own[name])) + held.get(name, 0.0) for name in RIGID_PARAMETERS
        )
        # Where records leave the mass open, some that are drawn are 0.
        with np.errstate(all="ignore"):
            self.rate = mass / self.period
            self.delta = damping / self.rate
            # d depends on the period only if the delay was given in seconds.
            moving = {"delay"} if scene.timing.in_periods else {"delay", "period"}
            self.d = delay / self.period if moving & set(drawn) else np.full(self.count, float(scene.d))

    @np.errstate(all="ignore")
    def labels(self, stiffness: float, damping: float) -> np.ndarray:
        return self.ask(is_stable, stiffness / self.rate * self.period, damping / self.rate, self.delta, self.d)

    @np.errstate(all="ignore")
    def row_ends(self, damping: np.ndarray) -> np.ndarray:
        rate, delta, d = (values[:, None] for values in (self.rate, self.delta, self.d))
        ends = self.ask(lambda delta, d, beta: boundary_point(delta, d, beta=beta).alpha, delta, d, damping / rate)
        return np.where(np.isnan(ends), 0.0, ends * rate / self.period[:, None])

    @np.errstate(all="ignore")
    def column_ends(self, stiffness: float, side: str) -> np.ndarray:
        """Return the smallest or the largest stable B of each variant at a K; NaN if no B is stable."""
        alpha = stiffness * self.period / self.rate
        point = self.ask(lambda *at: boundary_point(*at[:2], alpha=at[2], side=side).beta, self.delta, self.d, alpha)
        return point * self.rate

    @np.errstate(all="ignore")
    def stiffest(self) -> tuple[np.ndarray, np.ndarray]:
        alpha, beta = self.ask(lambda *at: np.stack(alpha_max(*at)[:2]), self.delta, self.d)
        return alpha * self.rate / self.period, beta * self.rate

    @staticmethod
    def ask(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
        """Evaluate a function of arrays in pieces that are small enough to be faster in NumPy than compiled."""
        whole = np.broadcast_arrays(*arrays)
        pieces = -(-whole[0].size // FEW)
        split = [np.array_split(array.ravel(), pieces if pieces <= _MOST_PIECES else 1) for array in whole]
        found = np.concatenate([np.asarray(function(*piece)) for piece in zip(*split, strict=True)], -1)
        return found.reshape(*found.shape[:-1], *whole[0].shape)
