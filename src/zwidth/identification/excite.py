"""Design a multisine force with which `zwidth.respond` can measure the frequency response of a device.

At frequencies at which the response decides the stability of walls, the frequencies are dense and the amplitudes large.
The record consists of five *stretches*, whose sines have different phases. A stretch is three equal periods of the
force, the first of which contains the transient. The standard errors of the response are computed from the differences
between the stretches. The *lines* are the frequencies of the sines, each an integer number of cycles per period of the
force.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from zwidth.analysis.measured_loop import MeasuredLoop
from zwidth.analysis.optimization import StiffestWall
from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.response_estimate import SURE, find_nominal_limit
from zwidth.io.files import write_atomically
from zwidth.model.checks import check_number, find_kind
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.timing import Timing
from zwidth.model.velocity import BackwardDifference, Velocity
from zwidth.units.quantities import POSITIVE
from zwidth.units.unit_system import SYSTEMS, UnitSystem

_STRETCHES = 5  # number of stretches in the record
_PERIODS = 3  # number of periods of the force per stretch
# Frequency grid of the force.
_SPACING = 0.006  # distance of neighboring frequencies relative to the frequency, if no response is given
_HIGHEST = 0.98  # highest frequency of the force, relative to the Nyquist frequency
_LOWEST = 1.0  # Hz; lowest frequency of the force
_FIRST = 3  # least value of the lowest frequency, in cycles per period of the force
_SOFT = 20.0  # Hz; below this frequency the amplitudes decrease in proportion to the frequency, to limit the motion
# Constants of the design of a second record, which uses the response measured with a first record.
# Largest accepted error of the response interpolated between two frequencies, relative to the distance of the response
# from the value at which a wall becomes unstable.
_GAP = 0.03
_WEAKEST = 0.01  # smallest amplitude of a sine, relative to the largest
# Stiffnesses of the walls whose stability the record is designed to decide, relative to the stiffest wall.
_SHARES = np.linspace(0.3, 0.9, 7)
# Constants of the reduction of the peaks of the force by repeated clipping.
_CLIPS = 60  # number of iterations
_CUT = 0.75  # clipping level, relative to the peak of the force
_FEWEST_SAMPLES = 600  # least number of samples per period of the force


@dataclass(frozen=True)
class Excitation:
    """A designed multisine force, and the expected accuracy of a frequency response measured with it.

    For a rotary device, forces are torques in N m, and rad replaces m.

    Attributes:
        force: force in N at each sample.
        period: sampling period in s.
        cycle: period of the force within a stretch, in s.
        frequency, amplitude: frequencies in Hz and amplitudes in N of the sines.
        deviation: expected deviation (`zwidth.MeasuredDevice`) of the response at each frequency, in m/N.
        expected: safe wall that this record is expected to yield, a `StiffestWall`; None if no response is given.
        limit: stiffest stable wall for the given response; None if no response is given.
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
        """The unit system: N and m for a linear device, N m and rad for a rotary one."""
        return SYSTEMS[self.rotary]

    def save(self, file: str | Path) -> None:
        """Write the force to a CSV file, one row per sample with the time in s and the force in N or torque in N m."""
        rows = [f"{k * self.period:.9g},{value:.7g}" for k, value in enumerate(self.force.tolist())]
        write_atomically(
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
    """Design a multisine force with which `zwidth.respond` can measure the frequency response of a device.

    Args:
        period: sampling period of the controller in s.
        force: largest force to command, in N.
        resolution: encoder step in m, from which the expected deviation is computed.
        duration: duration of the whole record in s.
        response: response measured with a first record. The frequencies are then dense where the response changes
            fast, and the amplitudes large where walls close to the stiffest are nearly unstable. By default, the
            frequencies extend from 1 Hz to almost the Nyquist frequency, with equal amplitudes from 20 Hz on.
        velocity: velocity estimate of the intended walls; the backward difference by default.
        seed: seed of the random phases.
        rotary: True if the force is a torque in N m and the resolution an angle in rad. By default, the response or
            the units of force and resolution decide; numbers without units are those of a linear device.

    Returns:
        Excitation: ``force`` at each sample, its ``cycle``, and the frequencies with the expected ``deviation``; if a
        response is given, also ``expected``, the expected safe wall, and ``limit``, its stiffest wall.

    Raises:
        InputError: the record is too short for the sampling rate, or a number is out of range.

    Numerics:
        Encoder errors are modeled as white noise of variance ``resolution^2/12``. The phases are optimized for small
        peaks, by repeated clipping and restoring of the amplitudes (van der Ouderaa, Schoukens, Renneboog 1988).

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
    """Design the multisine force, for arguments in the given unit system."""
    period, most = check_number("period", period), check_number("force", force, system["N"], POSITIVE)
    step, length = (
        check_number("resolution", resolution, system["m"]),
        check_number("duration", duration, "s", POSITIVE),
    )
    count = int(length / period / (_STRETCHES * _PERIODS)) // 2 * 2
    if count < _FEWEST_SAMPLES:
        needed = _FEWEST_SAMPLES * _STRETCHES * _PERIODS * period
        raise InputError(f"duration: got {length:g} s, too short at this sampling rate; give at least {needed:.3g} s")
    velocity = BackwardDifference() if velocity is None else velocity
    scene = None if response is None else Scene(response, Timing(period), velocity=velocity)
    limit = None if scene is None else find_nominal_limit(scene)
    if scene is None or limit is None or limit.status != Status.OK:
        lines = _build_frequency_grid(count, period, np.full(count // 2, _SPACING))
        shape = np.minimum(1.0, lines / (count * period) / _SOFT)
    else:
        lines, shape = _design_second(scene, limit, count)
    rng = np.random.default_rng(seed)
    stretches = [_make_period(lines, shape, count, rng) for _ in range(_STRETCHES)]
    scale = most / max(float(np.abs(stretch).max()) for stretch in stretches)
    commanded = scale * np.concatenate([np.tile(stretch, _PERIODS) for stretch in stretches])
    amplitude = scale * shape
    # White noise of standard deviation sigma in n samples has the amplitude 2 sigma/sqrt(n) at a line. Let n count only
    # one of the equal periods of each stretch, because their quantization errors are equal, so that averaging does not
    # reduce them.
    deviation = SURE * step / np.sqrt(12.0) * 2.0 / np.sqrt(_STRETCHES * count) / amplitude
    hertz, expected = lines / (count * period), None
    if scene is not None and response is not None:
        curve = _interpolate_response(scene, 2.0 * np.pi * lines / count)[0]
        predicted = MeasuredDevice(hertz, curve, deviation, system.rotary)
        expected = Scene(predicted, scene.timing, velocity=velocity).max_stiffness()
    return Excitation(commanded, period, count * period, hertz, amplitude, deviation, expected, limit, system.rotary)


def _build_frequency_grid(count: int, period: float, spacing: np.ndarray) -> np.ndarray:
    """Return lines with the given relative spacing, as integer numbers of cycles per period of the force.

    Args:
        count: number of samples per period of the force.
        period: sampling period in s.
        spacing: distance to the next line, relative to the line; one value for each possible line.
    """
    line, lines = max(_FIRST, int(np.ceil(_LOWEST * count * period))), []
    while line < _HIGHEST * count / 2:
        lines.append(line)
        line += max(1, int(line * spacing[line]))
    return np.array(lines)


def _interpolate_response(scene: Scene, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate the measured response of a scene to the frequencies ``w`` in rad per sample.

    Returns:
        The response in m/N, the velocity estimate F, and a bound of the interpolation error in m/N.
    """
    c = cast("MeasuredLoop", scene.loop).walls.curve
    S, F = c.evaluate(np.clip(w, c.w[0], c.w[-1]))
    unit = scene.units.stiffness * 4.0 * np.sin(0.5 * w) ** 2
    return S / unit, F, np.interp(w, c.w, np.maximum(c.gap - 0.5 * c.band, 0.0)) / unit


def _design_second(scene: Scene, limit: StiffestWall, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose the lines and amplitudes of a second record, to decide the stability of walls close to the stiffest one.

    Args:
        scene: scene with the response measured with the first record.
        limit: stiffest stable wall for this response.
        count: number of samples per period of the force.

    Returns:
        The lines in cycles per period of the force, and their amplitudes relative to the largest one.
    """
    period, units = scene.timing.period, scene.units
    all_lines = np.arange(1, count // 2)
    response, F, gap = _interpolate_response(scene, 2.0 * np.pi * all_lines / count)
    wall = limit.stiffness + limit.virtual_damping * units.stiffness / units.virtual_damping * F
    distance = np.min([np.abs(1.0 / (share * wall) + response) for share in _SHARES], axis=0)
    spacing = _SPACING * np.minimum(1.0, np.sqrt(_GAP * distance / np.maximum(gap, 1e-300)))
    # Limit the ratio of neighboring spacings to 2, so that the grid becomes dense before it reaches a narrow range
    # that requires small spacings.
    spacing = np.minimum(spacing, np.minimum(np.roll(spacing, 1), np.roll(spacing, -1)) * 2.0)
    lines = _build_frequency_grid(count, period, np.append(spacing[:1], spacing))
    shape = distance.min() / distance[lines - 1]
    return lines, np.maximum(shape / shape.max(), _WEAKEST)


def _make_period(lines: np.ndarray, shape: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Synthesize one period of a multisine force with small peaks, under which a mass initially at rest does not drift.

    Args:
        lines: frequencies in cycles per period.
        shape: amplitudes of the sines.
        count: number of samples per period.
        rng: random generator of the initial phases.
    """
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
    # Shift the start of the period to a sample at which the velocity in periodic motion is 0, because a mass that
    # starts there at rest does not drift.
    speed = np.cumsum(wave)
    return np.roll(wave, -1 - int(np.argmin(np.abs(speed - speed.mean()))))
