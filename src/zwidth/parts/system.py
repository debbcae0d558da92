"""From a linear system to a loop: a device of which nothing is known but what its position answers to a force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError

# Faster parts than this, in radians or decays a period, leave no digits of e^A; dampers may stop sooner what moves.
FASTEST, STRONGEST = 1e4, 1e10


class Realization(NamedTuple):
    """``x' = A x + B u + push f``, the first number of x what is sensed; f a force held on the device itself."""

    A: Any
    B: Any
    push: Any


@dataclass(frozen=True)
class System:
    """A linear device, normalized by the period and by its unit of mass; a sampled one holds its force itself."""

    device: LinearDevice
    period: Any
    mass: Any  # in which forces are counted
    d: Any
    whole: int
    estimate: Estimate

    @property
    def sampled(self) -> bool:
        """Whether it is given from sample to sample."""
        return self.device.dt is not None

    @property
    def free(self) -> bool:
        """Whether nothing pulls a device at rest back: a pole at s = 0 or z = 1."""
        bottom = self.device.system.denominator
        return sum(bottom) == 0 if self.sampled else bottom[-1] == 0

    def state_units(self, speed: float, force: float) -> list[float]:
        """The units of the state's numbers: its own."""
        return [1.0] * self.device.poles.size

    def realize(self) -> Realization:
        """The matrices of its motion; of a sampled one, of its change from sample to sample."""
        rate, push = _companion(self.device) if hasattr(self.mass, "mid") else _sections(self.device)
        if self.sampled:
            push = push * (self.mass / self.period**2)
            return Realization(rate, push, push)
        push = push * (self.mass / self.period)
        return Realization(rate * self.period, push, push)

    def check(self) -> None:
        """Refuse what cannot be sampled at the loop's period."""
        if self.sampled:
            dt, period = self.device.dt or 0.0, float(self.period)
            if abs(dt - period) > 1e-9 * period:
                raise InputError(f"device: got a system sampled at {dt:g} s in a loop of {period:g} s; give it anew")
            if self.d != self.whole:
                raise InputError(
                    f"delay: got {float(self.d):g} periods; a sampled device has its hold inside and may be later by "
                    "whole periods alone; put the rest into the device"
                )
            return
        fastest = float(np.abs(self.device.poles).max() * self.period)
        if fastest > FASTEST:
            raise InputError(
                f"device: a pole of {fastest:.3g} radians a period cannot be resolved; leave so fast a one out"
            )


def _sections(device: LinearDevice) -> tuple[np.ndarray, np.ndarray]:
    """A and B of sections in series, each with one pole or two, so that no root depends on another's rounding."""
    rate, push, seen, through = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for top, bottom in _pair(device.zeros, device.poles):
        order = bottom.size - 1
        own = np.eye(order, k=1)
        own[-1] = -bottom[:0:-1]
        sees = (top[1:] - top[0] * bottom[1:])[::-1]
        entry = np.eye(order)[-1]
        size = len(rate)
        rate = np.block([[rate, np.zeros((size, order))], [np.outer(entry, seen), own]])
        push = np.append(push, entry * through)
        seen, through = np.append(top[0] * seen, sees), top[0] * through
    return _see_first(rate, push * device.gain, seen)


def _pair(zeros: np.ndarray, poles: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Numerator and denominator of each section, slow ones first: two poles each, a last real one alone."""
    # A pair of zeros finds its section, for there are more poles than zeros.

    def group(roots: Any) -> list[np.ndarray]:
        real, pairs = (
            np.sort(roots[roots.imag == 0])[::-1],
            [np.array([z, z.conjugate()]) for z in roots[roots.imag > 0]],
        )
        return sorted([*pairs, *(real[k : k + 2] for k in range(0, real.size, 2))], key=lambda each: np.abs(each).min())

    sections = sorted(group(poles), key=lambda each: each.size, reverse=True)
    left, chosen = list(range(len(sections))), {}
    for each in sorted(group(zeros), key=lambda each: each.size, reverse=True):
        far = [abs(np.log((1e-300 + np.abs(sections[k]).max()) / (1e-300 + np.abs(each).max()))) for k in left]
        far = [np.inf if sections[k].size < each.size else value for k, value in zip(left, far, strict=True)]
        chosen[left.pop(int(np.argmin(far)))] = each
    found = []
    for k, own in enumerate(sections):
        top = np.atleast_1d(np.poly(chosen.get(k, np.zeros(0)))).real
        found.append((np.concatenate([np.zeros(own.size + 1 - top.size), top]), np.poly(own).real))
    return found


def _companion(device: LinearDevice) -> tuple[Any, Any]:
    """The same in balls, by the exact coefficients."""
    import flint

    def ball(value: Any) -> Any:
        return flint.arb(flint.fmpq(value.numerator, value.denominator))

    bottom = [value / device.system.denominator[0] for value in device.system.denominator]
    top = [value / device.system.denominator[0] for value in device.system.numerator]
    size = len(bottom) - 1
    rate = np.array([[flint.arb(int(j == i + 1)) for j in range(size)] for i in range(size)], object)
    rate[-1] = [-ball(value) for value in bottom[:0:-1]]
    push = np.array([flint.arb(int(i == size - 1)) for i in range(size)], object)
    seen = np.array([ball(value) for value in top[::-1]] + [flint.arb(0)] * (size - len(top)), object)
    return _see_first(rate, push, seen)


def _see_first(rate: Any, push: Any, seen: Any) -> tuple[Any, Any]:
    """The same system with what is sensed in place of the state that it sees best, which comes first."""
    best = max(range(len(seen)), key=lambda k: abs(float(seen[k])))
    order = [best, *(k for k in range(len(seen)) if k != best)]
    rate, push, seen = rate[order][:, order], push[order], seen[order]
    # x1 = (y - the other parts of y)/seen1.
    columns = rate[:, :1] / seen[0]
    rate = np.concatenate([columns, rate[:, 1:] - columns * seen[None, 1:]], 1)
    first = seen @ rate
    return np.concatenate([first[None], rate[1:]]), np.concatenate([[seen @ push], push[1:]])
