"""Plant of a linear device: a system given only by its response from commanded force to measured position.

The device is a transfer function in s, or in z if it was sampled. This module builds a state-space realization whose
first state is the output. Times are in sampling periods T and forces in units of mass/T^2, as for a device with known
masses (`zwidth.model.mechanism`). In float64, the realization consists of sections of order 1 or 2 in series, which
keep each root accurate. In ball arithmetic (intervals, python-flint), it is the companion form of the exact
coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.estimate import Estimate
from zwidth.model.linear_device import LinearDevice
from zwidth.model.loop_estimates import LoopEstimates

# Beyond these limits, the matrix exponential of the state equation cannot be computed accurately.
FASTEST = 1e4  # largest magnitude of a pole in rad per period
STRONGEST = 1e10  # largest decay rate that a damper causes, damping/mass, per period


class Realization(NamedTuple):
    """State equation ``x' = A x + B u + external f`` with commanded force u and external force f.

    The first state is the output, the measured position.
    """

    A: Any
    B: Any
    external: Any


@dataclass(frozen=True)
class System:
    """The plant of a linear device, in units of the sampling period and a mass; a sampled device includes its hold."""

    device: LinearDevice
    period: Any  # T in s
    mass: Any  # unit of mass in kg
    d: Any  # delay in periods
    n_delay: int  # integer part of d
    estimate: Estimate  # velocity estimate; divided by the position estimate if ``estimates`` is not None
    estimates: LoopEstimates | None = None  # None if there is neither a position estimate nor further feedback

    @property
    def sampled(self) -> bool:
        """True if the device is a discrete-time system."""
        return self.device.dt is not None

    @property
    def has_integrator(self) -> bool:
        """True if the device has an integrator, a pole at s = 0 or z = 1."""
        denominator = self.device.system.denominator
        return sum(denominator) == 0 if self.sampled else denominator[-1] == 0

    def state_units(self, speed: float, force: float) -> list[float]:
        """Return 1 as the unit of each state, because the units are unknown; the arguments have no effect."""
        return [1.0] * self.device.poles.size

    def realize(self) -> Realization:
        """Return the normalized state equation; its left side is x' or, for a sampled device, the next state x[k+1]."""
        A, B = _realize_companion(self.device) if hasattr(self.mass, "mid") else _realize_sections(self.device)
        if self.sampled:
            B = B * (self.mass / self.period**2)
            return Realization(A, B, B)
        B = B * (self.mass / self.period)
        return Realization(A * self.period, B, B)

    def check(self) -> None:
        """Raise `InputError` if a sampled device does not fit the loop's period or delay, or if a pole is too fast."""
        if self.sampled:
            dt, period = self.device.dt or 0.0, float(self.period)
            if abs(dt - period) > 1e-9 * period:
                raise InputError(
                    f"device: got a system sampled at {dt:g} s in a loop of {period:g} s; use a system sampled at the "
                    "loop's period"
                )
            if self.d != self.n_delay:
                raise InputError(
                    f"delay: got {float(self.d):g} periods; a sampled device allows only an integer delay; include the "
                    "fraction in the device"
                )
            return
        fastest = float(np.abs(self.device.poles).max() * self.period)
        if fastest > FASTEST:
            raise InputError(
                f"device: got a pole of {fastest:.3g} rad per period; at most {FASTEST:g} is possible; omit this pole"
            )


def _realize_sections(device: LinearDevice) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B of a realization by sections of order 1 or 2 in series.

    With such sections, rounding errors of one root do not affect the roots of other sections.
    """
    # A, B, C and D are the matrices of the sections connected so far, without the gain.
    A, B, C, D = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for numerator, denominator in _pair_roots(device.zeros, device.poles):
        order = denominator.size - 1
        section = np.eye(order, k=1)
        section[-1] = -denominator[:0:-1]
        section_C = (numerator[1:] - numerator[0] * denominator[1:])[::-1]
        entry = np.eye(order)[-1]
        size = len(A)
        A = np.block([[A, np.zeros((size, order))], [np.outer(entry, C), section]])
        B = np.append(B, entry * D)
        C, D = np.append(numerator[0] * C, section_C), numerator[0] * D
    return _output_as_first_state(A, B * device.gain, C)


def _pair_roots(zeros: np.ndarray, poles: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Distribute zeros and poles to sections of two poles each, the last with one if the number of poles is odd.

    Returns:
        Numerator and denominator of each section: sections with two poles first, and slow ones first among them. The
        numerators have leading zeros.
    """

    def group(roots: Any) -> list[np.ndarray]:
        real, pairs = (
            np.sort(roots[roots.imag == 0])[::-1],
            [np.array([z, z.conjugate()]) for z in roots[roots.imag > 0]],
        )
        return sorted([*pairs, *(real[k : k + 2] for k in range(0, real.size, 2))], key=lambda each: np.abs(each).min())

    sections = sorted(group(poles), key=lambda each: each.size, reverse=True)
    # The zeros are divided into groups: a conjugate pair, two real zeros, or a single one. Assign each group to the
    # free section whose poles have the most similar magnitude. A section with two poles is always free for a group of
    # two zeros, because the device has more poles than zeros.
    left, chosen = list(range(len(sections))), {}
    for each in sorted(group(zeros), key=lambda each: each.size, reverse=True):
        far = [abs(np.log((1e-300 + np.abs(sections[k]).max()) / (1e-300 + np.abs(each).max()))) for k in left]
        far = [np.inf if sections[k].size < each.size else value for k, value in zip(left, far, strict=True)]
        chosen[left.pop(int(np.argmin(far)))] = each
    pairs = []
    for k, section in enumerate(sections):
        numerator = np.atleast_1d(np.poly(chosen.get(k, np.zeros(0)))).real
        pairs.append((np.concatenate([np.zeros(section.size + 1 - numerator.size), numerator]), np.poly(section).real))
    return pairs


def _realize_companion(device: LinearDevice) -> tuple[Any, Any]:
    """Return A and B of the companion form as arrays of balls, computed from the exact coefficients of the device."""
    import flint

    def ball(value: Any) -> Any:
        return flint.arb(flint.fmpq(value.numerator, value.denominator))

    denominator = [value / device.system.denominator[0] for value in device.system.denominator]
    numerator = [value / device.system.denominator[0] for value in device.system.numerator]
    size = len(denominator) - 1
    A = np.array([[flint.arb(int(j == i + 1)) for j in range(size)] for i in range(size)], object)
    A[-1] = [-ball(value) for value in denominator[:0:-1]]
    B = np.array([flint.arb(int(i == size - 1)) for i in range(size)], object)
    C = np.array([ball(value) for value in numerator[::-1]] + [flint.arb(0)] * (size - len(numerator)), object)
    return _output_as_first_state(A, B, C)


def _output_as_first_state(A: Any, B: Any, C: Any) -> tuple[Any, Any]:
    """Return A and B after a change of the state variables that makes the output y = C x the first state.

    Args:
        A: state matrix.
        B: input vector.
        C: output vector. The output replaces the state with the largest coefficient, so that the transformation is
            well-conditioned.
    """
    best = max(range(len(C)), key=lambda k: abs(float(C[k])))
    order = [best, *(k for k in range(len(C)) if k != best)]
    A, B, C = A[order][:, order], B[order], C[order]
    # Replace the state x1 by y: substitute x1 = (y - c2 x2 - c3 x3 - ..)/c1.
    columns = A[:, :1] / C[0]
    A = np.concatenate([columns, A[:, 1:] - columns * C[None, 1:]], 1)
    first = C @ A
    return np.concatenate([first[None], A[1:]]), np.concatenate([[C @ B], B[1:]])
