"""Test stability decisions from samples of a frequency response against the models that generated the samples."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.circle_functions import circle_points

PERIOD = 1e-3
# Relative width of the range below K_max that remains undecided with a frequency spacing of 0.4 %.
UNDECIDED_WIDTH = 0.02


def sample_response(scene, hertz):
    """Return the sampled response of a model in m/N, including delay and hold."""
    return scene.loop.roots.evaluate_response(circle_points(2 * np.pi * hertz * PERIOD)).value / scene.units.stiffness


def make_measured(scene, hertz, deviation=None, error=0.0):
    device = zwidth.MeasuredDevice(hertz, sample_response(scene, hertz) + error, deviation)
    return zwidth.Scene(device, zwidth.Timing(PERIOD), velocity=scene.velocity)


def make_coupling(ratio: float, sensor: Literal["motor", "tip"] = "motor") -> zwidth.Coupling:
    mass = 0.1 * 0.03 / 0.13
    return zwidth.Coupling(0.03, 2e4, 2 * ratio * np.sqrt(2e4 * mass), sensor)


SCENES = {
    "rigid": zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(PERIOD, 1e-3)),
    "filtered": zwidth.Scene(
        zwidth.Device(0.1, 5.0), zwidth.Timing(PERIOD, 0.4e-3), velocity=zwidth.LowPass(cutoff=100)
    ),
    "amplifier": zwidth.Scene(
        zwidth.Device(0.1, 2.0, actuator=zwidth.Actuator(time_constant=1e-3)), zwidth.Timing(PERIOD)
    ),
    "motor": zwidth.Scene(zwidth.Device(0.1, 1.0, coupling=make_coupling(0.03)), zwidth.Timing(PERIOD, 1e-3)),
    "tip": zwidth.Scene(zwidth.Device(0.1, 1.0, coupling=make_coupling(0.03, "tip")), zwidth.Timing(PERIOD, 1e-3)),
}
DENSE = np.geomspace(1.0, 490.0, 1500)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_dense_samples_determine_the_maximum_stiffness(scene):
    model, estimate = scene.max_stiffness(), make_measured(scene, DENSE).max_stiffness()
    assert estimate.status == Status.OK
    assert (1 - UNDECIDED_WIDTH) * model.stiffness < estimate.stiffness < model.stiffness
    # At a corner two pole pairs reach the unit circle, and either may be reported.
    assert model.kind == zwidth.RidgeKind.CORNER or estimate.frequency == pytest.approx(model.frequency, rel=0.1)
    assert scene.is_stable(estimate.stiffness, estimate.virtual_damping)


def random_walls(scene, generator, count=300):
    top = scene.max_stiffness(negative_damping=True)
    stiffness = top.stiffness * 10 ** generator.uniform(-2, 0.7, count)
    return stiffness, top.virtual_damping * generator.uniform(-1, 4, count)


@pytest.mark.parametrize("count", [30, 100, 300, 1000])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_no_decision_is_wrong_at_any_number_of_frequencies(scene, count):
    generator = np.random.default_rng(count)
    decided = 0
    for deviation in (None, 1e-7, 1e-5):
        # Irregular frequencies, and response errors anywhere within the deviation.
        step = np.log(490.0) / count
        hertz = np.exp(step * (np.arange(count) + generator.uniform(0.25, 0.75, count)))
        phase = np.exp(2j * np.pi * generator.random(count))
        error = 0.0 if deviation is None else deviation * np.sqrt(generator.random(count)) * phase
        walls = random_walls(scene, generator)
        decision = make_measured(scene, hertz, deviation, error).decide_stability(*walls)
        is_decided = decision.status == Status.OK
        decided += is_decided.sum()
        assert set(np.unique(decision.status)) <= {Status.OK, Status.UNDECIDED}
        np.testing.assert_array_equal(decision.stable[is_decided], scene.is_stable(*walls)[is_decided])
        assert not decision.stable[~is_decided].any()
    if count >= 300:
        assert decided > 100


def test_recommended_limit_is_stable_for_all_responses_within_the_deviation():
    scene, generator, radius = SCENES["motor"], np.random.default_rng(5), 3e-6
    hertz = np.geomspace(1.0, 490.0, 800)
    safe = make_measured(scene, hertz, radius).max_stiffness()
    wall = safe.stiffness, safe.virtual_damping
    limit = make_measured(scene, hertz).max_stiffness().stiffness
    assert 0.5 * limit < safe.stiffness < 0.95 * limit
    z = np.exp(2j * np.pi * hertz * PERIOD)
    H = wall[0] + wall[1] * (1 - 1 / z) / PERIOD
    nearest = np.abs(1 / H + sample_response(scene, hertz)) / radius
    # The Nyquist distance decides, and exceeds the deviation only by the frequency spacing.
    assert 1.0 < nearest.min() < 1.1
    for _ in range(20):
        # Other devices with responses within the deviation: an additional mode with the largest admissible amplitude.
        mode = zwidth.Mode(float(generator.uniform(20, 400)), 0.05, 1.0)
        peak = np.abs(sample_response(make_modal(mode), hertz) - sample_response(scene, hertz)).max()
        weaker = make_modal(zwidth.Mode(mode.frequency, 0.05, peak / radius * generator.choice([-1.0, 1.0])))
        assert np.abs(sample_response(weaker, hertz) - sample_response(scene, hertz)).max() <= 1.001 * radius
        assert weaker.is_stable(*wall)


def make_modal(mode):
    return zwidth.Scene(
        zwidth.Device(0.1, 1.0, coupling=make_coupling(0.03), modes=[mode]), zwidth.Timing(PERIOD, 1e-3)
    )


def test_resonance_between_two_frequencies_is_undecided_and_reported():
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, modes=[zwidth.Mode(97.0, 0.01, 0.5)]), zwidth.Timing(PERIOD, 1e-3))
    rigid_top = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(PERIOD, 1e-3)).max_stiffness()
    wall = 0.5 * rigid_top.stiffness, 0.5 * rigid_top.virtual_damping
    # The frequencies are 10 Hz apart; the true loop is unstable, but its samples resemble those of a mass.
    coarse = make_measured(scene, np.arange(2.0, 490.0, 10.0))
    assert not scene.is_stable(*wall)
    assert coarse.decide_stability(*wall).status == Status.UNDECIDED
    assert not coarse.is_stable(*wall)
    explanation = " ".join(coarse.explain_undecided(*wall))
    assert "measure again from" in explanation
    low, high = (float(word) for word in explanation.split("again from ")[1].split(" Hz")[0].split(" to "))
    assert low <= 97.0 <= high


def test_short_frequency_range_is_undecided_and_reported():
    scene = SCENES["rigid"]
    top = scene.max_stiffness()
    wall = 0.8 * top.stiffness, top.virtual_damping
    for hertz, message in (
        (np.geomspace(1, 100, 400), "measure above 100 Hz"),
        (np.geomspace(80, 490, 400), "below 80 Hz"),
    ):
        short = make_measured(scene, hertz)
        assert short.decide_stability(*wall).status == Status.UNDECIDED
        assert message in " ".join(short.explain_undecided(*wall))
    complete = make_measured(scene, DENSE)
    assert complete.decide_stability(*wall).status == Status.OK
    assert complete.explain_undecided(*wall) == []
    assert scene.explain_undecided(*wall) == []


def test_stable_intervals_and_region_agree():
    scene, model = make_measured(SCENES["motor"], DENSE, 1e-8), SCENES["motor"]
    top = scene.max_stiffness()
    (stiffness_range,) = scene.stable_stiffness(top.virtual_damping)
    assert stiffness_range[1] == pytest.approx(top.stiffness, rel=1e-6)
    (damping_range,) = scene.stable_damping(0.7 * top.stiffness)
    dampings = np.linspace(damping_range[0], damping_range[1], 9)[1:-1]
    assert scene.is_stable(0.7 * top.stiffness, dampings).all()
    assert model.is_stable(0.7 * top.stiffness, dampings).all()
    (region,) = scene.stable_region()
    assert region.stiffness.max() == pytest.approx(top.stiffness, rel=0.01)
    assert model.is_stable(
        0.999 * region.stiffness[region.stiffness > 500], region.virtual_damping[region.stiffness > 500]
    ).all()
    assert scene.islands() == []


def test_margins_match_the_model():
    scene = SCENES["motor"]
    top = scene.max_stiffness()
    walls = top.stiffness * np.array([0.3, 0.6, 3.0]), top.virtual_damping * np.array([0.5, 0.8, 1.0])
    expected, estimated = scene.margins(*walls), make_measured(scene, DENSE).margins(*walls)
    for name in ("gain_margin", "phase_margin", "modulus_margin", "gain_crossover", "phase_crossover"):
        np.testing.assert_allclose(getattr(estimated, name), getattr(expected, name), rtol=0.01, err_msg=name)
    # A fractional delay (zero-order hold) is not a pure delay, an integer delay is.
    np.testing.assert_allclose(estimated.delay_margin, expected.delay_margin, rtol=0.05)
    assert np.isnan(make_measured(scene, DENSE, 1e-4).margins(*walls).gain_margin).all()


@pytest.mark.parametrize("last", [95.0, 100.0, 110.0])
def test_gain_margin_above_the_highest_frequency_is_finite(last):
    """L becomes negative at 115 Hz, where only a bound of the response is available."""
    scene, wall = SCENES["rigid"], (500.0, 5.0)
    expected, estimated = scene.margins(*wall), make_measured(scene, np.linspace(1.0, last, 600)).margins(*wall)
    assert 1.0 < estimated.gain_margin < expected.gain_margin
    assert estimated.gain_crossover == pytest.approx(expected.gain_crossover, rel=1e-4)
    assert estimated.phase_crossover == pytest.approx(last)


FUNCTIONS = {
    "poles": lambda scene: scene.poles(1e3, 1.0),
    "radius": lambda scene: scene.spectral_radius(1e3, 1.0),
    "dominant pole": lambda scene: scene.dominant_pole(1e3, 1.0),
    "certificate": lambda scene: scene.decide_stability(1e3, 1.0, method="certified"),
    "passivity": lambda scene: scene.is_passive(1e3, 1.0),
    "sensitivities": lambda scene: scene.sensitivities(),
    "matrices": lambda scene: scene.state_space(1e3, 1.0),
    "motion": lambda scene: scene.simulate(1e3, 1.0),
    "damping": lambda scene: scene.best_damping(1e3),
    "other rate": lambda scene: scene.replace(period=5e-4),
    "another delay": lambda scene: zwidth.Scene(scene.device, zwidth.Timing(PERIOD, 1e-3)).is_stable(1e3, 1.0),
    "a hand": lambda scene: zwidth.Scene(scene.device, scene.timing, operator=zwidth.Operator(0.5)),
    "frequencies above Nyquist": lambda scene: zwidth.Scene(scene.device, zwidth.Timing(2e-3)).check_parts(),
}


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_functions_that_need_a_model_are_rejected(function):
    with pytest.raises(InputError, match=r"^[\w ]+: [^\n]+$"):
        function(make_measured(SCENES["rigid"], DENSE))


def test_invalid_walls_do_not_affect_other_batch_entries():
    scene = make_measured(SCENES["rigid"], DENSE)
    decision = scene.decide_stability([5e3, np.nan, 5e3, -5e3], [20.0, 20.0, np.inf, 20.0])
    assert list(decision.status) == [Status.OK, Status.INVALID_INPUT, Status.INVALID_INPUT, Status.UNDECIDED]
    assert list(decision.stable) == [True, False, False, False]


def test_large_deviation_leaves_all_walls_undecided():
    scene = make_measured(SCENES["rigid"], DENSE, 1.0)
    top = scene.max_stiffness()
    assert top.status == Status.UNDECIDED
    assert np.isnan(top.stiffness)
    assert scene.stable_region() == []
    assert scene.stable_stiffness(20.0).shape == (0, 2)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_response_with_wrong_sign_decides_nothing(scene):
    negated = zwidth.Scene(zwidth.MeasuredDevice(DENSE, -sample_response(scene, DENSE)), zwidth.Timing(PERIOD))
    decision = negated.decide_stability(np.geomspace(10, 1e5, 50), 10.0)
    assert (decision.status == Status.UNDECIDED).all()
    assert "mass, damper or spring" in negated.explain_undecided(5e3, 10.0)[0]


def test_lowest_frequency_with_nearly_360_degrees_of_delay_decides_nothing():
    late = zwidth.Scene(zwidth.Device(0.8, 0.0), zwidth.Timing(PERIOD, 19.7 * PERIOD))
    scene = make_measured(late, np.geomspace(43.6, 400.0, 200))
    assert scene.max_stiffness().status == Status.UNDECIDED
    assert "mass, damper or spring" in scene.explain_undecided(5e3, 10.0)[0]
    assert make_measured(late, np.geomspace(0.5, 400.0, 3000)).max_stiffness().status == Status.OK


def test_device_on_a_spring_is_decided():
    hand = zwidth.Operator(mass=0.05, damping=2.0, stiffness=4e3)
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(PERIOD, 1e-3), operator=hand)
    model, estimate = scene.max_stiffness(), make_measured(scene, DENSE).max_stiffness()
    assert (1 - UNDECIDED_WIDTH) * model.stiffness < estimate.stiffness < model.stiffness
    walls = random_walls(scene, np.random.default_rng(1))
    decided = make_measured(scene, DENSE).decide_stability(*walls)
    is_decided = decided.status == Status.OK
    # Walls softer than the spring remain undecided.
    assert is_decided.mean() > 0.4
    np.testing.assert_array_equal(decided.stable[is_decided], scene.is_stable(*walls)[is_decided])


def test_assessment_is_undecided_only_where_samples_are():
    scene = SCENES["amplifier"]
    hertz = np.geomspace(0.5, 480, 600)
    size = np.abs(sample_response(scene, hertz))
    scene_measured = make_measured(scene, hertz, 0.02 * size)
    top, counts = scene.max_stiffness(), {True: 0, False: 0, None: 0}
    for share in (0.3, 0.9, 1.0, 1.1, 3.0):
        wall = zwidth.VirtualWall(share * float(top.stiffness), float(top.virtual_damping))
        assessment, expected = zwidth.assess(scene_measured.replace(wall=wall)), zwidth.assess(scene.replace(wall=wall))
        decided = scene_measured.decide_stability(wall.stiffness, wall.virtual_damping)
        assert (assessment.stable is None) == (decided.status == Status.UNDECIDED)
        assert assessment.stable in (None, expected.stable), (
            "the verdict is valid for every response within the deviation"
        )
        counts[assessment.stable] += 1
        for (low, high), (least, most) in zip(assessment.stable_stiffness, expected.stable_stiffness, strict=False):
            assert least <= low < high <= most
        undefined = "spectral_radius", "decay_rate", "time_constant", "frequency", "passivity_margin"
        assert all(np.isnan(getattr(assessment, name)) for name in undefined)
        assert assessment.passive is None
    assert all(counts.values()), "each verdict occurs"
    assert [limit.name for limit in zwidth.limits_of(scene_measured)] == [], (
        "the response is given for one rate and delay only"
    )
    (row,) = zwidth.assess_many({"measured": scene_measured.replace(wall=zwidth.VirtualWall(1e3, 1.0))})
    assert (row["status"], row["spectral_radius"]) == ("OK", None)


def test_too_few_frequencies_are_reported_as_the_cause():
    frequency = np.geomspace(20.0, 400.0, 8)
    z = np.exp(2j * np.pi * frequency * 1e-3)
    device = zwidth.MeasuredDevice(frequency, 5e-6 * (z + 1) / (z * (z - 1) ** 2))
    recommendation = zwidth.Scene(device, zwidth.Timing(1e-3)).recommend()
    assert recommendation.status == Status.UNDECIDED
    assert recommendation.reason.startswith(
        "the 8 frequencies of the response decide the stability of no wall; measure again from"
    )
    assert recommendation.reason.endswith("with finer frequency spacing")
