"""Random devices as matrices, excited by a force and measured by an encoder: exact between samples, without
zwidth.

Bodies, modes and the amplifier are one continuous system ``x' = A x + B u``, ``y = C x``; the force is held,
limited and delayed; the encoder rounds to its steps. Stability of a wall follows from eigenvalues of one
matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm

import zwidth

DURATION = 60.0
KINDS = ("rigid", "amplifier", "one resonance", "two resonances")


@dataclass(frozen=True)
class TrueDevice:
    """A device with its encoder and force limit."""

    kind: str
    mass: float
    damping: float
    lag: float  # time constant of the amplifier in s, 0 for none
    modes: tuple[tuple[float, float, float], ...]  # Hz, damping ratio, modal mass
    delay: float
    period: float
    encoder: float
    limit: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> TrueDevice:
        """Draw a device of one of the four kinds."""
        kind = KINDS[rng.integers(4)]
        mass = float(10 ** rng.uniform(-1.5, 0.0))
        count = {"one resonance": 1, "two resonances": 2}.get(kind, 0)
        tops = np.sort(10 ** rng.uniform(1.5, 2.6, count))
        modes = tuple(
            (float(top), float(10 ** rng.uniform(np.log10(0.005), -1.0)), float(mass * 10 ** rng.uniform(0.0, 1.5)))
            for top in tops
        )
        # Some modes have a negative mass ratio.
        modes = tuple((f, z, m * (-1.0 if rng.random() < 0.3 else 1.0)) for f, z, m in modes)
        return cls(
            kind, mass, float(mass * 10 ** rng.uniform(0.5, 2.0)),
            float(10 ** rng.uniform(-4, -3)) if kind == "amplifier" or rng.random() < 0.3 else 0.0,
            modes, float(rng.uniform(0, 2e-3)), 1e-3, float(10 ** rng.uniform(-6, np.log10(4e-5))),
            float(mass * 10 ** rng.uniform(1.0, 1.6)),
        )  # fmt: skip

    def matrices(self) -> tuple[Any, Any, Any]:
        """Return A, B and C of the continuous system."""
        blocks = [np.array([[0.0, 1.0], [0.0, -self.damping / self.mass]])]
        push, read = [0.0, 1.0 / self.mass], [1.0, 0.0]
        for hertz, ratio, mass in self.modes:
            w = 2 * np.pi * hertz
            blocks.append(np.array([[0.0, 1.0], [-w * w, -2 * ratio * w]]))
            push, read = [*push, 0.0, 1.0 / mass], [*read, 1.0, 0.0]
        A, B, C = block_diag(*blocks), np.array(push), np.array(read)
        if self.lag:
            A = np.block([[A, B[:, None]], [np.zeros((1, B.size)), np.array([[-1.0 / self.lag]])]])
            B, C = np.append(0 * B, 1.0 / self.lag), np.append(C, 0.0)
        return A, B, C

    def sampled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A, B and C of the sampled system; delayed forces are states."""
        A, B, C = self.matrices()
        size, periods = B.size, self.delay / self.period
        n = int(periods)
        f = periods - n

        def step(t: float) -> tuple[np.ndarray, np.ndarray]:
            transition = expm(np.block([[A, B[:, None]], [np.zeros((1, size + 1))]]) * t)
            return transition[:size, :size], transition[:size, size]

        second_part, first_part = step(self.period * (1 - f)), step(self.period * f)
        Ad = second_part[0] @ first_part[0]
        older, newer = second_part[0] @ first_part[1], second_part[1]
        # States: the device, then the commands of 1, 2, ..., n + 1 samples ago.
        total = np.zeros((size + n + 1, size + n + 1))
        total[:size, :size], total[:size, size + n] = Ad, older
        force = np.zeros(size + n + 1)
        if n:
            total[:size, size + n - 1] += newer
        else:
            force[:size] = newer
        force[size] = 1.0
        for k in range(n):
            total[size + 1 + k, size + k] = 1.0
        return total, force, np.append(C, np.zeros(n + 1))

    def play(self, force: np.ndarray, read: bool = True) -> np.ndarray:
        """Return the positions during an excitation, as read by the encoder or exact."""
        A, B, C = self.sampled()
        limited_force, x, out = np.clip(force, -self.limit, self.limit), np.zeros(B.size), np.empty(force.size)
        for k in range(force.size):
            out[k] = C @ x
            x = A @ x + B * limited_force[k]
        return self.encoder * np.round(out / self.encoder) if read else out

    def is_stable(self, stiffness: float, virtual_damping: float) -> bool:
        """Return whether a wall with backward difference is stable: all eigenvalues inside the unit circle."""
        A, B, C = self.sampled()
        size, rate = B.size, virtual_damping / self.period
        closed = np.zeros((size + 1, size + 1))
        closed[:size, :size] = A - np.outer(B, (stiffness + rate) * C)
        closed[:size, size] = rate * B
        closed[size, :size] = C
        return bool(np.abs(np.linalg.eigvals(closed)).max() < 1.0)

    def limit_of_walls(self) -> float:
        """Return K_max of the true device, computed by zwidth."""
        modes = [zwidth.Mode(*mode) for mode in self.modes]
        actuator = zwidth.Actuator(time_constant=self.lag) if self.lag else None
        device = zwidth.Device(self.mass, self.damping, actuator=actuator, modes=modes)
        maximum = zwidth.Scene(device, zwidth.Timing(self.period, self.delay)).max_stiffness()
        return float(maximum.stiffness) if maximum.status == 0 else 0.0


def draw_hidden(seed: int) -> tuple[TrueDevice, np.ndarray, np.ndarray]:
    """Return a device with actuator lag, resonances or both, a force on it, and the readings of a coarse encoder."""
    rng = np.random.default_rng([52, seed])
    mass = float(10 ** rng.uniform(-1.5, 0.0))
    kind = ("amplifier", "one resonance", "amplifier and resonance", "two resonances")[rng.integers(4)]
    count = {"amplifier": 0, "two resonances": 2}.get(kind, 1)
    modes = tuple(
        (
            float(10 ** rng.uniform(1.5, 2.6)),
            float(10 ** rng.uniform(np.log10(0.005), -1.0)),
            float(mass * 10 ** rng.uniform(0.0, 1.5)) * (-1.0 if rng.random() < 0.3 else 1.0),
        )
        for _ in range(count)
    )
    lag = float(10 ** rng.uniform(-4.3, -3.0)) if "amplifier" in kind else 0.0
    damping, delay = float(mass * 10 ** rng.uniform(0.0, 2.0)), float(rng.uniform(0.0, 3e-3))
    encoder, limit = float(10 ** rng.uniform(-4.7, -3.3)), float(mass * 10 ** rng.uniform(0.5, 1.5))
    true = TrueDevice(kind, mass, damping, lag, modes, delay, 1e-3, encoder, limit)
    size, hold = int(rng.choice([800, 1500])), int(rng.integers(8, 60))
    force = limit * np.repeat(rng.choice([-1.0, 1.0], -(-size // hold)), hold)[:size]
    exact = true.play(force, read=False)
    return true, force, encoder * np.round(exact / encoder + 0.2 * rng.standard_normal(size))


MASS = 0.1  # kg
DAMPING = 1.0  # N s/m
DELAY = 1.5e-3  # s
PERIOD = 1e-3  # s
STRONGEST = 3.0  # N, largest force


@dataclass(frozen=True)
class OtherDevice(TrueDevice):
    """A device of 100 g and 1 N s/m given by other matrices."""

    plant: Any = None

    @classmethod
    def of(cls, plant: Any, step: float = 1e-5) -> OtherDevice:
        return cls("", MASS, DAMPING, 0.0, (), DELAY, PERIOD, step, STRONGEST, plant)

    def matrices(self) -> tuple[Any, Any, Any]:
        return self.plant

    def limit_of_walls(self) -> float:
        scene = zwidth.Scene(zwidth.LinearDevice(self.plant), zwidth.Timing(self.period, self.delay))
        return float(scene.max_stiffness().stiffness)

    def record(self, rng: np.random.Generator, count: int = 2000, hold: int = 25) -> tuple[np.ndarray, np.ndarray]:
        """Return a random square-wave force and the readings of an encoder with noise."""
        force = self.limit * np.repeat(rng.choice([-1.0, 1.0], -(-count // hold)), hold)[:count]
        exact = self.play(force, read=False)
        return force, self.encoder * np.round(exact / self.encoder + 0.3 * rng.standard_normal(count))


def couple(stiffness: float, tip: float, damping: float, sensor: int) -> Any:
    """Return two coupled bodies of 100 g in total; force and damping to ground on the first, the sensor on either."""
    masses = np.array([MASS - tip, tip])
    coupling_matrix = np.array([[-1.0, 1.0], [1.0, -1.0]]) / masses[:, None]
    damping_matrix = damping * coupling_matrix - np.diag([DAMPING / masses[0], 0.0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [stiffness * coupling_matrix, damping_matrix]])
    return A, np.array([0.0, 0.0, 1.0 / masses[0], 0.0]), np.eye(4)[sensor]


def add_mode(plant: Any, frequency: float, ratio: float, mass_ratio: float) -> Any:
    """Return the plant with a parallel mode of the given mass ratio, which is negative with opposite phase at
    the sensor.
    """
    A, B, C = plant
    w = 2 * np.pi * frequency
    mode_matrix = np.array([[0, 1], [-w * w, -2 * ratio * w]])
    return block_diag(A, mode_matrix), np.array([*B, 0.0, 1 / MASS]), np.array([*C, mass_ratio, 0.0])


def add_lag(plant: Any, den: tuple[float, ...]) -> Any:
    """Return the plant with an amplifier ``1 / (den[0] s^n + ... + 1)`` in series."""
    A, B, C = plant
    size, order = len(A), len(den) - 1
    lag = np.eye(order, k=1)
    lag[-1] = -np.array(den[:0:-1]) / den[0]
    combined = np.block([[A, np.outer(B, np.eye(order)[0])], [np.zeros((order, size)), lag]])
    return combined, np.eye(size + order)[-1] / den[0], np.array([*C, *np.zeros(order)])


def _loop(hertz: float) -> tuple[float, float, float]:
    w = 2 * np.pi * hertz
    return w**-2, 1.4 / w, 1.0


def _couple(hertz: float, sensor: int) -> Any:
    """Return a compliance with two thirds of the mass at the tip."""
    tip = 2 / 3 * MASS
    reduced_mass = tip * (MASS - tip) / MASS
    w = 2 * np.pi * hertz
    return couple(reduced_mass * w**2, tip, 2 * 0.03 * w * reduced_mass, sensor)


RIGID = np.array([[0.0, 1.0], [0.0, -DAMPING / MASS]]), np.array([0.0, 1 / MASS]), np.array([1.0, 0.0])
OTHERS = {
    **{f"amplifier, lag of {lag} ms": add_lag(RIGID, (1e-3 * lag, 1.0)) for lag in (0.1, 0.3, 1, 2)},
    **{f"current loop of {hertz} Hz": add_lag(RIGID, _loop(hertz)) for hertz in (500, 150)},
    **{f"compliance of {hertz} Hz, encoder at the motor": _couple(hertz, 0) for hertz in (50, 100, 200, 300)},
    **{f"compliance of {hertz} Hz, encoder at the load": _couple(hertz, 1) for hertz in (100, 300)},
    "two resonances": add_mode(add_mode(RIGID, 60, 0.03, 0.3), 150, 0.03, 0.3),
    "lag and resonance": add_lag(add_mode(RIGID, 200, 0.03, 0.4), (1e-3, 1.0)),
}


class Trial(NamedTuple):
    """Results of two measurements of one device: the first without prior knowledge, the second designed from it."""

    device: TrueDevice
    limit: float  # K_max of the true device, N/m
    stable: tuple[bool | None, ...]  # of each safe wall, on the true device; None without a wall
    share: tuple[float, ...]  # safe stiffness relative to the limit
    promised: float  # stiffness expected for the second measurement, relative to the limit
    outside: float  # fraction of frequencies whose true response is outside of the band


def measure(seed: int) -> Trial:
    """Draw a device, measure it twice as designed by `zwidth.excite`, and check the safe walls on the true device."""
    true, period = TrueDevice.draw(np.random.default_rng(seed)), 1e-3
    limit, response, promised = true.limit_of_walls(), None, 0.0
    stable, share, outside = [], [], []
    A, B, C = true.sampled()
    for repetition in range(2):
        record = zwidth.excite(
            period=period,
            force=true.limit,
            resolution=true.encoder,
            duration=DURATION,
            response=response,
            seed=seed + repetition,
        )
        response = zwidth.respond(period, true.play(record.force), record.force).device
        safe = zwidth.Scene(response, zwidth.Timing(period)).max_stiffness()
        has_wall = safe.status == zwidth.Status.OK
        stable.append(true.is_stable(safe.stiffness, safe.virtual_damping) if has_wall else None)
        share.append(float(safe.stiffness) / limit if has_wall else 0.0)
        promised = float(record.expected.stiffness) / limit if record.expected is not None else 0.0
        z = np.exp(2j * np.pi * response.frequency * period)
        exact = np.array([C @ np.linalg.solve(root * np.eye(B.size) - A, B) for root in z])
        outside.append(np.abs(response.response - exact) > response.deviation)
    return Trial(true, limit, tuple(stable), tuple(share), promised, float(np.concatenate(outside).mean()))
