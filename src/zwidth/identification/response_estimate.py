"""Estimate a frequency response with its deviation from records of commanded force and sampled position.

A *stretch* is a part of a log that contains at least two equal successive periods of the force. A *record* is the mean
over the periods of one stretch; if there is only one stretch, each of its periods is a record. Let U be the spectrum of
the force of a record, and Y that of its position without drift. At each frequency of the force (a *line*), the response
is ``G = sum Y conj(U)/sum |U|^2``, with sums over the records. Its standard error is estimated from the residuals
Y - G U; it therefore contains the errors of encoder, friction and noise (Pintelon, Schoukens 2012). The *deviation* of
the response is a multiple of the standard error. A force that does not repeat is analyzed by spectra averaged over
overlapping segments (Welch 1967). w is the frequency in rad per sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from zwidth.analysis.measured_loop import MeasuredLoop
from zwidth.analysis.optimization import StiffestWall
from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.types import ArrayLike
from zwidth.identification.columns import LoggedMotion, check_period, join_logs
from zwidth.identification.friction_model import Recording
from zwidth.identification.recordings import find_runs, read_logs
from zwidth.model.checks import check_number
from zwidth.model.measured_device import MeasuredDevice
from zwidth.units.formatting import plain, with_unit
from zwidth.units.quantities import POSITIVE
from zwidth.units.unit_system import SYSTEMS, UnitSystem

# Deviation, in standard errors of the complex response: 4.5 standard errors of the real or of the imaginary part, each
# of which has half of the variance. With this factor, the true response is within the deviation at all of several
# thousand lines, with high probability.
SURE = 4.5 / np.sqrt(2.0)
# Constants of the analysis of periodic forces.
# Largest difference between forces one period apart that count as equal, relative to the range of the force.
_SAME = 1e-5
_EXCITED = 1e-3  # least amplitude of the force at a line that is used, relative to the largest amplitude
_SHORTEST = 16  # least number of samples per period, and least number of usable lines of a force that does not repeat
_REPEATED = 0.3  # share of the samples of a log that must repeat for a period of the force to be accepted
# The squared standard error is smoothed by two running means over the lines, and the larger mean is used.
_NARROW = 4  # half-width of the first running mean, in lines
_WIDE = 24  # half-width of the second running mean, in lines
# Constants of the analysis of forces that do not repeat.
_PIECES = 8  # least number of segments over which spectra are averaged
_LONGEST = 1 << 13  # largest number of samples per segment
_COHERENT = 0.1  # least coherence at a line that bounds the range of usable lines
_OVERLAP = 1.06  # variance for half-overlapping Hann windows, relative to that for the same number of independent ones
_STEPS = 20  # range of the positions, in encoder steps, below which a warning is issued
_FILLED = 0.002  # share of missing samples up to which they are interpolated; more are refused
_LONGEST_GAP = 4  # longest time between two samples that is interpolated, in sampling periods


@dataclass(frozen=True)
class ResponseEstimate:
    """A measured frequency response, with quantities that describe its quality.

    Attributes:
        device: the response with its deviation, a `zwidth.MeasuredDevice`.
        period: sampling period in s.
        coherence: proportion of the power of the motion that is linearly related to the force, 0 to 1, per frequency.
        cycle: period of the force in s; None for a force that is not periodic.
        records: number of stretches of periodic force, or number of segments of a force that is not periodic.
        noise: standard deviation of a sampled position in m, for a periodic force.
        warnings: sentences about questionable measurements.
        notes: interpretations of the columns of the logs and repairs of their rows, one clause each.
    """

    device: MeasuredDevice
    period: float
    coherence: np.ndarray
    cycle: float | None
    records: int
    noise: float
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()


def respond(
    time: ArrayLike,
    position: ArrayLike,
    force: ArrayLike,
    *,
    cycle: Any = None,
    resolution: Any = None,
    rotary: bool = False,
) -> ResponseEstimate:
    """Estimate the frequency response of a device, with its deviation, from commanded forces and sampled positions.

    Args:
        time: times of the samples in s, evenly spaced, or only the sampling period. For several logs, time, position
            and force are lists of arrays.
        position: sampled positions in m.
        force: forces in N commanded at the same samples, such as those of `zwidth.excite`.
        cycle: period of the force in s; by default determined from a force that repeats exactly.
        resolution: encoder step in m; by default determined from the positions.
        rotary: True if the position is an angle in rad and the force a torque in N m. The response is then in
            rad/(N m).

    Returns:
        ResponseEstimate: ``device``, with a deviation of 4.5 standard errors; ``period``, ``coherence``, ``cycle``,
        ``records``, ``noise``, ``warnings``.

    Raises:
        InputError: times are uneven, force or position never changes, or the motion does not follow the force.

    Numerics:
        The first period of each stretch is omitted, because it contains the transient. Standard errors are computed
        from the differences between stretches or, with a single stretch, between its periods, and averaged over
        neighboring frequencies. If the same force repeats, each period has the same encoder errors, which the
        differences do not show; therefore the full quantization error is added.

    References:
        Pintelon, Schoukens 2012, sections 2.5 and 4.3 (averages over periods and phases). Welch 1967, IEEE Trans. Audio
            Electroacoustics 15:70-73.

    Example:
        >>> import zwidth
        >>> record = zwidth.excite(period=1e-3, force=2.0, resolution=1e-5, duration=15)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 5), zwidth.Timing(period=1e-3))
        >>> motion = zwidth.simulate(scene, 0.0, 0.0, external_force_history=record.force, periods=record.force.size)
        >>> estimate = zwidth.respond(1e-3, motion.position[: record.force.size], record.force)
        >>> f"{estimate.device.frequency.size} lines from {estimate.records} stretches"
        '409 lines from 5 stretches'
    """
    estimate = _respond(time, position, force, cycle, resolution, SYSTEMS[rotary])
    return replace(estimate, device=replace(estimate.device, rotary=rotary))


def _respond(
    time: ArrayLike, position: ArrayLike, force: ArrayLike, cycle: Any, resolution: Any, system: UnitSystem
) -> ResponseEstimate:
    """Estimate the frequency response, for arguments in the given unit system."""
    read = read_logs(time, position, force, system, resolution=resolution)
    period, notes = read.period, list(read.notes)
    logs = tuple(_fill(log, place, k, notes) for k, (log, place) in enumerate(zip(*read[:2], strict=True), start=1))
    step = min(encoder for encoder, _ in read.steps)
    step = step if resolution is None else check_number("resolution", resolution, system["m"])
    given = None if cycle is None else int(np.round(check_number("cycle", cycle, "s", POSITIVE) / period))
    warnings = []
    if step and all(np.ptp(log.position) < _STEPS * step for log in logs):
        warnings.append(
            f"the position moves by less than {_STEPS} encoder steps of {with_unit(step, system['m'])}; record with a "
            "larger force"
        )
    count = given or _find_period(logs[0].force)
    if count is None:
        return replace(_average_segments(logs, period, warnings), notes=tuple(notes))
    stretches = [part for log in logs for part in _split_stretches(log, count, given is not None)]
    if not stretches:
        raise InputError(
            f"cycle: no stretch of the force repeats after {count} samples; leave the cycle out, or record two periods "
            "or more of each force"
        )
    return replace(_average_periods(stretches, count, period, step, warnings), notes=tuple(notes))


def _fill(log: Recording, place: np.ndarray, number: int, notes: list[str]) -> Recording:
    """Return a log with its missing samples interpolated; raise `InputError` if too many samples are missing.

    Args:
        log: the log, whose arrays do not contain the missing samples.
        place: time of each sample, in sampling periods after the first one.
        number: number of the log, for messages.
        notes: list to which a note on the interpolated samples is appended.

    Raises:
        InputError: more than a share ``_FILLED`` of the samples is missing, or a gap is too long.
    """
    missing = int(place[-1]) + 1 - place.size
    if not missing:
        return log
    if missing > _FILLED * place.size or np.diff(place).max() > _LONGEST_GAP:
        gap = int(np.argmax(np.diff(place)))
        raise InputError(
            f"time: {missing} samples of log {number} are missing, most of them after sample {gap}; record every "
            "sample, or pass the parts before and after the gap as two logs"
        )
    every = np.arange(place[-1] + 1)
    # Use the force of the previous sample for a missing sample, and interpolate the position by a cubic spline.
    force = log.force[np.searchsorted(place, every, side="right") - 1]
    from scipy.interpolate import CubicSpline

    notes.append(f"interpolated {missing} missing sample{'' if missing == 1 else 's'} of log {number}")
    return Recording(force, CubicSpline(place, log.position)(every), 0)


def respond_to_logs(motions: Sequence[LoggedMotion], period: float | None, cycle: Any = None) -> ResponseEstimate:
    """Estimate the response with `respond` from logs read from files, and add the notes on their columns."""
    estimate = respond(**join_logs(motions, period), cycle=cycle)
    check_period(period, estimate.period)
    notes = dict.fromkeys(note for motion in motions for note in motion.notes)
    return replace(estimate, notes=(*notes, *estimate.notes))


def find_nominal_limit(scene: Scene) -> StiffestWall:
    """Return the stiffest stable wall of a scene for its measured response alone, with the deviation set to 0."""
    nominal, loop = replace(scene), cast("MeasuredLoop", scene.loop)
    vars(nominal)["loop"] = loop.nominal
    return nominal.max_stiffness()


def _find_period(force: np.ndarray) -> int | None:
    """Detect the period of the force in samples from the peaks of its autocorrelation; None if it does not repeat."""
    centered, size = force - force.mean(), 1 << int(np.ceil(np.log2(2 * force.size)))
    spectrum = np.fft.rfft(centered, size)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, size)[: force.size // 2 + 1]
    lags = np.flatnonzero((correlation[1:-1] > correlation[:-2]) & (correlation[1:-1] >= correlation[2:])) + 1
    lags = lags[lags >= _SHORTEST]
    highest = np.sort(lags[np.argsort(-correlation[lags])][:20])
    for lag in highest.tolist():
        if sum(last - first for first, last in _find_repeats(force, lag)) > _REPEATED * force.size:
            return lag
    return None


def _find_repeats(force: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Find the stretches of the force in which a period of ``count`` samples occurs at least twice in succession.

    Returns:
        For each stretch the index of its first sample, and that of its last sample plus 1.
    """
    runs = find_runs(np.abs(force[count:] - force[:-count]) <= _SAME * np.ptp(force)).tolist()
    return [(first, last + count) for first, last in runs if last - first >= count]


def _split_stretches(log: Recording, count: int, trusted: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """Divide the stretches of a log into periods.

    Args:
        log: a log without gaps.
        count: samples per period.
        trusted: True if the user specified the period. If the force repeats nowhere exactly, the whole log is then
            treated as one stretch.

    Returns:
        For each stretch the forces and the positions, arrays of shape (periods, count).
    """
    runs = _find_repeats(log.force, count)
    if trusted and not runs and log.force.size >= 2 * count:
        # Accept a force that repeats only on average, because a controller that holds the device in place may add its
        # force to the periodic one.
        runs = [(0, log.force.size)]
    stretches = []
    for first, last in runs:
        first = last - (last - first) // count * count
        shape = (last - first) // count, count
        stretches.append((log.force[first:last].reshape(shape), log.position[first:last].reshape(shape)))
    return stretches


def _remove_drift(position: np.ndarray) -> np.ndarray:
    """Subtract the drift from the positions of a stretch, shape (periods, count), so that they become periodic.

    The drift is modeled as a parabola over time, fitted to the differences between the last three periods.
    """
    count = position.shape[1]
    steps = np.diff(position[-3:], axis=0).ravel()
    slope, start = np.polyfit(np.arange(steps.size), steps, 1).tolist()
    # Compute the coefficients a (``rise``) and b (``bend``) of the parabola a t + b t^2 from its increase over one
    # period P, which is a P + b (2 t P + P^2).
    bend = 0.5 * slope / count
    rise = (start - bend * count**2) / count
    t = np.arange(position.size) - (position.size - min(3, position.shape[0]) * count)
    return position - (rise * t + bend * t**2).reshape(position.shape)


def _average_periods(
    stretches: list[tuple[np.ndarray, np.ndarray]], count: int, period: float, step: float, warnings: list[str]
) -> ResponseEstimate:
    """Estimate the response from the periods of a periodic force.

    Args:
        stretches: force and position of each stretch, shape (periods, count).
        count: samples per period.
        period: sampling period in s.
        step: encoder step, 0 for none.
        warnings: list to which a warning is appended if there is only one record.
    """
    # Omit the first period of each stretch, because it contains the transient.
    kept = [(force[1:], _remove_drift(position)[1:]) for force, position in stretches]
    several = len(kept) > 1
    # Use the mean of each stretch as a record; if there is only one stretch, use each of its periods.
    parts = [(f.mean(0), x.mean(0)) for f, x in kept] if several else list(zip(*kept[0], strict=True))
    U, Y = (np.fft.rfft(np.array([part[k] for part in parts]))[:, 1 : (count + 1) // 2] for k in (0, 1))
    power = (np.abs(U) ** 2).sum(0)
    lines = np.flatnonzero(power > _EXCITED**2 * power.max())
    U, Y, power = U[:, lines], Y[:, lines], power[lines]
    G = (Y * U.conj()).sum(0) / power
    records, residuals = len(parts), Y - G * U
    error = (np.abs(residuals) ** 2).sum(0) / max(1, records - 1)
    error = np.maximum(*(_smooth(error, size) for size in (_NARROW, _WIDE)))
    if records == 1:
        warnings.append("only one period follows the first one, so the errors cannot be estimated; record more periods")
    if not several:
        # Add the quantization error, because it is equal in equal periods: the residuals do not contain it, and
        # averaging does not reduce it.
        error = error + records * count * step**2 / 12.0
    deviation = SURE * np.sqrt(error / power)
    total = (np.abs(Y) ** 2).sum(0)
    coherence = 1.0 - np.minimum(1.0, (np.abs(residuals) ** 2).sum(0) / np.maximum(total, 1e-300))
    device = MeasuredDevice((lines + 1) / (count * period), G, deviation)
    each = float(np.mean([len(f) for f, _ in kept])) if several else 1.0
    noise = float(np.sqrt(np.median(error) * each / count))
    _refuse_unmoved(device)
    return ResponseEstimate(device, period, coherence, count * period, len(kept), noise, tuple(warnings))


def _smooth(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the running mean of each value and its ``reach`` neighbors on each side; fewer neighbors at the ends."""
    window = np.ones(2 * reach + 1)
    total, count = (np.convolve(each, window)[reach : reach + values.size] for each in (values, np.ones(values.size)))
    return total / count


def _average_segments(logs: tuple[Recording, ...], period: float, warnings: list[str]) -> ResponseEstimate:
    """Estimate the response to a force that does not repeat, from spectra averaged over segments.

    The spectra of the differences of successive positions are used, because positions drift.

    Args:
        logs: logs without gaps.
        period: sampling period in s.
        warnings: list to which a warning about the frequency resolution is appended.
    """
    from scipy.signal import csd, welch

    least = min(log.force.size for log in logs)
    size = min(_LONGEST, 1 << int(np.log2(max(2, 2 * least // (_PIECES + 1)))))
    if size < 4 * _SHORTEST:
        raise InputError(f"force: {least} samples that do not repeat are too few; record {_PIECES * 256} or more")
    options: dict[str, Any] = {"fs": 1.0, "nperseg": size, "detrend": "linear"}
    sums = [np.zeros(size // 2 + 1, complex) for _ in range(3)]
    pieces = 0
    for log in logs:
        # Use the differences of successive positions. Omit the force of the first sample, because no previous position
        # exists for it.
        f, x = log.force[1:], np.diff(log.position)
        segments = 2 * f.size // size - 1
        pieces += segments
        sums[0] += segments * welch(f, **options)[1]
        sums[1] += segments * welch(x, **options)[1]
        sums[2] += segments * csd(f, x, **options)[1]
    forces, steps, both = (values[2:-1] for values in sums)
    coherence = np.abs(both) ** 2 / np.maximum(np.real(forces * steps), 1e-300)
    w = 2.0 * np.pi * np.arange(2, size // 2) / size
    G = both / forces / (1.0 - np.exp(-1j * w))
    error = np.abs(G) * np.sqrt((1.0 - np.minimum(coherence, 1.0)) / np.maximum(coherence, 1e-300) * _OVERLAP / pieces)
    # Add the bias that the window causes, because it averages the response over neighboring lines. This bias is
    # proportional to the second difference of u G, the response of the acceleration, with u = |1 - e^(-jw)|^2.
    u = 4.0 * np.sin(0.5 * w) ** 2
    bend = np.abs(np.diff(u * G, 2))
    deviation = SURE * error + np.pad(bend, 1, mode="edge") / u
    usable = np.flatnonzero(np.real(coherence) > _COHERENT)
    if usable.size < _SHORTEST:
        raise InputError("force: the position does not follow it; check that both columns belong to one axis")
    usable = slice(usable[0], usable[-1] + 1)
    warnings.append(
        f"the force does not repeat, so {pieces} segments of {with_unit(size * period, 's')} are averaged, with a "
        f"resolution of {plain(2.0 / (size * period), 2)} Hz; record a force of zwidth.excite for a finer one"
    )
    device = MeasuredDevice(w[usable] / (2.0 * np.pi * period), G[usable], deviation[usable])
    _refuse_unmoved(device)
    return ResponseEstimate(device, period, np.real(coherence[usable]), None, pieces, float("nan"), tuple(warnings))


def _refuse_unmoved(device: MeasuredDevice) -> None:
    """Raise `InputError` if the response is smaller than its deviation at all frequencies."""
    if np.all(np.abs(device.response) <= device.deviation):
        raise InputError(
            "force: its effect on the position is below the errors at all frequencies; check that both columns belong "
            "to one axis, use a larger force, or record longer"
        )
