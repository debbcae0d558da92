"""Test the repair of logs as control loops write them: the true device is recovered, or the log is rejected.

Reference: simulated knobs with known parameters.
"""

import numpy as np
import pytest
from click.testing import CliRunner
from loop_logs import make_knob, respond_from_rest

import zwidth
from zwidth.cli import cli
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.columns import fit_motions, read_log
from zwidth.identification.fit_report import summarize_fit
from zwidth.identification.repair import find_glitches, repair_log
from zwidth.units.unit_system import ROTARY

pytestmark = pytest.mark.usefixtures("fitted_once")
KNOB = make_knob(3)
ROWS = range(KNOB.reading.size)
TIME = KNOB.period * np.arange(KNOB.reading.size)


def format_file(head, cells, separator=","):
    """Return the text of a file with one line per sample."""
    return "\n".join([head, *(separator.join(row) for row in cells if row is not None)]) + "\n"


def rows(time, count, torque="{:.6f}"):
    return [[t, str(int(c)), torque.format(f)] for t, c, f in zip(time, count, KNOB.torque, strict=True)]


SECONDS = [f"{t:.6f}" for t in TIME]
WRAPPED = np.mod(KNOB.reading, KNOB.counts)
TIMER_START = 2**32 - 700_000
MICROS = [str((TIMER_START + round(1e6 * t)) % 2**32) for t in TIME]
STAMPS = [1_700_000_000_900_000_000 + round(1e9 * t) for t in TIME]
GLITCHES = {200: 0, 777: 16383, 1003: 40000}


def blank_counts(cells, rows_without_count):
    return [[t, "" if k in rows_without_count else c, f] for k, (t, c, f) in enumerate(cells)]


FILES = {
    "wrapped encoder": (
        format_file("t_s,enc_counts,tau_Nm", rows(SECONDS, WRAPPED)),
        "wraps at 6.28319 rad (360 deg, ",
    ),
    "wrapped around zero": (
        format_file("t_s,enc_counts,tau_Nm", rows(SECONDS, np.mod(KNOB.reading + 8192, KNOB.counts) - 8192)),
        "wraps at 6.28319 rad (360 deg, ",
    ),
    "timer overflow": (
        format_file(
            "micros,raw_angle,torque_mNm", [[t, c, f"{1e3 * float(f):.3f}"] for t, c, f in rows(MICROS, WRAPPED)]
        ),
        "the time rolls over (1 time) like a 32-bit counter of microseconds and was unwrapped",
    ),
    "seconds and nanoseconds": (
        format_file(
            "stamp.sec,stamp.nanosec,enc_counts,tau_Nm",
            [
                [str(s // 10**9), str(s % 10**9), c, f]
                for s, (_, c, f) in zip(STAMPS, rows(SECONDS, KNOB.reading), strict=True)
            ],
        ),
        "time 'stamp.sec' + 'stamp.nanosec'",
    ),
    "empty cells": (
        format_file("t_s,enc_counts,tau_Nm", blank_counts(rows(SECONDS, KNOB.reading), {100, 101, 900})),
        "left out 3 rows with missing numbers, the first is row 100",
    ),
    "repeated row": (
        format_file(
            "t_s,enc_counts,tau_Nm",
            [row for k, row in enumerate(rows(SECONDS, KNOB.reading)) for _ in range(1 + (k == 40))],
        ),
        "left out 1 repeated row, the first is row 41",
    ),
    "glitches": (
        format_file("t_s,enc_counts,tau_Nm", rows(SECONDS, [GLITCHES.get(k, c) for k, c in enumerate(KNOB.reading)])),
        "left out 3 position glitches, the first at sample 200",
    ),
    "outer join": (
        format_file(
            "__time,/imu/z,/joint/enc_counts,/cmd/effort_Nm",
            [
                cells
                for k, (_, c, f) in enumerate(rows(SECONDS, KNOB.reading))
                for cells in (
                    [f"{TIME[k]:.6f}", "", c, ""],
                    [f"{TIME[k] + 1e-4:.6f}", "9.81", "", ""],
                    [f"{TIME[k] + 2e-4:.6f}", "", "", f],
                )
            ],
        ),
        "position and force are in separate rows, 200 µs apart, and were paired by time",
    ),
    "durations with unit": (
        format_file("Time,enc_counts,tau_Nm", rows([f"{t:.6f} sec" for t in TIME], KNOB.reading)),
        "columns identified by their headers",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_true_device_is_recovered_from_repaired_logs(name, tmp_path):
    text, note = FILES[name]
    file = tmp_path / "log.csv"
    file.write_text(text)
    fit = fit_motions([read_log(file, {}, resolution=f"{KNOB.counts} counts/rev")])
    assert KNOB.holds(fit, 2.0)
    assert fit.status == Status.OK
    assert fit.warnings == ()
    assert any(note in each for each in fit.notes)


def test_notes_about_repairs_are_printed_in_all_formats(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(FILES["wrapped encoder"][0])
    for option in ([], ["--json"], ["--yaml"]):
        result = CliRunner().invoke(cli, ["fit", str(file), "--resolution", "16384 counts", *option])
        assert result.exit_code == 0, result.output
        assert "wraps at 6.28319 rad (360 deg, " in " ".join(result.stdout.split())


def test_times_rounded_to_milliseconds_are_replaced_by_even_times():
    knob = make_knob(5, period=1.25e-3)
    time = 1e-3 * np.floor(1e3 * knob.period * np.arange(knob.reading.size) + 0.3)
    fit = zwidth.fit_log(time, knob.step * knob.reading, knob.torque, rotary=True)
    assert fit.period == pytest.approx(1.25e-3, rel=1e-5)
    assert knob.holds(fit, 2.0)
    assert "the times are rounded to 1.00 ms and were replaced by even times, 1.250 ms apart" in fit.notes
    # One missing sample at 1 kHz is a gap, not a lower rate.
    kept = np.arange(KNOB.reading.size) != 700
    fit = zwidth.fit_log(TIME[kept], (KNOB.step * KNOB.reading)[kept], KNOB.torque[kept], rotary=True)
    assert (fit.period, fit.notes) == (pytest.approx(1e-3, rel=1e-12), ())


def test_log_with_omitted_samples_is_rejected_with_its_cause():
    time = np.cumsum(np.where(np.arange(400) % 5 < 3, 700e-6, 1050e-6))
    with pytest.raises(InputError, match=r"samples are 2 to 3 periods of 350\.0 µs apart, so the log omits samples"):
        zwidth.fit_log(time, KNOB.reading[:400], KNOB.torque[:400])


@pytest.mark.parametrize("seed", range(60))
def test_repaired_positions_are_true_up_to_a_constant(seed):
    """Random knobs, encoders and glitches: the kept positions are true up to a constant number of turns."""
    rng = np.random.default_rng(seed)
    knob = make_knob(seed, samples=800, counts=int(rng.choice([1000, 2000, 4096, 16384, 65536])))
    count, wraps = knob.reading, rng.random() < 0.7
    if wraps:
        count = np.mod(count + int(rng.integers(0, knob.counts)), knob.counts)
    glitches = np.sort(rng.choice(np.arange(10, 790), 4, replace=False)) if rng.random() < 0.8 else np.zeros(0, int)
    count = count.copy()
    # A third to two thirds of a turn from the true count.
    count[glitches] = np.mod(
        count[glitches] + rng.integers(knob.counts // 3, 2 * knob.counts // 3, glitches.size), knob.counts
    )
    repaired = repair_log(None, knob.step * count, knob.torque, knob.step, ROTARY)
    difference = repaired.position - knob.step * knob.reading[repaired.row]
    difference = np.delete(difference, np.flatnonzero(np.isin(repaired.row, glitches)))
    assert np.ptp(difference) < 1e-9
    assert set(range(800)) - set(repaired.row.tolist()) <= set(glitches.tolist())


def test_smooth_motion_has_no_glitches():
    rng = np.random.default_rng(0)
    for seed in range(40):
        knob = make_knob(seed, samples=600)
        assert not find_glitches(knob.step * knob.reading).any()
        noise = 10 ** rng.uniform(-6, -2)
        assert not find_glitches(knob.step * knob.reading + noise * rng.standard_normal(600)).any()


def random_torque(seed, count=3000, size=0.03, hold=45):
    return np.repeat(np.random.default_rng(seed).uniform(-size, size, count // hold + 1), hold)[:count]


def simulate_loaded_inertia(torque, weight=0.0, spring=0.0):
    """Return positions of a damped inertia with gravity or a spring, by small integration steps."""
    x, v, positions = 0.1, 0.0, []
    for torque_sample in torque:
        positions.append(x)
        for _ in range(10):
            v += 1e-4 * (torque_sample - 1e-4 * v - weight * np.sin(x) - spring * x) / 2e-4
            x += 1e-4 * v
    return np.array(positions)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"weight": 0.06}, "gravity also moves the device, with a torque of up to|a spring or gravity of about"),
        ({"spring": 0.05}, "a spring or gravity of about 5.* mN m/rad also moves the device"),
    ],
)
def test_gravity_and_springs_are_reported_as_cause_of_rejection(parts, message):
    torque = random_torque(4)
    with pytest.raises(InputError, match=message) as caught:
        zwidth.fit_log(1e-3, simulate_loaded_inertia(torque, **parts), torque, rotary=True)
    assert "turn the sign" not in str(caught.value)


def test_rounded_force_column_is_reported():
    torque = random_torque(6, 2000, size=0.03)
    position = respond_from_rest(1.2e-5, 8e-5, 1.4e-3, 1e-3, torque)
    step = 2 * np.pi / 16384
    exact = zwidth.fit_log(1e-3, step * np.round(position / step), torque, rotary=True)
    assert exact.status == Status.OK
    fit = zwidth.fit_log(1e-3, step * np.round(position / step), np.round(torque, 4), rotary=True)
    assert fit.status == Status.UNDECIDED
    assert any("the force column is rounded to 100 µN m" in warning for warning in fit.warnings)
    assert not any("resonance" in warning for warning in fit.warnings)
    # Each warning is printed separately.
    assert [label for label, _ in summarize_fit(fit)].count("WARNING") == len(fit.warnings)


@pytest.mark.parametrize("unit, decimals", [("deg", 3), ("rad", 5)])
def test_wrapped_angle_has_resolution_of_its_column(unit, decimals, tmp_path):
    """A constant torque moves a knob without damping by integer multiples of its first displacement."""
    torque = 0.02 * np.repeat(np.random.default_rng(2).choice([-1.0, 1.0], 15), 40)
    position = 6.2 + respond_from_rest(1.2e-5, 1e-12, 0.0, 1e-3, torque)
    turn, size = (360.0, 180.0 / np.pi) if unit == "deg" else (2.0 * np.pi, 1.0)
    angle = [f"{each:.{decimals}f}" for each in np.mod(size * position, turn)]
    file = tmp_path / "log.csv"
    rows = [[f"{1e-3 * k:.3f}", x, f"{f:g}"] for k, (x, f) in enumerate(zip(angle, torque, strict=True))]
    file.write_text(format_file(f"time [s],angle [{unit}],torque [N m]", rows))
    fit = fit_motions([read_log(file, {})])
    assert any("wraps at 6.28319 rad" in note for note in fit.notes)
    assert fit.resolution == pytest.approx(10.0**-decimals / size, rel=1e-6)
    assert "as expected for an encoder step of" in dict(summarize_fit(fit))["fit"]
    assert fit.mass == pytest.approx(1.2e-5, rel=1e-4)
