"""Random devices as matrices, played a force and read by an encoder: exact between samples, without zwidth.

Bodies, modes and the amplifier are one continuous system ``x' = A x + B u``, ``y = C x``; the force is held, limited
and late; the encoder reads whole steps. A wall closes the loop by eigenvalues of one matrix.
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
        """One of the four kinds."""
        kind = KINDS[rng.integers(4)]
        mass = float(10 ** rng.uniform(-1.5, 0.0))
        count = {"one resonance": 1, "two resonances": 2}.get(kind, 0)
        tops = np.sort(10 ** rng.uniform(1.5, 2.6, count))
        modes = tuple(
            (float(top), float(10 ** rng.uniform(np.log10(0.005), -1.0)), float(mass * 10 ** rng.uniform(0.0, 1.5)))
            for top in tops
        )
        # Beyond a node now and then.
        modes = tuple((f, z, m * (-1.0 if rng.random() < 0.3 else 1.0)) for f, z, m in modes)
        return cls(
            kind, mass, float(mass * 10 ** rng.uniform(0.5, 2.0)),
            float(10 ** rng.uniform(-4, -3)) if kind == "amplifier" or rng.random() < 0.3 else 0.0,
            modes, float(rng.uniform(0, 2e-3)), 1e-3, float(10 ** rng.uniform(-6, np.log10(4e-5))),
            float(mass * 10 ** rng.uniform(1.0, 1.6)),
        )  # fmt: skip

    def matrices(self) -> tuple[Any, Any, Any]:
        """A, B and C of the continuous system."""
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
        """The same with the forces on their way as states: one step a period."""
        A, B, C = self.matrices()
        size, periods = B.size, self.delay / self.period
        n = int(periods)
        f = periods - n

        def step(t: float) -> tuple[np.ndarray, np.ndarray]:
            whole = expm(np.block([[A, B[:, None]], [np.zeros((1, size + 1))]]) * t)
            return whole[:size, :size], whole[:size, size]

        late, new = step(self.period * (1 - f)), step(self.period * f)
        Ad = late[0] @ new[0]
        older, newer = late[0] @ new[1], late[1]
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
        """The positions while the force is played, as the encoder reads them or as they are."""
        A, B, C = self.sampled()
        given, x, out = np.clip(force, -self.limit, self.limit), np.zeros(B.size), np.empty(force.size)
        for k in range(force.size):
            out[k] = C @ x
            x = A @ x + B * given[k]
        return self.encoder * np.round(out / self.encoder) if read else out

    def is_stable(self, stiffness: float, virtual_damping: float) -> bool:
        """Whether a wall with the difference of two samples is stable: all eigenvalues inside the unit circle."""
        A, B, C = self.sampled()
        size, rate = B.size, virtual_damping / self.period
        closed = np.zeros((size + 1, size + 1))
        closed[:size, :size] = A - np.outer(B, (stiffness + rate) * C)
        closed[:size, size] = rate * B
        closed[size, :size] = C
        return bool(np.abs(np.linalg.eigvals(closed)).max() < 1.0)

    def limit_of_walls(self) -> float:
        """K_max of the true device, by zwidth of its parts."""
        modes = [zwidth.Mode(*mode) for mode in self.modes]
        actuator = zwidth.Actuator(time_constant=self.lag) if self.lag else None
        device = zwidth.Device(self.mass, self.damping, actuator=actuator, modes=modes)
        found = zwidth.Scene(device, zwidth.Timing(self.period, self.delay)).max_stiffness()
        return float(found.stiffness) if found.status == 0 else 0.0


class Trial(NamedTuple):
    """What two records of one device told of its walls: the first one blind, the second one made from it."""

    device: TrueDevice
    limit: float  # K_max of the true device, N/m
    stable: tuple[bool | None, ...]  # of each safe wall, on the true device; None where none was given
    share: tuple[float, ...]  # of the limit that each safe wall has
    promised: float  # share that the second record was said to tell
    outside: float  # share of all lines whose true response is outside of the band


def measure(seed: int) -> Trial:
    """Draw a device, play what `zwidth.excite` designs, twice, and judge the safe walls on the device itself."""
    true, period = TrueDevice.draw(np.random.default_rng(seed)), 1e-3
    limit, response, promised = true.limit_of_walls(), None, 0.0
    stable, share, outside = [], [], []
    A, B, C = true.sampled()
    for turn in range(2):
        record = zwidth.excite(
            period=period,
            force=true.limit,
            resolution=true.encoder,
            duration=DURATION,
            response=response,
            seed=seed + turn,
        )
        response = zwidth.respond(period, true.play(record.force), record.force).device
        safe = zwidth.Scene(response, zwidth.Timing(period)).max_stiffness()
        given = safe.status == zwidth.Status.OK
        stable.append(true.is_stable(safe.stiffness, safe.virtual_damping) if given else None)
        share.append(float(safe.stiffness) / limit if given else 0.0)
        promised = float(record.expected.stiffness) / limit if record.expected is not None else 0.0
        z = np.exp(2j * np.pi * response.frequency * period)
        exact = np.array([C @ np.linalg.solve(each * np.eye(B.size) - A, B) for each in z])
        outside.append(np.abs(response.response - exact) > response.deviation)
    return Trial(true, limit, tuple(stable), tuple(share), promised, float(np.concatenate(outside).mean()))
