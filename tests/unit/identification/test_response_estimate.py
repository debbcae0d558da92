"""Responses from records: exact simulated devices behind an encoder, played what `zwidth.excite` designs."""

from __future__ import annotations

import measured_devices
import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError

PERIOD = 1e-3
DEVICE = measured_devices.TrueDevice("amplifier", 0.1, 3.0, 5e-4, ((80.0, 0.03, 0.5),), 0.7e-3, PERIOD, 1e-5, 3.0)


def exact(frequency, device=DEVICE):
    A, B, C = device.sampled()
    return np.array([C @ np.linalg.solve(z * np.eye(B.size) - A, B) for z in np.exp(2j * np.pi * frequency * PERIOD)])


def record(**options):
    return zwidth.excite(period=PERIOD, force=3.0, resolution=1e-5, **{"duration": 30.0, **options})


@pytest.mark.parametrize("seed", range(6))
def test_safe_walls_are_stable_on_devices_nobody_modeled(seed):
    # A share of benchmarks/measured_walls.py.
    trial = measured_devices.measure(seed)
    assert False not in trial.stable
    assert trial.outside < 0.003
    assert max(trial.share) > 0.5
    assert trial.share[1] == pytest.approx(trial.promised, abs=0.1)


def test_the_band_holds_the_true_response_and_is_no_wider_than_needed():
    played = record()
    found = zwidth.respond(PERIOD, DEVICE.play(played.force), played.force)
    off = np.abs(found.device.response - exact(found.device.frequency)) / found.device.deviation
    assert off.max() < 1.0
    # 4.5 standard errors of one part: a median error is 0.26 of it.
    assert 0.15 < np.median(off) < 0.35
    np.testing.assert_allclose(found.device.frequency, played.frequency, rtol=1e-12)
    assert found.cycle == pytest.approx(2.0)
    assert found.records == 5
    assert found.warnings == ()
    # What was expected of an encoder whose errors are white.
    assert np.median(found.device.deviation / played.deviation) == pytest.approx(1.0, abs=0.25)
    assert np.median(found.coherence) > 0.99


def test_drift_and_what_went_before_are_left_out():
    played, rng = record(), np.random.default_rng(3)
    time = PERIOD * np.arange(played.force.size)
    # Gravity on a slope, a push at the beginning, noise.
    before = np.where(time < 0.3, 2.0, 0.0)
    position = DEVICE.play(played.force + before) + 0.02 * time + 0.001 * time**2 + rng.normal(0, 5e-6, time.size)
    found = zwidth.respond(time, position, played.force)
    assert (np.abs(found.device.response - exact(found.device.frequency)) < found.device.deviation).mean() > 0.99


def test_one_force_that_only_repeats_knows_of_the_encoder():
    played = record()
    one = np.tile(played.force[:2000], 6)
    found = zwidth.respond(PERIOD, DEVICE.play(one), one)
    assert found.records == 1
    assert np.all(np.abs(found.device.response - exact(found.device.frequency)) < found.device.deviation)


def test_several_logs_are_one_answer():
    both = [record(seed=seed).force for seed in (1, 2)]
    positions = [DEVICE.play(force) for force in both]
    found = zwidth.respond([PERIOD, PERIOD], positions, both)
    alone = zwidth.respond(PERIOD, positions[0], both[0])
    assert found.records == 2 * alone.records
    assert np.median(found.device.deviation) == pytest.approx(np.median(alone.device.deviation) / np.sqrt(2), rel=0.1)


def test_a_loop_that_holds_the_device_needs_the_cycle():
    played = record()
    A, B, C = DEVICE.sampled()
    x, force, position = np.zeros(B.size), played.force.copy(), np.empty(played.force.size)
    for k in range(force.size):
        position[k] = 1e-5 * np.round(C @ x / 1e-5)
        force[k] -= 50.0 * position[k]
        x = A @ x + B * force[k]
    found = zwidth.respond(PERIOD, position[:6000], force[:6000], cycle=2.0)
    seen = np.abs(found.device.response - exact(found.device.frequency)) < found.device.deviation
    assert seen.mean() > 0.99
    assert found.records == 1


def test_a_force_that_does_not_repeat_is_reported_with_a_warning():
    rng = np.random.default_rng(4)
    force = np.repeat(rng.choice([-3.0, 3.0], 40000), 1)
    found = zwidth.respond(PERIOD, DEVICE.play(force), force)
    assert found.cycle is None
    assert "does not repeat" in found.warnings[0]
    middle = (found.device.frequency > 5) & (found.device.frequency < 300)
    off = np.abs(found.device.response - exact(found.device.frequency))[middle]
    assert (off < found.device.deviation[middle]).mean() > 0.99
    assert np.median(off / np.abs(exact(found.device.frequency))[middle]) < 0.1


def test_a_second_record_is_strong_where_walls_are_decided():
    first = record()
    response = zwidth.respond(PERIOD, DEVICE.play(first.force), first.force).device
    second = record(response=response, seed=1)
    assert np.abs(second.force).max() == pytest.approx(3.0)
    assert second.expected is not None
    assert second.limit is not None
    assert second.expected.stiffness < second.limit.stiffness
    again = zwidth.respond(PERIOD, DEVICE.play(second.force), second.force).device
    told = zwidth.Scene(again, zwidth.Timing(PERIOD)).max_stiffness()
    before = zwidth.Scene(response, zwidth.Timing(PERIOD)).max_stiffness()
    assert told.stiffness > before.stiffness
    assert told.stiffness == pytest.approx(second.expected.stiffness, rel=0.05)
    assert DEVICE.is_stable(told.stiffness, told.virtual_damping)


def test_a_record_is_written_and_read_as_a_log(tmp_path):
    played = record(duration=15.0)
    played.save(tmp_path / "play.csv")
    lines = (tmp_path / "play.csv").read_text().splitlines()
    assert lines[0] == "time [s],force [N]"
    assert len(lines) == played.force.size + 1
    read = np.array([line.split(",") for line in lines[1:]], float)
    np.testing.assert_allclose(read[:, 1], played.force, atol=1e-6)
    found = zwidth.respond(read[:, 0], DEVICE.play(read[:, 1]), read[:, 1])
    np.testing.assert_allclose(found.device.frequency, played.frequency, rtol=1e-9)


REFUSED = {
    "silence": (lambda: zwidth.respond(PERIOD, np.arange(3000.0), np.zeros(3000)), "force"),
    "a motion of its own": (
        lambda: zwidth.respond(
            PERIOD, np.random.default_rng(1).normal(size=9000), np.random.default_rng(2).normal(size=9000)
        ),
        "force",
    ),
    "short": (lambda: zwidth.respond(PERIOD, np.arange(50.0), np.random.default_rng(2).normal(size=50)), "force"),
    "no such cycle": (lambda: zwidth.respond(PERIOD, np.arange(500.0), np.arange(500.0) % 7, cycle=0.4), "cycle"),
    "a short record": (lambda: zwidth.excite(period=PERIOD, force=1.0, resolution=1e-5, duration=1.0), "duration"),
    "no force": (lambda: zwidth.excite(period=PERIOD, force=0.0, resolution=1e-5), "force"),
}


@pytest.mark.parametrize("ask, field", REFUSED.values(), ids=REFUSED)
def test_records_that_tell_nothing_are_refused(ask, field):
    with pytest.raises(InputError, match=rf"^{field}: "):
        ask()
