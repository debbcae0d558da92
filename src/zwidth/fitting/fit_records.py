"""Parts of what a fit says: intervals, what to try next, a log beside its fit, and devices that fit as well."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class ErrorBar(NamedTuple):
    """An interval that holds the true value with 95 % confidence."""

    low: float
    high: float


class FurtherExperiment(NamedTuple):
    """Raise K at this damping until the wall buzzes: N s/m, the N/m and Hz expected, and K_max's error afterwards.

    That error is NaN where K_max is.
    """

    virtual_damping: float
    stiffness: float
    frequency: float
    error_afterwards: float


class FittedMotion(NamedTuple):
    """One log beside its fit, a number a sample: times in s, forces in N, positions in m.

    ``modelled`` is NaN at the first samples, whose past forces are unknown, and behind the first 200,000.
    """

    time: np.ndarray
    force: np.ndarray
    position: np.ndarray
    modelled: np.ndarray


class RivalDevice(NamedTuple):
    """Another device that fits as well: kg, N s/m, s, its K_max in N/m, its cut-off in Hz where that was unknown.

    ``parts`` are the numbers of its amplifier and its resonance by their paths, None of a rigid one.
    """

    mass: float
    damping: float
    delay: float
    stiffness_max: float
    cutoff: float | None = None
    parts: dict[str, float] | None = None
