"""The wall to set: the stiffest with all that is wanted, against walls on a grid judged one by one."""

import json
import re

import numpy as np
import pytest

import zwidth
from zwidth.analysis.cautions import find_thin
from zwidth.analysis.wall_search import Requirements
from zwidth.core.status import Status

TIMING = zwidth.Timing(1e-3, 1e-3)
RIGID = zwidth.Scene(zwidth.Device(0.1, 10.0), TIMING)
FILTERED = RIGID.replace(velocity=zwidth.LowPass(cutoff=100.0))
ISLANDS = RIGID.replace(velocity=zwidth.WindowedDifference(24))
KNOB = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s/rad"), zwidth.Timing(rate="1 kHz", delay="0.7 periods"))
TIP = zwidth.Scene(zwidth.Device(0.1, 10.0, zwidth.Coupling(0.05, 20e3, 1.0, "tip")), TIMING)


def keeps(scene, stiffness, damping, wanted):
    """By the margins that users ask for, of the walls that are stable: of them there are fewer."""
    damping = np.atleast_1d(damping)
    damping = damping[scene.is_stable(stiffness, damping)]
    margins, good = scene.margins(stiffness, damping), np.full(damping.shape, True)
    if "gain_margin" in wanted:
        good = good & (np.abs(np.log(margins.gain_margin)) >= np.log(wanted["gain_margin"]))
    if "phase_margin" in wanted:
        good = good & (margins.phase_margin >= wanted["phase_margin"])
    return good & scene.is_passive(stiffness, damping) if wanted.get("passive") else good


WANTED = [
    {"gain_margin": 2.0},
    {"phase_margin": 30.0},
    {"phase_margin": 60.0, "passive": True},
    {"passive": True},
    {"gain_margin": 3.0, "phase_margin": 20.0},
    {"gain_margin": 1.2, "stiffness_fraction": 0.95},
]


@pytest.mark.parametrize("wanted", WANTED, ids=str)
@pytest.mark.parametrize("device", [(0.1, 10.0, 1e-3), (0.37, 1.2, 1.7e-3), (0.05, 40.0, 0.0)], ids=str)
def test_no_stiffer_wall_has_what_is_wanted(device, wanted):
    mass, damping, delay = device
    scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(1e-3, delay))
    found, top = scene.recommend(**wanted), scene.max_stiffness().stiffness
    assert found.status == Status.OK
    assert keeps(scene, found.stiffness, found.virtual_damping, wanted)
    share = found.stiffness / top
    assert share <= wanted.get("stiffness_fraction", 1.0)
    if found.limited_by == "stiffness_fraction":
        assert found.stiffness == wanted["stiffness_fraction"] * top
        return
    assert found.limited_by in wanted
    units = scene.units
    dampings = np.linspace(-2.0, 3.0, 801) * units.virtual_damping
    for more in (1.001, 1.02, 1.1):
        assert not np.any(keeps(scene, more * found.stiffness, dampings, wanted)), more


@pytest.mark.parametrize("wanted", [{"gain_margin": 2.0}, {"phase_margin": 30.0, "passive": True}], ids=str)
def test_with_a_filter_no_stiffer_wall_has_what_is_wanted(wanted):
    found = FILTERED.recommend(**wanted)
    assert keeps(FILTERED, found.stiffness, found.virtual_damping, wanted)
    # A delay margin for each takes its time.
    dampings = np.linspace(0.0, 50.0, 21)
    assert not np.any(keeps(FILTERED, 1.003 * found.stiffness, dampings, wanted))


def test_a_gain_margin_alone_is_that_share_of_the_stiffest_wall():
    """The ray through the stiffest wall leaves the stable set there: K and B are both divided by the margin."""
    top, found = RIGID.max_stiffness(), RIGID.recommend(gain_margin=2.0)
    assert found.stiffness == pytest.approx(top.stiffness / 2, rel=2e-4)
    assert found.virtual_damping == pytest.approx(top.virtual_damping / 2, rel=2e-2)


def test_a_share_alone_has_the_damping_of_the_stiffest_wall():
    found, top = RIGID.recommend(stiffness_fraction=0.75), RIGID.max_stiffness()
    assert (found.stiffness, found.virtual_damping) == (0.75 * top.stiffness, top.virtual_damping)
    assert found.requirements == Requirements(0.75)
    assert found.limited_by == "stiffness_fraction"
    assert found.verdict == zwidth.assess(
        RIGID.replace(stiffness=found.stiffness, virtual_damping=found.virtual_damping)
    )


@pytest.mark.parametrize("delay", [0.0, 1e-3, 2.5e-3])
def test_a_passive_wall_is_as_stiff_as_the_device_is_damped(delay):
    """The condition is homogeneous in K, B and b (docs/theory/passivity.md), however little of a column is passive."""
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, delay))
    usual, weak = (scene.replace(damping=damping).recommend(passive=True) for damping in (10.0, 1e-3))
    assert weak.stiffness == pytest.approx(1e-4 * usual.stiffness, rel=1e-3)


def test_a_wall_that_damping_only_harms_has_none_at_all():
    scene = RIGID.replace(velocity=zwidth.WindowedDifference(samples=15))
    found = scene.recommend(gain_margin=2.0)
    assert found.virtual_damping == 0.0
    assert scene.margins(found.stiffness, 0.0).gain_margin == pytest.approx(2.0, rel=2e-4)
    assert scene.margins(found.stiffness, 0.1).gain_margin < 2.0
    assert "B = 0 N s/m" in found.lines()[0]


def test_a_device_on_a_spring_whose_soft_walls_have_margins_without_an_end():
    held = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3), operator=zwidth.Operator(0.0, 0.0, 1e6))
    found = held.recommend(phase_margin=30)
    assert held.margins(0.1 * found.stiffness, 0.1 * found.virtual_damping).phase_margin == np.inf
    assert held.margins(found.stiffness, found.virtual_damping).phase_margin >= 30
    stiffer = 1.0002 * found.stiffness
    low, high = held.stable_damping(stiffer)[0].tolist()
    dampings = np.linspace(low, high, 22)[1:-1]
    assert np.all(held.margins(stiffer, dampings).phase_margin < 30)


def test_a_margin_that_ends_all_of_a_sudden_does_not_keep_the_stiffest_wall_from_being_found():
    # Up to 0.98 of K_max the spring alone has no gain crossover, and a phase margin without an end.
    hand = zwidth.Operator(6.4e-6, 206.5, 2.8e7, coupling_stiffness=1.43e9, coupling_damping=8.03e5)
    timing, window = zwidth.Timing(6.608e-5, 1.98248e-4), zwidth.WindowedDifference(samples=7)
    held = zwidth.Scene(zwidth.Device(1.06, 181.0), timing, velocity=window, operator=hand)
    found = held.recommend(phase_margin=30)
    assert held.loop.margins(*held.normalize_walls(found.stiffness, 0.0), ["phase_margin"]).phase_margin >= 30
    assert found.stiffness > 0.9 * held.max_stiffness().stiffness


def test_the_wall_of_the_scene_does_not_matter():
    own = RIGID.replace(stiffness=1e3, virtual_damping=3.0).recommend(phase_margin=25)
    assert own.stiffness == RIGID.recommend(phase_margin=25).stiffness


def test_what_no_wall_has_is_said_and_leaves_no_wall():
    undamped = RIGID.replace(damping=0.0, delay=0.0)
    found = undamped.recommend(passive=True)
    assert found.status == Status.UNREACHABLE
    assert np.isnan(found.stiffness)
    assert found.verdict is None
    reason = "no passive wall exists, because the device has no physical damping"
    assert (found.reason, found.lines()) == (reason, (f"no wall: {reason}",))
    known = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert known["recommended"]["stiffness"] is None
    assert known["maximum"]["stiffness"] == undamped.max_stiffness().stiffness


@pytest.mark.parametrize("damping, delay", [(2, 1e-3), (8, 0), (10, 0.5e-3)])
def test_the_wall_that_is_printed_is_no_stiffer(damping, delay):
    scene = zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(period=1e-3, delay=delay))
    found = scene.recommend(passive=True)
    (K, B), *_ = re.findall("K = (.*?), B = (.*?):", found.lines()[0])
    assert found.stiffness * (1 - 1e-3) < zwidth.VirtualWall(K).stiffness <= found.stiffness
    assert scene.is_passive(K, B)


@pytest.mark.parametrize("share", [0.95, 0.99])
def test_a_wall_next_to_a_corner_is_stable_as_it_is_printed(share):
    """Strong damping without delay: its column ends so close to B that four digits of it lie beyond."""
    scene = zwidth.Scene(zwidth.Device(0.1, 20e3), zwidth.Timing(1e-3))
    found = scene.recommend(stiffness_fraction=share)
    (K, B), *_ = re.findall("K = (.*?), B = (.*?):", found.lines()[0])
    assert scene.is_stable(K, B)
    assert found.as_dict()["recommended"]["digits"] > 4


def test_steps_of_a_share_are_those_of_limits_that_help():
    found = ISLANDS.recommend(stiffness_fraction=0.5)
    steps = [(step.name, pytest.approx(step.gain, rel=1e-6)) for step in found.improvements]
    assert steps == [(limit.name, limit.gain) for limit in zwidth.limits_of(ISLANDS) if limit.gain > 1]
    assert "island of stable walls" in found.notes[0]
    assert not any("64" in step.label for step in found.improvements)


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"gain_margin": 1.0}, "gain_margin: got 1.0; a number greater than 1 is needed"),
        ({"phase_margin": 180}, "phase_margin: got 180; a number greater than 0 and less than 180 is needed"),
        ({"phase_margin": "30"}, "phase_margin: got '30'"),
        ({"stiffness_fraction": 1.5}, "stiffness_fraction: got 1.5; a number greater than 0 and less than 1"),
        ({"stiffness_fraction": True}, "stiffness_fraction: got True"),
        ({"passive": "yes"}, "passive: got 'yes'; True or False is needed"),
    ],
)
def test_wrong_wishes_are_refused(wanted, message):
    with pytest.raises(zwidth.InputError, match=message.replace("(", r"\(")):
        RIGID.recommend(**wanted)


def test_scenes_without_an_answer_say_why():
    with pytest.raises(zwidth.InputError, match="with the sensor at the tip: there is no passivity condition"):
        TIP.recommend(passive=True)
    with pytest.raises(zwidth.InputError, match="FOAW has no linear form"):
        RIGID.replace(velocity=zwidth.FOAW(1e-6)).recommend()


@pytest.mark.parametrize(
    ("scene", "wanted"),
    [(RIGID, {}), (RIGID, {"passive": True}), (FILTERED, {}), (KNOB, {"phase_margin": 40})],
    ids=["default", "passive", "filter", "knob"],
)
def test_steps_are_those_of_the_wall_recommended_again(scene, wanted):
    """Each improvement typed as a user would, and the same question asked again."""
    found = scene.recommend(**wanted)
    changed = {
        "delay": {"delay": scene.timing.delay / 2},
        "damping": {"damping": 1.1 * scene.device.damping},
        "period": {"rate": 2 / scene.timing.period},
        "velocity": {"velocity": zwidth.LowPass(cutoff=200.0)},
    }
    assert found.improvements
    for step in found.improvements:
        if step.name in changed:
            again = scene.replace(**changed[step.name]).recommend(**wanted)
            assert step.gain == pytest.approx(again.stiffness / found.stiffness, rel=5e-3)
            assert step.stiffness == pytest.approx(again.stiffness, rel=5e-3)
    gains = {step.name: step.gain for step in found.improvements}
    if scene.timing.in_periods:
        assert "period_and_delay" not in gains
    elif not wanted.get("passive"):
        kept = scene.replace(timing=zwidth.Timing(rate=2e3, delay="1 periods")).recommend(**wanted)
        assert gains["period_and_delay"] == pytest.approx(kept.stiffness / found.stiffness, rel=5e-3)


def test_steps_of_a_passive_wall_of_the_readme_device():
    """K_max gains 1.72 by half the delay and 1.03 by a tenth more damping; the passive wall 1.42 and 1.10."""
    gains = {step.name: step.gain for step in RIGID.recommend(passive=True).improvements}
    assert gains["delay"] == pytest.approx(1.42, abs=0.01)
    assert gains["damping"] == pytest.approx(1.10, abs=0.005)
    assert gains["period"] == pytest.approx(1.29, abs=0.01)


def test_the_default_asks_for_margins():
    for scene in (RIGID, FILTERED, KNOB):
        found = scene.recommend()
        assert found.requirements == Requirements(0.75, 2.0, 30.0, grasps="soft")
        margins = scene.margins(found.stiffness, found.virtual_damping)
        assert margins.phase_margin >= 30
        assert margins.gain_margin >= 2
        assert found.stiffness <= 0.75 * found.stiffest.stiffness
        assert found.verdict is not None
        assert not find_thin(found.verdict, scene.timing.period)
        assert all(stable for name, stable in found.grasps.items() if name.startswith("soft"))
    # Any requirement replaces the defaults.
    assert RIGID.recommend(phase_margin=20).requirements == Requirements(None, None, 20)


def test_a_wall_on_the_brink_carries_a_caution_with_a_remedy_that_holds():
    thin = [{"passive": True}, {"stiffness_fraction": 0.95}, {"phase_margin": 5}]
    for scene, wishes in ((RIGID, thin), (FILTERED, thin[1:2]), (KNOB, thin[:1])):
        for wanted in wishes:
            found = scene.recommend(**wanted)
            assert found.cautions, wanted
            match = re.search(r"use recommend (.*?) \(costs (\S+) %", found.cautions[0])
            assert match is not None
            asked, cost = match.groups()
            more = dict(wanted)
            for name, value in re.findall(r"--(\S+) ([\d.]+)", asked):
                more[name.replace("-", "_")] = float(value)
            if "without --passive" in asked:
                del more["passive"]
            again = scene.recommend(**more)
            assert again.verdict is not None
            assert not find_thin(again.verdict, scene.timing.period)
            assert abs(1 - again.stiffness / found.stiffness) == pytest.approx(float(cost) / 100, abs=0.006)


def test_grasps_that_destabilize_a_wall_are_named_with_a_wall_that_none_destabilizes():
    """The grasp of 10 kN/m and 1 N s/m destabilizes three quarters of K_max of this device."""
    scene = zwidth.Scene(zwidth.Device(0.1, 1), zwidth.Timing(rate="1 kHz", delay="1 periods"))
    found = scene.recommend(stiffness_fraction=0.75)
    hand = {"mass": 0.554, "damping": 6.45, "stiffness": 135, "coupling_stiffness": "10 kN/m", "coupling_damping": 1}
    held = scene.replace(operator=zwidth.Operator(**hand))
    assert not held.is_stable(found.stiffness, found.virtual_damping)
    assert [name for name, stable in found.grasps.items() if not stable] == ["firm, light damping"]
    wall = r"in the hand \(firm, light damping\); use recommend --grasps all: K = (.*?), B = (.*?) \(costs"
    match = re.search(wall, found.cautions[1])
    assert match is not None
    K, B = match.groups()
    assert all(scene.replace(operator=grasp).is_stable(K, B) for grasp in zwidth.reference_grasps().values())
    assert all(scene.recommend().grasps.values())
    all_grasps = scene.recommend(stiffness_fraction=0.75, grasps="all")
    assert all_grasps.limited_by == "grasps"
    assert all(all_grasps.grasps.values())
    assert all_grasps.stiffness == pytest.approx(float(K.split()[0]) * 1e3, rel=2e-3)
    assert scene.recommend(grasps="none").requirements == Requirements(0.75, 2.0, 30.0)


def test_grasps_need_a_device_with_a_mass():
    model = zwidth.Scene(zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0])), zwidth.Timing(1e-3, 1e-3))
    with pytest.raises(zwidth.InputError, match=r"^grasps: got 'all', but"):
        model.recommend(grasps="all")
    with pytest.raises(zwidth.InputError, match=r"^grasps: "):
        RIGID.recommend(grasps="hard")  # pyright: ignore[reportArgumentType]
    assert model.recommend(grasps="none").stiffness == model.recommend().stiffness


def test_a_wall_that_only_the_hand_of_the_scene_stabilizes():
    hand = zwidth.Operator(0.554, 6.45, 135)
    found = RIGID.replace(operator=hand).recommend()
    assert found.stiffness > RIGID.max_stiffness().stiffness
    assert found.grasps["released"] is False
    assert "released" in found.cautions[0]


def test_the_default_is_stable_in_the_soft_grasps():
    """With its margins alone, the wall of this rotary device is unstable in a soft grasp at a radius of 15.6 mm."""
    wheel = zwidth.Device(6.985644e-06, 1.287484e-05, rotary=True)
    light = zwidth.Scene(wheel, zwidth.Timing(period=2.8694769e-3, delay="3 periods"))
    held = light.replace(operator=zwidth.reference_grasps("15.62 mm")["soft, light damping"])
    free = light.recommend(phase_margin=30, gain_margin=2, stiffness_fraction=0.75)
    assert not held.is_stable(free.stiffness, free.virtual_damping)
    found = light.recommend()
    assert found.limited_by == "grasps"
    for radius in (0.0101, 0.0156, 0.03, 0.1):
        for name, grasp in zwidth.reference_grasps(radius).items():
            held = light.replace(operator=grasp).is_stable(found.stiffness, found.virtual_damping)
            assert held or name.startswith("firm"), (radius, name)


def test_a_limit_met_exactly_during_the_search_does_not_end_it():
    # At B = 0 a gain margin of 2 is half of K_max: the second stiffness tried leaves a slack of -3e-16.
    device = zwidth.Device(1.7478657475046673e-06, 1.1 * 0.006315271246825399, rotary=True)
    velocity = zwidth.Butterworth(cutoff=79.4335656705188)
    found = zwidth.Scene(device, zwidth.Timing(0.0004620892004257242, "1 periods"), velocity=velocity).recommend()
    assert found.limited_by == "gain_margin"
    assert found.stiffness == pytest.approx(0.5 * float(found.stiffest.stiffness), rel=1e-4)


@pytest.mark.parametrize("seed", [43, 64])
def test_the_printed_range_of_damping_contains_the_printed_damping(seed):
    rng = np.random.default_rng(seed)
    lines = int(rng.choice([10, 10, 20, 60, 400]))
    mass = 10 ** rng.uniform(-1.5, 0.3)
    damping, delay = mass * 10 ** rng.uniform(0, 2), rng.uniform(0, 2) * 1e-3
    hertz = np.geomspace(1, 490, lines)
    s = 2j * np.pi * hertz
    device = zwidth.MeasuredDevice(hertz, np.exp(-s * delay) / (mass * s**2 + damping * s))
    wanted = 5.0 if seed == 43 else None
    found = zwidth.Scene(device, zwidth.Timing(1e-3)).recommend(phase_margin=wanted)
    printed = re.search(r"B from (\S+)(?: N s/m)? to (\S+) N s/m is stable", found.lines()[1])
    assert printed is not None
    assert float(printed[1]) <= found.rounded_wall[1] <= float(printed[2])
    assert found.scene.is_stable(*found.rounded_wall[:2])
