"""Walls decided by samples of a response alone, against the same devices as models, whose poles are counted."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.circle_functions import circle_points

PERIOD = 1e-3
# What lines of 0.4 % of their frequency leave undecided below K_max.
NEAR = 0.02


def response(scene, hertz):
    """The sampled response of a model, delay and hold in it, in m/N."""
    return scene.loop.roots.evaluate_response(circle_points(2 * np.pi * hertz * PERIOD)).value / scene.units.stiffness


def measured(scene, hertz, deviation=None, error=0.0):
    device = zwidth.MeasuredDevice(hertz, response(scene, hertz) + error, deviation)
    return zwidth.Scene(device, zwidth.Timing(PERIOD), velocity=scene.velocity)


def coupled(ratio: float, sensor: Literal["motor", "tip"] = "motor") -> zwidth.Coupling:
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
    "motor": zwidth.Scene(zwidth.Device(0.1, 1.0, coupling=coupled(0.03)), zwidth.Timing(PERIOD, 1e-3)),
    "tip": zwidth.Scene(zwidth.Device(0.1, 1.0, coupling=coupled(0.03, "tip")), zwidth.Timing(PERIOD, 1e-3)),
}
DENSE = np.geomspace(1.0, 490.0, 1500)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_dense_lines_know_the_stiffest_wall(scene):
    known, found = scene.max_stiffness(), measured(scene, DENSE).max_stiffness()
    assert found.status == Status.OK
    assert (1 - NEAR) * known.stiffness < found.stiffness < known.stiffness
    # At a corner two pairs bind, and either may be named.
    assert known.kind == zwidth.RidgeKind.CORNER or found.frequency == pytest.approx(known.frequency, rel=0.1)
    assert scene.is_stable(found.stiffness, found.virtual_damping)


def random_walls(scene, generator, count=300):
    top = scene.max_stiffness(negative_damping=True)
    stiffness = top.stiffness * 10 ** generator.uniform(-2, 0.7, count)
    return stiffness, top.virtual_damping * generator.uniform(-1, 4, count)


@pytest.mark.parametrize("count", [30, 100, 300, 1000])
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_no_label_is_wrong_however_few_the_lines(scene, count):
    generator = np.random.default_rng(count)
    decided = 0
    for deviation in (None, 1e-7, 1e-5):
        # Lines as nobody would choose them, off by anything within the deviation.
        step = np.log(490.0) / count
        hertz = np.exp(step * (np.arange(count) + generator.uniform(0.25, 0.75, count)))
        turn = np.exp(2j * np.pi * generator.random(count))
        error = 0.0 if deviation is None else deviation * np.sqrt(generator.random(count)) * turn
        walls = random_walls(scene, generator)
        found = measured(scene, hertz, deviation, error).decide_stability(*walls)
        sure = found.status == Status.OK
        decided += sure.sum()
        assert set(np.unique(found.status)) <= {Status.OK, Status.UNDECIDED}
        np.testing.assert_array_equal(found.stable[sure], scene.is_stable(*walls)[sure])
        assert not found.stable[~sure].any()
    assert decided > (100 if count >= 300 else -1)


def test_a_safe_wall_holds_for_every_response_in_the_band():
    scene, generator, radius = SCENES["motor"], np.random.default_rng(5), 3e-6
    hertz = np.geomspace(1.0, 490.0, 800)
    safe = measured(scene, hertz, radius).max_stiffness()
    wall = safe.stiffness, safe.virtual_damping
    limit = measured(scene, hertz).max_stiffness().stiffness
    assert 0.5 * limit < safe.stiffness < 0.95 * limit
    z = np.exp(2j * np.pi * hertz * PERIOD)
    H = wall[0] + wall[1] * (1 - 1 / z) / PERIOD
    nearest = np.abs(1 / H + response(scene, hertz)) / radius
    # Nyquist's distance is what decides, and no more of it is kept than lines leave open.
    assert 1.0 < nearest.min() < 1.1
    for _ in range(20):
        # Other devices whose response lies in the band: a mode more, as weak as the radius allows.
        mode = zwidth.Mode(float(generator.uniform(20, 400)), 0.05, 1.0)
        peak = np.abs(response(modal(mode), hertz) - response(scene, hertz)).max()
        weaker = modal(zwidth.Mode(mode.frequency, 0.05, peak / radius * generator.choice([-1.0, 1.0])))
        assert np.abs(response(weaker, hertz) - response(scene, hertz)).max() <= 1.001 * radius
        assert weaker.is_stable(*wall)


def modal(mode):
    return zwidth.Scene(zwidth.Device(0.1, 1.0, coupling=coupled(0.03), modes=[mode]), zwidth.Timing(PERIOD, 1e-3))


def test_a_resonance_between_two_lines_is_undecided_and_named():
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, modes=[zwidth.Mode(97.0, 0.01, 0.5)]), zwidth.Timing(PERIOD, 1e-3))
    dense = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(PERIOD, 1e-3)).max_stiffness()
    wall = 0.5 * dense.stiffness, 0.5 * dense.virtual_damping
    # Ten Hz apart; the truth is unstable, and the lines show hardly more than a mass.
    coarse = measured(scene, np.arange(2.0, 490.0, 10.0))
    assert not scene.is_stable(*wall)
    assert coarse.decide_stability(*wall).status == Status.UNDECIDED
    assert not coarse.is_stable(*wall)
    said = " ".join(coarse.explain_undecided(*wall))
    assert "measure again from" in said
    low, high = (float(word) for word in said.split("again from ")[1].split(" Hz")[0].split(" to "))
    assert low <= 97.0 <= high


def test_a_band_that_ends_early_is_undecided_and_named():
    scene = SCENES["rigid"]
    top = scene.max_stiffness()
    wall = 0.8 * top.stiffness, top.virtual_damping
    for hertz, said in (
        (np.geomspace(1, 100, 400), "measure above 100 Hz"),
        (np.geomspace(80, 490, 400), "below 80 Hz"),
    ):
        short = measured(scene, hertz)
        assert short.decide_stability(*wall).status == Status.UNDECIDED
        assert said in " ".join(short.explain_undecided(*wall))
    whole = measured(scene, DENSE)
    assert whole.decide_stability(*wall).status == Status.OK
    assert whole.explain_undecided(*wall) == []
    assert scene.explain_undecided(*wall) == []


def test_rows_columns_and_outlines_hold_the_same_walls():
    scene, real = measured(SCENES["motor"], DENSE, 1e-8), SCENES["motor"]
    top = scene.max_stiffness()
    (row,) = scene.stable_stiffness(top.virtual_damping)
    assert row[1] == pytest.approx(top.stiffness, rel=1e-6)
    (column,) = scene.stable_damping(0.7 * top.stiffness)
    both = np.linspace(column[0], column[1], 9)[1:-1]
    assert scene.is_stable(0.7 * top.stiffness, both).all()
    assert real.is_stable(0.7 * top.stiffness, both).all()
    (outline,) = scene.stable_region()
    assert outline.stiffness.max() == pytest.approx(top.stiffness, rel=0.01)
    assert real.is_stable(
        0.999 * outline.stiffness[outline.stiffness > 500], outline.virtual_damping[outline.stiffness > 500]
    ).all()
    assert scene.islands() == []


def test_margins_are_those_of_the_model():
    scene = SCENES["motor"]
    top = scene.max_stiffness()
    walls = top.stiffness * np.array([0.3, 0.6, 3.0]), top.virtual_damping * np.array([0.5, 0.8, 1.0])
    known, found = scene.margins(*walls), measured(scene, DENSE).margins(*walls)
    for name in ("gain_margin", "phase_margin", "modulus_margin", "gain_crossover", "phase_crossover"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), rtol=0.01, err_msg=name)
    # A held fraction of a period is no pure delay, whole periods are.
    np.testing.assert_allclose(found.delay_margin, known.delay_margin, rtol=0.05)
    assert np.isnan(measured(scene, DENSE, 1e-4).margins(*walls).gain_margin).all()


@pytest.mark.parametrize("last", [95.0, 100.0, 110.0])
def test_a_gain_margin_beyond_the_last_line_is_not_infinite(last):
    """L turns negative at 115 Hz: of lines below nothing but a bound of the response beyond them is known."""
    scene, wall = SCENES["rigid"], (500.0, 5.0)
    known, found = scene.margins(*wall), measured(scene, np.linspace(1.0, last, 600)).margins(*wall)
    assert 1.0 < found.gain_margin < known.gain_margin
    assert found.gain_crossover == pytest.approx(known.gain_crossover, rel=1e-4)
    assert found.phase_crossover == pytest.approx(last)


QUESTIONS = {
    "poles": lambda scene: scene.poles(1e3, 1.0),
    "radius": lambda scene: scene.spectral_radius(1e3, 1.0),
    "proof": lambda scene: scene.decide_stability(1e3, 1.0, method="certified"),
    "passivity": lambda scene: scene.is_passive(1e3, 1.0),
    "sensitivities": lambda scene: scene.sensitivities(),
    "matrices": lambda scene: scene.state_space(1e3, 1.0),
    "motion": lambda scene: scene.simulate(1e3, 1.0),
    "damping": lambda scene: scene.best_damping(1e3),
    "other rate": lambda scene: scene.replace(period=5e-4),
    "another delay": lambda scene: zwidth.Scene(scene.device, zwidth.Timing(PERIOD, 1e-3)).is_stable(1e3, 1.0),
    "a hand": lambda scene: zwidth.Scene(scene.device, scene.timing, operator=zwidth.Operator(0.5)),
    "lines beyond half the rate": lambda scene: zwidth.Scene(scene.device, zwidth.Timing(2e-3)).check_parts(),
}


@pytest.mark.parametrize("ask", QUESTIONS.values(), ids=QUESTIONS)
def test_what_needs_a_model_is_refused_in_one_sentence(ask):
    with pytest.raises(InputError, match=r"^[\w ]+: [^\n]+$"):
        ask(measured(SCENES["rigid"], DENSE))


def test_bad_walls_leave_their_neighbors_alone():
    scene = measured(SCENES["rigid"], DENSE)
    found = scene.decide_stability([5e3, np.nan, 5e3, -5e3], [20.0, 20.0, np.inf, 20.0])
    assert list(found.status) == [Status.OK, Status.INVALID_INPUT, Status.INVALID_INPUT, Status.UNDECIDED]
    assert list(found.stable) == [True, False, False, False]


def test_a_response_that_tells_nothing_gives_no_wall():
    scene = measured(SCENES["rigid"], DENSE, 1.0)
    top = scene.max_stiffness()
    assert top.status == Status.UNDECIDED
    assert np.isnan(top.stiffness)
    assert scene.stable_region() == []
    assert scene.stable_stiffness(20.0).shape == (0, 2)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_wrong_sign_decides_nothing(scene):
    turned = zwidth.Scene(zwidth.MeasuredDevice(DENSE, -response(scene, DENSE)), zwidth.Timing(PERIOD))
    found = turned.decide_stability(np.geomspace(10, 1e5, 50), 10.0)
    assert (found.status == Status.UNDECIDED).all()
    assert "mass, damper or spring" in turned.explain_undecided(5e3, 10.0)[0]


def test_a_first_line_behind_nearly_a_turn_of_delay_decides_nothing():
    late = zwidth.Scene(zwidth.Device(0.8, 0.0), zwidth.Timing(PERIOD, 19.7 * PERIOD))
    scene = measured(late, np.geomspace(43.6, 400.0, 200))
    assert scene.max_stiffness().status == Status.UNDECIDED
    assert "mass, damper or spring" in scene.explain_undecided(5e3, 10.0)[0]
    assert measured(late, np.geomspace(0.5, 400.0, 3000)).max_stiffness().status == Status.OK


def test_a_device_on_a_spring_is_one_too():
    hand = zwidth.Operator(mass=0.05, damping=2.0, stiffness=4e3)
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(PERIOD, 1e-3), operator=hand)
    known, found = scene.max_stiffness(), measured(scene, DENSE).max_stiffness()
    assert (1 - NEAR) * known.stiffness < found.stiffness < known.stiffness
    walls = random_walls(scene, np.random.default_rng(1))
    decided = measured(scene, DENSE).decide_stability(*walls)
    sure = decided.status == Status.OK
    # Softer walls than the spring are left open.
    assert sure.mean() > 0.4
    np.testing.assert_array_equal(decided.stable[sure], scene.is_stable(*walls)[sure])


def test_an_assessment_says_what_samples_tell_and_leaves_the_rest_open():
    scene = SCENES["amplifier"]
    hertz = np.geomspace(0.5, 480, 600)
    size = np.abs(response(scene, hertz))
    known = measured(scene, hertz, 0.02 * size)
    top, words = scene.max_stiffness(), {True: 0, False: 0, None: 0}
    for share in (0.3, 0.9, 1.0, 1.1, 3.0):
        wall = zwidth.VirtualWall(share * float(top.stiffness), float(top.virtual_damping))
        found, true = zwidth.assess(known.replace(wall=wall)), zwidth.assess(scene.replace(wall=wall))
        decided = known.decide_stability(wall.stiffness, wall.virtual_damping)
        assert (found.stable is None) == (decided.status == Status.UNDECIDED)
        assert found.stable in (None, true.stable), "what is said holds for every response, and this one is in the band"
        words[found.stable] += 1
        for (low, high), (least, most) in zip(found.stable_stiffness, true.stable_stiffness, strict=False):
            assert least <= low < high <= most
        unknown = "spectral_radius", "decay_rate", "time_constant", "frequency", "passivity_margin"
        assert all(np.isnan(getattr(found, name)) for name in unknown)
        assert found.passive is None
    assert all(words.values()), "each verdict is asked for"
    assert [limit.name for limit in zwidth.limits_of(known)] == [], "at no other rate or delay is it known"
    (row,) = zwidth.assess_many({"measured": known.replace(wall=zwidth.VirtualWall(1e3, 1.0))})
    assert (row["status"], row["spectral_radius"]) == ("OK", None)


def test_too_few_lines_are_named_as_the_cause():
    frequency = np.geomspace(20.0, 400.0, 8)
    z = np.exp(2j * np.pi * frequency * 1e-3)
    device = zwidth.MeasuredDevice(frequency, 5e-6 * (z + 1) / (z * (z - 1) ** 2))
    found = zwidth.Scene(device, zwidth.Timing(1e-3)).recommend()
    assert found.status == Status.UNDECIDED
    assert found.reason.startswith(
        "the 8 frequencies of the response decide the stability of no wall; measure again from"
    )
    assert found.reason.endswith("with finer frequency spacing")
