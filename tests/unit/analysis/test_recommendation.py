"""Test `Scene.recommend`, the stiffest wall that satisfies the requirements, against margins of the walls on a grid."""

import json
import re

import numpy as np
import pytest

import zwidth
from zwidth.analysis.cautions import find_thin
from zwidth.analysis.wall_search import Requirements
from zwidth.core.status import Status

pytestmark = pytest.mark.usefixtures("fitted_once")
TIMING = zwidth.Timing(1e-3, 1e-3)
RIGID = zwidth.Scene(zwidth.Device(0.1, 10.0), TIMING)
FILTERED = RIGID.replace(velocity=zwidth.LowPass(cutoff=100.0))
ISLANDS = RIGID.replace(velocity=zwidth.WindowedDifference(24))
KNOB = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s/rad"), zwidth.Timing(rate="1 kHz", delay="0.7 periods"))
TIP = zwidth.Scene(zwidth.Device(0.1, 10.0, zwidth.Coupling(0.05, 20e3, 1.0, "tip")), TIMING)


def satisfy_requirements(scene, stiffness, damping, wanted):
    """Return, for each stable wall of the given dampings, whether its margins satisfy the requirements."""
    damping = np.atleast_1d(damping)
    damping = damping[scene.is_stable(stiffness, damping)]
    margins, good = scene.margins(stiffness, damping), np.full(damping.shape, True)
    if "gain_margin" in wanted:
        good = good & (np.abs(np.log(margins.gain_margin)) >= np.log(wanted["gain_margin"]))
    if "phase_margin" in wanted:
        good = good & (margins.phase_margin >= wanted["phase_margin"])
    return good & scene.is_passive(stiffness, damping) if wanted.get("passive") else good


REQUIREMENTS = [
    {"gain_margin": 2.0},
    {"phase_margin": 30.0},
    {"phase_margin": 60.0, "passive": True},
    {"passive": True},
    {"gain_margin": 3.0, "phase_margin": 20.0},
    {"gain_margin": 1.2, "stiffness_fraction": 0.95},
]


@pytest.mark.parametrize("wanted", REQUIREMENTS, ids=str)
@pytest.mark.parametrize("device", [(0.1, 10.0, 1e-3), (0.37, 1.2, 1.7e-3), (0.05, 40.0, 0.0)], ids=str)
def test_no_stiffer_wall_on_a_grid_satisfies_requirements(device, wanted):
    mass, damping, delay = device
    scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(1e-3, delay))
    recommendation, top = scene.recommend(**wanted), scene.max_stiffness().stiffness
    assert recommendation.status == Status.OK
    assert satisfy_requirements(scene, recommendation.stiffness, recommendation.virtual_damping, wanted)
    fraction = recommendation.stiffness / top
    assert fraction <= wanted.get("stiffness_fraction", 1.0)
    if recommendation.limited_by == "stiffness_fraction":
        assert recommendation.stiffness == wanted["stiffness_fraction"] * top
        return
    assert recommendation.limited_by in wanted
    units = scene.units
    dampings = np.linspace(-2.0, 3.0, 801) * units.virtual_damping
    for factor in (1.001, 1.02, 1.1):
        assert not np.any(satisfy_requirements(scene, factor * recommendation.stiffness, dampings, wanted)), factor


@pytest.mark.parametrize("wanted", [{"gain_margin": 2.0}, {"phase_margin": 30.0, "passive": True}], ids=str)
def test_no_stiffer_wall_satisfies_requirements_with_filter(wanted):
    recommendation = FILTERED.recommend(**wanted)
    assert satisfy_requirements(FILTERED, recommendation.stiffness, recommendation.virtual_damping, wanted)
    # A coarse grid, because each wall needs its delay margin.
    dampings = np.linspace(0.0, 50.0, 21)
    assert not np.any(satisfy_requirements(FILTERED, 1.003 * recommendation.stiffness, dampings, wanted))


def test_gain_margin_only_divides_the_maximum_stiffness():
    """The ray through the stiffest wall leaves the stable set there: both K and B are divided by the margin."""
    top, recommendation = RIGID.max_stiffness(), RIGID.recommend(gain_margin=2.0)
    assert recommendation.stiffness == pytest.approx(top.stiffness / 2, rel=2e-4)
    assert recommendation.virtual_damping == pytest.approx(top.virtual_damping / 2, rel=2e-2)


def test_stiffness_fraction_only_keeps_damping_of_stiffest_wall():
    recommendation, top = RIGID.recommend(stiffness_fraction=0.75), RIGID.max_stiffness()
    assert (recommendation.stiffness, recommendation.virtual_damping) == (0.75 * top.stiffness, top.virtual_damping)
    assert recommendation.requirements == Requirements(0.75)
    assert recommendation.limited_by == "stiffness_fraction"
    assert recommendation.verdict == zwidth.assess(
        RIGID.replace(stiffness=recommendation.stiffness, virtual_damping=recommendation.virtual_damping)
    )


@pytest.mark.parametrize("delay", [0.0, 1e-3, 2.5e-3])
def test_passive_stiffness_is_proportional_to_device_damping(delay):
    """The passivity condition is homogeneous in K, B and b (docs/theory/passivity.md)."""
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, delay))
    usual, weak = (scene.replace(damping=damping).recommend(passive=True) for damping in (10.0, 1e-3))
    assert weak.stiffness == pytest.approx(1e-4 * usual.stiffness, rel=1e-3)


def test_recommended_damping_is_zero_if_damping_reduces_the_gain_margin():
    scene = RIGID.replace(velocity=zwidth.WindowedDifference(samples=15))
    recommendation = scene.recommend(gain_margin=2.0)
    assert recommendation.virtual_damping == 0.0
    assert scene.margins(recommendation.stiffness, 0.0).gain_margin == pytest.approx(2.0, rel=2e-4)
    assert scene.margins(recommendation.stiffness, 0.1).gain_margin < 2.0
    assert "B = 0 N s/m" in recommendation.lines()[0]


def test_phase_margin_of_device_on_stiff_spring_infinite_for_soft_walls():
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3), operator=zwidth.Operator(0.0, 0.0, 1e6))
    recommendation = scene.recommend(phase_margin=30)
    assert scene.margins(0.1 * recommendation.stiffness, 0.1 * recommendation.virtual_damping).phase_margin == np.inf
    assert scene.margins(recommendation.stiffness, recommendation.virtual_damping).phase_margin >= 30
    stiffer = 1.0002 * recommendation.stiffness
    low, high = scene.stable_damping(stiffer)[0].tolist()
    dampings = np.linspace(low, high, 22)[1:-1]
    assert np.all(scene.margins(stiffer, dampings).phase_margin < 30)


def test_discontinuous_phase_margin_does_not_stop_the_search():
    # Up to 0.98 of K_max a wall without damping has no gain crossover, hence an infinite phase margin.
    hand = zwidth.Operator(6.4e-6, 206.5, 2.8e7, coupling_stiffness=1.43e9, coupling_damping=8.03e5)
    timing, window = zwidth.Timing(6.608e-5, 1.98248e-4), zwidth.WindowedDifference(samples=7)
    scene = zwidth.Scene(zwidth.Device(1.06, 181.0), timing, velocity=window, operator=hand)
    recommendation = scene.recommend(phase_margin=30)
    assert (
        scene.loop.margins(*scene.normalize_walls(recommendation.stiffness, 0.0), ["phase_margin"]).phase_margin >= 30
    )
    assert recommendation.stiffness > 0.9 * scene.max_stiffness().stiffness


def test_recommendation_ignores_the_wall_of_the_scene():
    with_wall = RIGID.replace(stiffness=1e3, virtual_damping=3.0).recommend(phase_margin=25)
    assert with_wall.stiffness == RIGID.recommend(phase_margin=25).stiffness


def test_unreachable_requirement_yields_reason_and_no_wall():
    undamped = RIGID.replace(damping=0.0, delay=0.0)
    recommendation = undamped.recommend(passive=True)
    assert recommendation.status == Status.UNREACHABLE
    assert np.isnan(recommendation.stiffness)
    assert recommendation.verdict is None
    reason = "no passive wall exists, because the device has no physical damping"
    assert (recommendation.reason, recommendation.lines()) == (reason, (f"no wall: {reason}",))
    record = json.loads(json.dumps(recommendation.as_dict(), allow_nan=False))
    assert record["recommended"]["stiffness"] is None
    assert record["maximum"]["stiffness"] == undamped.max_stiffness().stiffness


@pytest.mark.parametrize("damping, delay", [(2, 1e-3), (8, 0), (10, 0.5e-3)])
def test_printed_wall_is_not_stiffer_than_recommended(damping, delay):
    scene = zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(period=1e-3, delay=delay))
    recommendation = scene.recommend(passive=True)
    (K, B), *_ = re.findall("K = (.*?), B = (.*?):", recommendation.lines()[0])
    assert recommendation.stiffness * (1 - 1e-3) < zwidth.VirtualWall(K).stiffness <= recommendation.stiffness
    assert scene.is_passive(K, B)


@pytest.mark.parametrize("share", [0.95, 0.99])
def test_printed_wall_next_to_corner_is_stable(share):
    """At strong damping without delay, B is so close to an end of its stable range that four digits do not suffice."""
    scene = zwidth.Scene(zwidth.Device(0.1, 20e3), zwidth.Timing(1e-3))
    recommendation = scene.recommend(stiffness_fraction=share)
    (K, B), *_ = re.findall("K = (.*?), B = (.*?):", recommendation.lines()[0])
    assert scene.is_stable(K, B)
    assert recommendation.as_dict()["recommended"]["digits"] > 4


def test_improvements_of_stiffness_fraction_are_limits_with_gain():
    recommendation = ISLANDS.recommend(stiffness_fraction=0.5)
    steps = [(step.name, pytest.approx(step.gain, rel=1e-6)) for step in recommendation.improvements]
    assert steps == [(limit.name, limit.gain) for limit in zwidth.limits_of(ISLANDS) if limit.gain > 1]
    assert "island of stable walls" in recommendation.notes[0]
    assert not any("64" in step.label for step in recommendation.improvements)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"gain_margin": 1.0}, "gain_margin: got 1.0; a number greater than 1 is needed"),
        ({"phase_margin": 180}, "phase_margin: got 180; a number greater than 0 and less than 180 is needed"),
        ({"phase_margin": "30 N"}, "phase_margin: got '30 N'"),
        ({"stiffness_fraction": 1.5}, "stiffness_fraction: got 1.5; a number greater than 0 and less than 1"),
        ({"stiffness_fraction": True}, "stiffness_fraction: got True"),
        ({"passive": "yes"}, "passive: got 'yes'; True or False is needed"),
    ],
)
def test_invalid_requirements_are_rejected(wanted, message):
    with pytest.raises(zwidth.InputError, match=message.replace("(", r"\(")):
        RIGID.recommend(**wanted)


def test_scenes_without_recommendation_are_rejected_with_reason():
    with pytest.raises(zwidth.InputError, match="with the sensor at the tip: there is no passivity condition"):
        TIP.recommend(passive=True)
    with pytest.raises(zwidth.InputError, match="FOAW has no linear form"):
        RIGID.replace(velocity=zwidth.FOAW(1e-6)).recommend()


@pytest.mark.parametrize(
    ("scene", "wanted"),
    [(RIGID, {}), (RIGID, {"passive": True}), (FILTERED, {}), (KNOB, {"phase_margin": 40})],
    ids=["default", "passive", "filter", "knob"],
)
def test_gains_of_improvements_match_new_recommendations(scene, wanted):
    """Apply each improvement to the scene as a user would, and recommend again."""
    recommendation = scene.recommend(**wanted)
    changed = {
        "delay": {"delay": scene.timing.delay / 2},
        "damping": {"damping": 1.1 * scene.device.damping},
        "period": {"rate": 2 / scene.timing.period},
        "velocity": {"velocity": zwidth.LowPass(cutoff=200.0)},
    }
    assert recommendation.improvements
    for step in recommendation.improvements:
        if step.name in changed:
            again = scene.replace(**changed[step.name]).recommend(**wanted)
            assert step.gain == pytest.approx(again.stiffness / recommendation.stiffness, rel=5e-3)
            assert step.stiffness == pytest.approx(again.stiffness, rel=5e-3)
    gains = {step.name: step.gain for step in recommendation.improvements}
    if scene.timing.in_periods:
        assert "period_and_delay" not in gains
    elif not wanted.get("passive"):
        kept = scene.replace(timing=zwidth.Timing(rate=2e3, delay="1 periods")).recommend(**wanted)
        assert gains["period_and_delay"] == pytest.approx(kept.stiffness / recommendation.stiffness, rel=5e-3)


def test_gains_of_improvements_for_passive_wall_of_readme_device():
    """Half the delay raises K_max by 1.72 and the passive stiffness by 1.42; 10 % more damping by 1.03 and 1.10."""
    gains = {step.name: step.gain for step in RIGID.recommend(passive=True).improvements}
    assert gains["delay"] == pytest.approx(1.42, abs=0.01)
    assert gains["damping"] == pytest.approx(1.10, abs=0.005)
    assert gains["period"] == pytest.approx(1.29, abs=0.01)


def test_default_requirements_are_margins():
    for scene in (RIGID, FILTERED, KNOB):
        recommendation = scene.recommend()
        assert recommendation.requirements == Requirements(0.75, 2.0, 30.0, grasps="soft")
        margins = scene.margins(recommendation.stiffness, recommendation.virtual_damping)
        assert margins.phase_margin >= 30
        assert margins.gain_margin >= 2
        assert recommendation.stiffness <= 0.75 * recommendation.stiffest.stiffness
        assert recommendation.verdict is not None
        assert not find_thin(recommendation.verdict, scene.timing.period)
        assert all(stable for name, stable in recommendation.grasps.items() if name.startswith("soft"))
    # Any explicit requirement replaces the defaults.
    assert RIGID.recommend(phase_margin=20).requirements == Requirements(None, None, 20)


def test_caution_about_thin_margins_suggests_sufficient_requirements():
    thin = [{"passive": True}, {"stiffness_fraction": 0.95}, {"phase_margin": 5}]
    for scene, requirements in ((RIGID, thin), (FILTERED, thin[1:2]), (KNOB, thin[:1])):
        for wanted in requirements:
            recommendation = scene.recommend(**wanted)
            assert recommendation.cautions, wanted
            match = re.search(r"use recommend (.*?) \(costs (\S+) %", recommendation.cautions[0])
            assert match is not None
            options, cost = match.groups()
            changed = dict(wanted)
            for name, value in re.findall(r"--(\S+) ([\d.]+)", options):
                changed[name.replace("-", "_")] = float(value)
            if "without --passive" in options:
                del changed["passive"]
            again = scene.recommend(**changed)
            assert again.verdict is not None
            assert not find_thin(again.verdict, scene.timing.period)
            assert abs(1 - again.stiffness / recommendation.stiffness) == pytest.approx(float(cost) / 100, abs=0.006)


def test_destabilizing_grasps_are_reported_with_an_alternative_wall():
    """A grasp of 10 kN/m and 1 N s/m destabilizes the wall at three quarters of K_max of this device."""
    scene = zwidth.Scene(zwidth.Device(0.1, 1), zwidth.Timing(rate="1 kHz", delay="1 periods"))
    recommendation = scene.recommend(stiffness_fraction=0.75)
    hand = {"mass": 0.554, "damping": 6.45, "stiffness": 135, "coupling_stiffness": "10 kN/m", "coupling_damping": 1}
    held = scene.replace(operator=zwidth.Operator(**hand))
    assert not held.is_stable(recommendation.stiffness, recommendation.virtual_damping)
    assert [name for name, stable in recommendation.grasps.items() if not stable] == ["firm, light damping"]
    wall = r"in the hand \(firm, light damping\); use recommend --grasps all: K = (.*?), B = (.*?) \(costs"
    match = re.search(wall, recommendation.cautions[1])
    assert match is not None
    K, B = match.groups()
    assert all(scene.replace(operator=grasp).is_stable(K, B) for grasp in zwidth.reference_grasps().values())
    assert all(scene.recommend().grasps.values())
    all_grasps = scene.recommend(stiffness_fraction=0.75, grasps="all")
    assert all_grasps.limited_by == "grasps"
    assert all(all_grasps.grasps.values())
    assert all_grasps.stiffness == pytest.approx(float(K.split()[0]) * 1e3, rel=2e-3)
    assert scene.recommend(grasps="none").requirements == Requirements(0.75, 2.0, 30.0)


def test_grasps_require_a_device_with_mass():
    model = zwidth.Scene(zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0])), zwidth.Timing(1e-3, 1e-3))
    with pytest.raises(zwidth.InputError, match=r"^grasps: got 'all', but"):
        model.recommend(grasps="all")
    with pytest.raises(zwidth.InputError, match=r"^grasps: "):
        RIGID.recommend(grasps="hard")  # pyright: ignore[reportArgumentType]
    assert model.recommend(grasps="none").stiffness == model.recommend().stiffness


def test_wall_stabilized_only_by_the_operator_is_reported():
    hand = zwidth.Operator(0.554, 6.45, 135)
    recommendation = RIGID.replace(operator=hand).recommend()
    assert recommendation.stiffness > RIGID.max_stiffness().stiffness
    assert recommendation.grasps["released"] is False
    assert "released" in recommendation.cautions[0]


def test_default_recommendation_is_stable_in_soft_grasps():
    """With margins only, the wall of this rotary device is unstable in a soft grasp at a radius of 15.6 mm."""
    wheel = zwidth.Device(6.985644e-06, 1.287484e-05, rotary=True)
    light = zwidth.Scene(wheel, zwidth.Timing(period=2.8694769e-3, delay="3 periods"))
    gripped = light.replace(operator=zwidth.reference_grasps("15.62 mm")["soft, light damping"])
    free = light.recommend(phase_margin=30, gain_margin=2, stiffness_fraction=0.75)
    assert not gripped.is_stable(free.stiffness, free.virtual_damping)
    recommendation = light.recommend()
    assert recommendation.limited_by == "grasps"
    for radius in (0.0101, 0.0156, 0.03, 0.1):
        for name, grasp in zwidth.reference_grasps(radius).items():
            stays_stable = light.replace(operator=grasp).is_stable(
                recommendation.stiffness, recommendation.virtual_damping
            )
            assert stays_stable or name.startswith("firm"), (radius, name)


def test_search_continues_after_a_limit_is_met_exactly():
    # At B = 0 a gain margin of 2 halves K_max: the second stiffness of the search has a slack of -3e-16.
    device = zwidth.Device(1.7478657475046673e-06, 1.1 * 0.006315271246825399, rotary=True)
    velocity = zwidth.Butterworth(cutoff=79.4335656705188)
    recommendation = zwidth.Scene(
        device, zwidth.Timing(0.0004620892004257242, "1 periods"), velocity=velocity
    ).recommend()
    assert recommendation.limited_by == "gain_margin"
    assert recommendation.stiffness == pytest.approx(0.5 * float(recommendation.stiffest.stiffness), rel=1e-4)


@pytest.mark.parametrize("seed", [43, 64])
def test_printed_damping_range_contains_printed_damping(seed):
    rng = np.random.default_rng(seed)
    lines = int(rng.choice([10, 10, 20, 60, 400]))
    mass = 10 ** rng.uniform(-1.5, 0.3)
    damping, delay = mass * 10 ** rng.uniform(0, 2), rng.uniform(0, 2) * 1e-3
    hertz = np.geomspace(1, 490, lines)
    s = 2j * np.pi * hertz
    device = zwidth.MeasuredDevice(hertz, np.exp(-s * delay) / (mass * s**2 + damping * s))
    wanted = 5.0 if seed == 43 else None
    recommendation = zwidth.Scene(device, zwidth.Timing(1e-3)).recommend(phase_margin=wanted)
    printed = re.search(r"B from (\S+)(?: N s/m)? to (\S+) N s/m is stable", recommendation.lines()[1])
    assert printed is not None
    assert float(printed[1]) <= recommendation.rounded_wall[1] <= float(printed[2])
    assert recommendation.scene.is_stable(*recommendation.rounded_wall[:2])
