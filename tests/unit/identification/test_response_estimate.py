"""Test `zwidth.respond` and `zwidth.excite` on exactly simulated devices with an encoder.

Reference: the exact response of the discretized device.
"""

from __future__ import annotations

import measured_devices
import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError

PERIOD = 1e-3
DEVICE = measured_devices.TrueDevice("amplifier", 0.1, 3.0, 5e-4, ((80.0, 0.03, 0.5),), 0.7e-3, PERIOD, 1e-5, 3.0)


def evaluate_response(frequency, device=DEVICE):
    A, B, C = device.sampled()
    return np.array([C @ np.linalg.solve(z * np.eye(B.size) - A, B) for z in np.exp(2j * np.pi * frequency * PERIOD)])


def design_excitation(**options):
    return zwidth.excite(period=PERIOD, force=3.0, resolution=1e-5, **{"duration": 30.0, **options})


@pytest.mark.parametrize("seed", range(6))
def test_recommended_walls_are_stable_on_true_devices(seed):
    # A few of the trials of benchmarks/measured_walls.py.
    trial = measured_devices.measure(seed)
    assert False not in trial.stable
    assert trial.outside < 0.003
    assert max(trial.share) > 0.5
    assert trial.share[1] == pytest.approx(trial.promised, abs=0.1)


def test_deviation_covers_the_true_response_and_is_tight():
    excitation = design_excitation()
    estimate = zwidth.respond(PERIOD, DEVICE.play(excitation.force), excitation.force)
    relative_error = (
        np.abs(estimate.device.response - evaluate_response(estimate.device.frequency)) / estimate.device.deviation
    )
    assert relative_error.max() < 1.0
    # The deviation is 4.5 standard errors of one component, so the median error is 0.26 of the deviation.
    assert 0.15 < np.median(relative_error) < 0.35
    np.testing.assert_allclose(estimate.device.frequency, excitation.frequency, rtol=1e-12)
    assert estimate.cycle == pytest.approx(2.0)
    assert estimate.records == 5
    assert estimate.warnings == ()
    # The prediction assumes white encoder errors.
    assert np.median(estimate.device.deviation / excitation.deviation) == pytest.approx(1.0, abs=0.25)
    assert np.median(estimate.coherence) > 0.99


def test_drift_and_initial_transient_are_excluded():
    excitation, rng = design_excitation(), np.random.default_rng(3)
    time = PERIOD * np.arange(excitation.force.size)
    # Gravity on a slope, an initial force pulse, and noise.
    pulse = np.where(time < 0.3, 2.0, 0.0)
    position = DEVICE.play(excitation.force + pulse) + 0.02 * time + 0.001 * time**2 + rng.normal(0, 5e-6, time.size)
    estimate = zwidth.respond(time, position, excitation.force)
    assert (
        np.abs(estimate.device.response - evaluate_response(estimate.device.frequency)) < estimate.device.deviation
    ).mean() > 0.99


def test_deviation_includes_the_encoder_for_one_repeated_record():
    excitation = design_excitation()
    repeated = np.tile(excitation.force[:2000], 6)
    estimate = zwidth.respond(PERIOD, DEVICE.play(repeated), repeated)
    assert estimate.records == 1
    assert np.all(
        np.abs(estimate.device.response - evaluate_response(estimate.device.frequency)) < estimate.device.deviation
    )


def test_several_logs_yield_one_estimate():
    forces = [design_excitation(seed=seed).force for seed in (1, 2)]
    positions = [DEVICE.play(force) for force in forces]
    estimate = zwidth.respond([PERIOD, PERIOD], positions, forces)
    single = zwidth.respond(PERIOD, positions[0], forces[0])
    assert estimate.records == 2 * single.records
    assert np.median(estimate.device.deviation) == pytest.approx(
        np.median(single.device.deviation) / np.sqrt(2), rel=0.1
    )


def test_record_in_closed_loop_with_given_cycle():
    excitation = design_excitation()
    A, B, C = DEVICE.sampled()
    x, force, position = np.zeros(B.size), excitation.force.copy(), np.empty(excitation.force.size)
    for k in range(force.size):
        position[k] = 1e-5 * np.round(C @ x / 1e-5)
        force[k] -= 50.0 * position[k]
        x = A @ x + B * force[k]
    estimate = zwidth.respond(PERIOD, position[:6000], force[:6000], cycle=2.0)
    is_covered = (
        np.abs(estimate.device.response - evaluate_response(estimate.device.frequency)) < estimate.device.deviation
    )
    assert is_covered.mean() > 0.99
    assert estimate.records == 1


def test_force_without_cycle_yields_a_warning():
    rng = np.random.default_rng(4)
    force = np.repeat(rng.choice([-3.0, 3.0], 40000), 1)
    estimate = zwidth.respond(PERIOD, DEVICE.play(force), force)
    assert estimate.cycle is None
    assert "does not repeat" in estimate.warnings[0]
    middle = (estimate.device.frequency > 5) & (estimate.device.frequency < 300)
    error = np.abs(estimate.device.response - evaluate_response(estimate.device.frequency))[middle]
    assert (error < estimate.device.deviation[middle]).mean() > 0.99
    assert np.median(error / np.abs(evaluate_response(estimate.device.frequency))[middle]) < 0.1


def test_second_record_is_designed_for_the_maximum_stiffness():
    first = design_excitation()
    response = zwidth.respond(PERIOD, DEVICE.play(first.force), first.force).device
    second = design_excitation(response=response, seed=1)
    assert np.abs(second.force).max() == pytest.approx(3.0)
    assert second.expected is not None
    assert second.limit is not None
    assert second.expected.stiffness < second.limit.stiffness
    refined = zwidth.respond(PERIOD, DEVICE.play(second.force), second.force).device
    refined_limit = zwidth.Scene(refined, zwidth.Timing(PERIOD)).max_stiffness()
    first_limit = zwidth.Scene(response, zwidth.Timing(PERIOD)).max_stiffness()
    assert refined_limit.stiffness > first_limit.stiffness
    assert refined_limit.stiffness == pytest.approx(second.expected.stiffness, rel=0.05)
    assert DEVICE.is_stable(refined_limit.stiffness, refined_limit.virtual_damping)


def test_saved_excitation_is_read_as_a_log(tmp_path):
    excitation = design_excitation(duration=15.0)
    excitation.save(tmp_path / "play.csv")
    lines = (tmp_path / "play.csv").read_text().splitlines()
    assert lines[0] == "time [s],force [N]"
    assert len(lines) == excitation.force.size + 1
    read = np.array([line.split(",") for line in lines[1:]], float)
    np.testing.assert_allclose(read[:, 1], excitation.force, atol=1e-6)
    estimate = zwidth.respond(read[:, 0], DEVICE.play(read[:, 1]), read[:, 1])
    np.testing.assert_allclose(estimate.device.frequency, excitation.frequency, rtol=1e-9)


REFUSED = {
    "zero force": (lambda: zwidth.respond(PERIOD, np.arange(3000.0), np.zeros(3000)), "force"),
    "unrelated motion": (
        lambda: zwidth.respond(
            PERIOD, np.random.default_rng(1).normal(size=9000), np.random.default_rng(2).normal(size=9000)
        ),
        "force",
    ),
    "short log": (lambda: zwidth.respond(PERIOD, np.arange(50.0), np.random.default_rng(2).normal(size=50)), "force"),
    "wrong cycle": (lambda: zwidth.respond(PERIOD, np.arange(500.0), np.arange(500.0) % 7, cycle=0.4), "cycle"),
    "short excitation": (lambda: zwidth.excite(period=PERIOD, force=1.0, resolution=1e-5, duration=1.0), "duration"),
    "no force": (lambda: zwidth.excite(period=PERIOD, force=0.0, resolution=1e-5), "force"),
}


@pytest.mark.parametrize("function, field", REFUSED.values(), ids=REFUSED)
def test_uninformative_records_are_rejected(function, field):
    with pytest.raises(InputError, match=rf"^{field}: "):
        function()
