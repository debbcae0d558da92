"""Stability and stiffness limits of many variants of a scene, for tolerances and uncertain devices.

A *variant* is the scene with other values of some parameters. `Variants` evaluates all variants of any scene at once,
by pole counts along lines of walls (`zwidth.stability.linear.batch_lines`). Variants whose results the pole counts do
not confirm are evaluated one by one. `RigidVariants` evaluates variants of a rigid mass with the backward difference by
closed forms on arrays. Results have one entry per variant. K and B are the stiffness and damping of a wall in SI units;
``rate`` is m/T, ``delta = b T/m``, and d is the delay in periods T, with the mass m and damping b of the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError, ZwidthError
from zwidth.core.status import RidgeKind, Status
from zwidth.core.xp import within
from zwidth.model.checks import to_periods
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.model.velocity import ESTIMATES, FOAW
from zwidth.numerics.evaluate import FEW
from zwidth.stability.linear.batch_devices import LONGEST_DELAY, compare_responses, map_loops
from zwidth.stability.linear.batch_lines import count_outside, find_stiffness_limits
from zwidth.stability.linear.batch_ridge import find_stiffest
from zwidth.stability.linear.loop_batch import sample
from zwidth.stability.linear.rows import are_connected
from zwidth.stability.results import RidgePoint
from zwidth.stability.rigid.boundary import boundary_point
from zwidth.stability.rigid.normalization import quantity_status
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.verdict import is_stable
from zwidth.units.quantities import FIELDS, WALL, WALL_RANGE

RIGID_PARAMETERS = ("mass", "damping", "period", "delay")
MAX_PIECES = 6  # largest number of pieces of arrays that NumPy evaluates faster than a function compiled by JAX
LEAST_BATCH = 6  # smallest number of variants that are faster to evaluate at once than one by one
# Parts of a scene that the batch computation supports. Variants of a scene with other parts are evaluated one by one.
EVALUATED = ("device", "timing", "wall", "velocity", "operator", "safe_limit")
LONGEST_WINDOW = 64  # longest velocity window, in periods, of variants evaluated at once; longer windows take too long
# Densities of the frequency grid. The higher one is used for variants that are not confirmed with the lower one.
DENSITIES = (1, 2)


class _NormalizedVariants(NamedTuple):
    """Parameters of all variants, from which their normalized parameters follow."""

    values: dict[str, np.ndarray]  # varied parameters by dotted path
    d: np.ndarray  # delay in periods
    period: np.ndarray
    mass: np.ndarray  # unit of mass: the mass in kg that the force of the wall acts on
    usable: np.ndarray  # True for variants that can be evaluated at once


class BatchRidge(NamedTuple):
    """Stiffest wall of each variant in normalized parameters."""

    point: RidgePoint
    searched: np.ndarray  # True for variants that were searched one by one
    # Angles w, in rad per period, of the poles on the unit circle of both active constraints, shape (2, variants). Both
    # angles are equal if only one pole or pole pair is on the circle. They are NaN where ``searched``.
    angles: np.ndarray


def list_further_parts(scene: Any) -> tuple[Any, ...]:
    """Return the parts of a scene that the batch computation does not support."""
    parts = (getattr(scene, item.name) for item in fields(scene) if item.name not in EVALUATED)
    return tuple(part for part in parts if part is not None)


class Variants:
    """Variants of any scene.

    Args:
        scene: the nominal scene.
        drawn: values of each varied parameter by dotted path, arrays of equal length with one value per variant.
    """

    def __init__(self, scene: Any, drawn: dict[str, np.ndarray]) -> None:
        self.scene, self.drawn = scene, drawn
        (self.count,) = {values.size for values in drawn.values()}

    def build(self, k: int) -> Any:
        """Return the variant with index k as a scene."""
        return self.scene.replace(**{name: float(values[k]) for name, values in self.drawn.items()})

    @cached_property
    def normalized(self) -> _NormalizedVariants:
        """Parameters of all variants, and flags for the variants that can be evaluated at once."""
        scene, nominal = self.scene, self.scene.parameters()
        values = {name: np.asarray(column, float) for name, column in self.drawn.items() if name not in WALL}
        if "rate" in values:
            with np.errstate(divide="ignore"):
                values["period"] = 1.0 / values.pop("rate")
        period = values.get("period", np.full(self.count, float(scene.timing.period)))
        with np.errstate(all="ignore"):
            if "delay" in values or not scene.timing.in_periods:
                d = to_periods(np.broadcast_to(values.get("delay", float(scene.timing.delay)), period.shape), period)
            else:
                d = np.full(self.count, float(scene.d))
            usable = np.full(self.count, self._is_supported(values)) & (d >= 0) & (d <= LONGEST_DELAY) & (period > 0)
            walls = {name: self.drawn[name] for name in WALL if name in self.drawn}
            for name, column in (values | walls).items():
                key = f"mode.{name.rpartition('.')[2]}" if name.startswith("modes.") else name
                usable &= np.isfinite(column) & (FIELDS[key].allowed.holds(column) if key in FIELDS else False)
            every: dict[str, Any] = {path: values.get(path, value) for path, value in nominal.items()}
            cutoff = every.get("velocity.cutoff", 0.0) * every.get("velocity.coded_period", period)
            usable &= cutoff < 0.5
            usable &= every.get("operator.mass", 1.0) > 0 if "operator.coupling_stiffness" in nominal else True
        hand = scene.operator
        rigid = hand is not None and hand.rigid and scene.device.coupling is None
        mass = every.get("mass", float(scene.mass)) + (every["operator.mass"] if rigid else 0.0)
        return _NormalizedVariants(values, d, period, np.broadcast_to(mass, period.shape), usable)

    def _is_supported(self, values: dict[str, np.ndarray]) -> bool | np.ndarray:
        """Return whether the batch computation supports the scene, and its variants have the same structure."""
        scene, nominal = self.scene, self.scene.parameters()
        device, velocity = scene.device, scene.velocity
        known = type(device) in (Device, LinearDevice) and type(velocity) in ESTIMATES.values()
        known = known and not list_further_parts(scene)
        sampled = getattr(device, "dt", None) is not None
        whole = any(isinstance(nominal.get(name), int) for name in values)
        # Without a spring to ground a model has a different structure, so its stiffness must not be 0 in any variant.
        changed = any(name.startswith("operator.stiffness") and np.any(column == 0) for name, column in values.items())
        window = getattr(velocity, "samples", 1)
        return known and not (sampled or whole or changed or isinstance(velocity, FOAW) or window > LONGEST_WINDOW)

    def _map(self, function: Callable[..., tuple[np.ndarray, ...]], selected: np.ndarray) -> list[np.ndarray]:
        """Apply a function to the loops of the selected variants, as described in `map_loops`."""
        values = {name: column[selected] for name, column in self.normalized.values.items()}
        values.setdefault("mass", np.full(selected.size, float(self.scene.device.mass)))
        return map_loops(self.scene, values, self.normalized.d[selected], function)

    def labels(self, stiffness: float, damping: float) -> np.ndarray:
        """Return a boolean array with one entry per variant: True if the wall is stable on this variant."""
        mass, period = self.normalized.mass, self.normalized.period
        with np.errstate(all="ignore"):
            rate = mass / period
            return self.label_normalized(stiffness * period / rate, damping / rate)

    def label_normalized(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return a boolean array with one entry per variant k: True if (alpha[k], beta[k]) is stable on this variant.

        ``alpha`` and ``beta`` are the stiffness and damping of the wall, normalized by mass and period of the variant.
        """
        stable, left = np.zeros(self.count, bool), np.full(self.count, True)
        inside = within(alpha, WALL_RANGE) & within(beta, WALL_RANGE) & (alpha > 0)
        selected = np.flatnonzero(self.normalized.usable & inside)
        if selected.size >= LEAST_BATCH:

            def label(form, loop, sizes, states, index) -> tuple[np.ndarray, ...]:
                loops = sample(form, loop, sizes)
                outside, doubtful = count_outside(loops, alpha[selected[index]], beta[selected[index]])
                return outside, np.asarray(doubtful)

            outside, doubtful = self._map(label, selected)
            stable[selected], left[selected] = outside == 0, doubtful
        for k in np.flatnonzero(left).tolist():
            stable[k] = self._label(k, alpha[k : k + 1], beta[k : k + 1])
        return stable

    def _label(self, k: int, alpha: np.ndarray, beta: np.ndarray) -> bool:
        """Return whether one wall is stable on the variant with the index k."""
        return bool(self.build(k).loop.labels(alpha, beta)[0])

    def find_stiffness_limits(self, damping: np.ndarray) -> np.ndarray:
        """Return the upper end of the lowest stable interval of K for each variant and each B; 0 if no wall is stable.

        The lowest interval starts at K = 0. If the device is unstable without a wall, the lowest interval is the first
        one with K > 0.
        """
        mass, period, usable = self.normalized.mass, self.normalized.period, self.normalized.usable
        limits, left = np.zeros((self.count, damping.size)), np.full(self.count, True)
        selected = np.flatnonzero(usable & (self.count >= LEAST_BATCH))
        if selected.size:

            def limit(form, loop, sizes, states, index) -> tuple[np.ndarray, ...]:
                rate = mass[selected[index]] / period[selected[index]]
                loops = sample(form, loop, sizes)
                ends = [find_stiffness_limits(loops, B / rate) for B in damping.tolist()]
                alpha, doubtful = (np.stack(part) for part in zip(*ends, strict=True))
                return alpha * rate / period[selected[index]], np.asarray(doubtful.any(0))

            found, doubtful = self._map(limit, selected)
            limits[selected], left[selected] = found.T, doubtful
        for k in np.flatnonzero(left).tolist():
            limits[k] = self._find_limits(self.build(k), damping)
        return limits

    def _find_limits(self, scene: Any, damping: np.ndarray) -> np.ndarray:
        """Return the limits of K of one variant for each B, as described in `find_stiffness_limits`."""
        low, high = np.moveaxis(scene.stable_stiffness(damping), -1, 0)
        if self.scene.loop.least_stiffness(-np.inf) is not None:
            ends = np.min(np.where(high > 0, high, np.inf), -1, initial=np.inf)
            return np.where(np.isfinite(ends), ends, 0.0)
        return np.where(are_connected(low, high), high, 0.0).max(-1, initial=0.0)

    def find_ridges(self, negative: bool) -> BatchRidge:
        """Return the stiffest stable wall of each variant; include walls with B < 0 only if ``negative``."""
        columns = [np.full(self.count, np.nan) for _ in range(3)]
        kind, status = np.full(self.count, int(RidgeKind.NONE), np.int32), np.zeros(self.count, np.int32)
        left, angles = np.full(self.count, True), np.full((2, self.count), np.nan)
        for density in DENSITIES:
            selected = np.flatnonzero(left & self.normalized.usable)
            if self.count < LEAST_BATCH or not selected.size:
                break

            def solve(form, loop, sizes, states, index, density=density) -> tuple[np.ndarray, ...]:
                found = find_stiffest(form, loop, sizes._replace(density=density), negative)
                confirmed = found.confirmed
                if states is not None:
                    for w in found.angles:
                        confirmed = confirmed & compare_responses(form, loop, states, w)
                return (*found[:3], found.kind, found.angles, confirmed)

            *found, kinds, both, confirmed = self._map(solve, selected)
            done = selected[confirmed]
            for column, part in zip(columns, found, strict=True):
                column[done] = part[confirmed]
            kind[done], angles[:, done], left[done] = kinds[confirmed], both[:, confirmed], False
        for k in np.flatnonzero(left).tolist():
            *numbers, kind[k], status[k] = self._search_ridge(k, negative)
            for column, number in zip(columns, numbers, strict=True):
                column[k] = number
        return BatchRidge(RidgePoint._make([*columns, kind, status]), left, angles)

    def _search_ridge(self, k: int, negative: bool) -> tuple[float, ...]:
        """Return the stiffest wall of the variant with index k, computed by itself."""
        try:
            return tuple(map(float, self.build(k).loop.stiffest(negative)))
        except InputError:
            return math.nan, math.nan, math.nan, int(RidgeKind.NONE), int(Status.INVALID_INPUT)
        except (ArithmeticError, ZwidthError):
            return math.nan, math.nan, math.nan, int(RidgeKind.NONE), int(Status.NOT_CONVERGED)

    def stiffest(self, negative: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return K, B and `Status` of the stiffest stable wall of each variant; see `find_ridges` for ``negative``."""
        point, period = self.find_ridges(negative).point, self.normalized.period
        with np.errstate(all="ignore"):
            rate = self.normalized.mass / period
            return point.alpha * rate / period, point.beta * rate, point.status


class RigidVariants(Variants):
    """Variants of a rigid mass with the backward difference, evaluated at once by closed forms."""

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
        """Return the smallest (``side`` "lower") or largest ("upper") stable B of each variant at K, or NaN."""
        alpha = stiffness * self.period / self.rate
        point = self.evaluate(
            lambda *args: boundary_point(*args[:2], alpha=args[2], side=side).beta, self.delta, self.d, alpha
        )
        return point * self.rate

    @np.errstate(all="ignore")
    def find_ridges(self, negative: bool) -> BatchRidge:
        if not negative:
            return super().find_ridges(negative)
        *numbers, kind, status = self.evaluate(lambda *args: np.stack(alpha_max(*args)), self.delta, self.d)
        valid = quantity_status(**self.drawn) == Status.OK
        numbers = [np.where(valid, column, np.nan) for column in numbers]
        kind = np.where(valid, kind, int(RidgeKind.NONE)).astype(np.int32)
        status = np.where(valid, status, int(Status.INVALID_INPUT)).astype(np.int32)
        point = RidgePoint._make([*numbers, kind, status])
        return BatchRidge(point, np.full(self.count, False), np.stack([point.omega, point.omega]))

    @staticmethod
    def evaluate(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
        """Evaluate a function of arrays, in small pieces if this takes less time than compilation by JAX.

        A function called with at most ``FEW`` elements runs in NumPy; with more elements JAX compiles it.
        """
        arguments = np.broadcast_arrays(*arrays)
        n_pieces = -(-arguments[0].size // FEW)
        split = [np.array_split(array.ravel(), n_pieces if n_pieces <= MAX_PIECES else 1) for array in arguments]
        values = np.concatenate([np.asarray(function(*piece)) for piece in zip(*split, strict=True)], -1)
        return values.reshape(*values.shape[:-1], *arguments[0].shape)
