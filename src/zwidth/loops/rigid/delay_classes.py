"""What the verdict and the boundary need of a device (delta, d), computed once a device and shared by all its walls."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays import phi
from zwidth.arrays.arguments import as_float64
from zwidth.arrays.xp import is_traced
from zwidth.loops.domain import nan_unless, valid_device
from zwidth.loops.rigid.plant import Functions, discretize, split_delay
from zwidth.loops.rigid.polynomial import tilt_at_minus_one
from zwidth.words.types import Array


class DelayClasses(NamedTuple):
    """Which delays occur among the points of a kernel; what does not occur costs nothing."""

    short: bool  # below one period
    long: bool  # of one period or more
    fractional: bool


ANY = DelayClasses(True, True, True)


def classify_delays(d: Any) -> DelayClasses:
    """The `DelayClasses` of an array of delays, `ANY` where they are traced; what is no delay counts as short."""
    if isinstance(d, float | int):
        return DelayClasses(not d >= 1, d >= 1, d % 1.0 != 0)
    if is_traced(d):
        return ANY
    d = as_float64("d", d)
    long = d >= 1
    return DelayClasses(not (long.size and np.all(long)), bool(np.any(long)), bool(np.any(np.floor(d) != d)))


class DeviceTerms(NamedTuple):
    """Delay, plant and phi-functions of one device; NaN throughout where delta or d is out of range."""

    delta: Array
    whole: Array  # n
    f: Array
    c: Array
    em: Array  # 1 - c
    p1: Array  # phi1 = a2 + a1 + a0
    p2: Array
    psi: Array
    p1_t: Array  # phi1 and psi of delta (1 - f)
    psi_t: Array
    a2: Array
    a1: Array
    a0: Array
    gap: Array  # N(-1) = a2 - a1 + a0
    tilt: Array  # P(-1) has the stable sign where tilt (alpha + 2 beta) < 1


def device(delta: Array, d: Array, kind: DelayClasses = ANY, functions: Functions = phi.phi_functions) -> DeviceTerms:
    """The `DeviceTerms` of one (delta, d), or of arrays of one shape."""
    delta, d = nan_unless(valid_device(delta, d), delta, d)
    whole, f = split_delay(d)
    at = functions(delta)
    late = functions(delta * (1.0 - f)) if kind.fractional and kind.short else at
    plant = discretize(delta, f if kind.fractional else None, functions, at)
    tilt = tilt_at_minus_one(plant, whole)
    return DeviceTerms(
        *(delta, whole, f, plant.c, plant.em, at.phi1, at.phi2, at.psi, late.phi1, late.psi),
        *(plant.a2, plant.a1, plant.a0, plant.gap, tilt),
    )
