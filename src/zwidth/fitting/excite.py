"""A force to play from which `zwidth.respond` finds a response: sines, dense and strong where walls are decided.

The record has five stretches of three equal periods, each with other phases: the first period of each dies away, and
what the stretches leave of one another is the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from zwidth.fitting.respond import SURE, find_nominal_limit
from zwidth.parts.checks import check_number, find_kind
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Velocity
from zwidth.scenes.measured_loop import MeasuredLoop
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import StiffestWall
from zwidth.words.errors import InputError
from zwidth.words.files import write_whole
from zwidth.words.quantities import POSITIVE
from zwidth.words.status import Status
from zwidth.words.unit_system import SYSTEMS, UnitSystem

# Stretches of other phases, and periods of each.
_STRETCHES, _PERIODS = 5, 3
# Lines lie so far apart, as a share of their frequency, where nothing is known; and up to this share of half the rate.
_SPACING, _HIGHEST = 0.006, 0.98
# The lowest line, in Hz, and as lines of a period at least.
_LOWEST, _FIRST = 1.0, 3
# Below this frequency, in Hz, less force keeps the motion within reach.
_SOFT = 20.0
# What share of the distance to the edge the gap between lines may take, and the weakest line of the strongest.
_GAP, _WEAKEST = 0.03, 0.01
# The walls for which the second record is made, of the stiffest.
_SHARES = np.linspace(0.3, 0.9, 7)
# Steps towards a small peak, and where each cuts, of the peak.
_CLIPS, _CUT = 60, 0.75
_FEWEST_SAMPLES = 600


@dataclass(frozen=True)
class Excitation:
    """A force to play, sample by sample, and what it will tell.

    For a rotary device, forces are torques in N m, and rad replaces m.

    Attributes:
        force: in N, one number a sample.
        period: of the samples, in s.
        cycle: after which the force repeats within a stretch, in s.
        frequency, amplitude: of its lines, in Hz and N.
        deviation: expected of each line, in m/N.
        expected: with a response to start from: the safe wall that the record should tell, a `StiffestWall`.
        limit: with a response: the stiffest wall of that response itself.
    """

    force: np.ndarray
    period: float
    cycle: float
    frequency: np.ndarray
    amplitude: np.ndarray
    deviation: np.ndarray
    expected: StiffestWall | None
    limit: StiffestWall | None
    rotary: bool = False

    @property
    def unit_system(self) -> UnitSystem:
        """The units of the force and of the device."""
        return SYSTEMS[self.rotary]

    def save(self, file: str | Path) -> None:
        """Write a CSV file with a row per sample: the time in s, and the force in N or the torque in N m."""
        rows = [f"{k * self.period:.9g},{value:.7g}" for k, value in enumerate(self.force.tolist())]
        write_whole(
            Path(file),
            ("\n".join([f"time [s],{'torque [N m]' if self.rotary else 'force [N]'}", *rows]) + "\n").encode(),
        )


def excite(
    *,
    period: Any,
    force: Any,
    resolution: Any,
    duration: Any = 60.0,
    response: MeasuredDevice | None = None,
    velocity: Velocity | None = None,
    seed: int = 0,
    rotary: bool | None = None,
) -> Excitation:
    """Design the force to play for `zwidth.respond`.

    Args:
        period: of the controller, in s.
        force: the largest to command, in N.
        resolution: step of the encoder, in m: what the expected deviation rests on.
        duration: of the whole record, in s.
        response: of a first record; then lines are dense where it turns, and strong where a wall next to the stiffest
            is nearly unstable. Without it all lines from 1 Hz to nearly half the rate are equally strong.
        velocity: the velocity estimate of the walls that are meant; the backward difference by default.
        seed: of the phases.
        rotary: True if the force is a torque in N m and the resolution an angle in rad. By default, the response or
            the units of force and resolution decide; numbers without units are those of a linear device.

    Returns:
        Excitation: ``force`` to play at every period, ``cycle``, the lines with the ``deviation`` to expect, and with a
        response ``expected``, the safe wall that the record should tell, and ``limit``, K_max of that response.

    Raises:
        InputError: the record is too short for the rate, or a number is out of range.

    Numerics:
        Encoder errors are taken as white, of variance ``resolution^2/12``. Phases are chosen so that peaks stay small:
        by clipping and restoring the amplitudes again and again (van der Ouderaa, Schoukens, Renneboog 1988).

    References:
        Pintelon, Schoukens 2012, section 5.3. Van der Ouderaa et al. 1988, IEEE Trans. Instrum. Meas. 37:145-147.

    Example:
        >>> import zwidth
        >>> record = zwidth.excite(period=1e-3, force=3.0, resolution=1e-5, duration=30)
        >>> print(f"{record.force.size} samples, up to {abs(record.force).max():.1f} N, cycle {record.cycle} s")
        30000 samples, up to 3.0 N, cycle 2.0 s
    """
    implied = find_kind({"force": force, "resolution": resolution, "response": response})
    if rotary is not None and implied not in (None, rotary):
        kind = "rotary" if implied else "linear"
        raise InputError(
            f"rotary: got {rotary}, but force, resolution or response belong to a {kind} device; omit rotary"
        )
    system = SYSTEMS[bool(implied or rotary)]
    return _design(period, force, resolution, duration, response, velocity, seed, system)


def _design(
    period: Any,
    force: Any,
    resolution: Any,
    duration: Any,
    response: MeasuredDevice | None,
    velocity: Velocity | None,
    seed: int,
    system: UnitSystem,
) -> Excitation:
    """Design the force as in `excite`, in a unit system."""
    period, most = check_number("period", period), check_number("force", force, system["N"], POSITIVE)
    step, length = (
        check_number("resolution", resolution, system["m"]),
        check_number("duration", duration, "s", POSITIVE),
    )
    count = int(length / period / (_STRETCHES * _PERIODS)) // 2 * 2
    if count < _FEWEST_SAMPLES:
        needed = _FEWEST_SAMPLES * _STRETCHES * _PERIODS * period
        raise InputError(f"duration: got {length:g} s, too short at this rate; at least {needed:.3g} s are needed")
    velocity = BackwardDifference() if velocity is None else velocity
    scene = None if response is None else Scene(response, Timing(period), velocity=velocity)
    limit = None if scene is None else find_nominal_limit(scene)
    if scene is None or limit is None or limit.status != Status.OK:
        lines = _lay_lines(count, period, np.full(count // 2, _SPACING))
        shape = np.minimum(1.0, lines / (count * period) / _SOFT)
    else:
        lines, shape = _lay_second(scene, limit, count)
    rng = np.random.default_rng(seed)
    stretches = [_make_period(lines, shape, count, rng) for _ in range(_STRETCHES)]
    scale = most / max(float(np.abs(one).max()) for one in stretches)
    played = scale * np.concatenate([np.tile(one, _PERIODS) for one in stretches])
    amplitude = scale * shape
    # A mean of n samples has noise of 2 sigma/sqrt(n) at a line; equal periods meet the same steps of the encoder.
    deviation = SURE * step / np.sqrt(12.0) * 2.0 / np.sqrt(_STRETCHES * count) / amplitude
    hertz, expected = lines / (count * period), None
    if scene is not None and response is not None:
        answer = _answer_at(scene, 2.0 * np.pi * lines / count)[0]
        predicted = MeasuredDevice(hertz, answer, deviation, system.rotary)
        expected = Scene(predicted, scene.timing, velocity=velocity).max_stiffness()
    return Excitation(played, period, count * period, hertz, amplitude, deviation, expected, limit, system.rotary)


def _lay_lines(count: int, period: float, spacing: np.ndarray) -> np.ndarray:
    """Whole numbers of turns a period; spacing is a share of the frequency, for each number."""
    line, lines = max(_FIRST, int(np.ceil(_LOWEST * count * period))), []
    while line < _HIGHEST * count / 2:
        lines.append(line)
        line += max(1, int(line * spacing[line]))
    return np.array(lines)


def _answer_at(scene: Scene, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The measured response between its lines in m/N, the velocity estimate, and the gap there in m/N."""
    c = cast("MeasuredLoop", scene.loop).walls.curve
    S, F = c.at(np.clip(w, c.w[0], c.w[-1]))
    unit = scene.units.stiffness * 4.0 * np.sin(0.5 * w) ** 2
    return S / unit, F, np.interp(w, c.w, np.maximum(c.gap - 0.5 * c.band, 0.0)) / unit


def _lay_second(scene: Scene, limit: StiffestWall, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lines and amplitudes for walls near the stiffest: dense where gaps count, strong where the edge is near."""
    period, units = scene.timing.period, scene.units
    all_lines = np.arange(1, count // 2)
    answer, F, gap = _answer_at(scene, 2.0 * np.pi * all_lines / count)
    wall = limit.stiffness + limit.virtual_damping * units.stiffness / units.virtual_damping * F
    distance = np.min([np.abs(1.0 / (share * wall) + answer) for share in _SHARES], axis=0)
    spacing = _SPACING * np.minimum(1.0, np.sqrt(_GAP * distance / np.maximum(gap, 1e-300)))
    # Next to a sharp place lines are dense as well.
    spacing = np.minimum(spacing, np.minimum(np.roll(spacing, 1), np.roll(spacing, -1)) * 2.0)
    lines = _lay_lines(count, period, np.append(spacing[:1], spacing))
    shape = distance.min() / distance[lines - 1]
    return lines, np.maximum(shape / shape.max(), _WEAKEST)


def _make_period(lines: np.ndarray, shape: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """One period of a sum of sines with small peaks, begun where a mass that rests does not run away."""
    spectrum = np.zeros(count // 2 + 1, complex)
    phase = np.exp(2j * np.pi * rng.random(lines.size))
    for _ in range(_CLIPS):
        spectrum[lines] = 0.5 * count * shape * phase
        wave = np.fft.irfft(spectrum, count)
        most = _CUT * np.abs(wave).max()
        cut = np.fft.rfft(np.clip(wave, -most, most))[lines]
        phase = cut / np.abs(cut)
    spectrum[lines] = 0.5 * count * shape * phase
    wave = np.fft.irfft(spectrum, count)
    # A resting mass keeps its place on average where the periodic velocity passes 0.
    speed = np.cumsum(wave)
    return np.roll(wave, -1 - int(np.argmin(np.abs(speed - speed.mean()))))
