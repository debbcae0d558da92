"""Test the safe limit of a scene: the walls it allows, its input forms, and its effect on recommendations."""

import re

import numpy as np
import pytest

import zwidth
from zwidth.studies.document import load_scene

LIMIT = zwidth.SafeLimit("484 N/m", "1.13 N s/m", reason="a resonance may hide in the log")
DEVICE, TIMING = zwidth.Device("80 g", 0.5), zwidth.Timing("1 ms", 0.7e-3)
SCENE = zwidth.Scene(DEVICE, TIMING, safe_limit=LIMIT)


@pytest.mark.parametrize(
    "wall, allowed",
    [
        ((484, 1.13), True),
        ((100, 1.13), True),
        ((242, 0.565), True),
        ((0, 0), True),
        ((485, 1.13), False),
        ((242, 0.5), False),
        ((100, 1.2), False),
        ((-1, 0.5), False),
        (("0.1 kN/m", "1130 mN s/m"), True),
        (("0.485 kN/m", 1.13), False),
    ],
)
def test_limit_allows_softer_and_scaled_walls(wall, allowed):
    assert LIMIT.allows(*wall) == allowed


def test_limit_with_zero_stiffness_allows_no_wall():
    no_wall = zwidth.SafeLimit(0, warnings=["turn the sign of the force"])
    assert no_wall.forbids_all
    assert not no_wall.allows(0, 0)
    recommendation = SCENE.replace(safe_limit=no_wall).recommend()
    assert recommendation.status == zwidth.Status.UNREACHABLE
    assert "turn the sign of the force" in recommendation.reason
    with pytest.raises(zwidth.InputError, match="turn the sign of the force"):
        recommendation.code("c")
    assert SCENE.replace(safe_limit=no_wall).recommend(beyond_safe=True).stiffness > 1e3


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"stiffness": -1}, "it must be >= 0"),
        ({"stiffness": 1, "warnings": 3}, "it must be a list of strings"),
        ({"stiffness": 1, "reason": 3}, "it must be a string"),
        ({"stiffness": "1 kg"}, "got '1 kg'"),
    ],
)
def test_invalid_limits_are_rejected(arguments, message):
    with pytest.raises(zwidth.InputError, match=re.escape(message)):
        zwidth.SafeLimit(**arguments)


def test_rotary_limit_requires_a_rotary_device():
    with pytest.raises(zwidth.InputError, match="safe_limit"):
        SCENE.replace(safe_limit=zwidth.SafeLimit("484 N m/rad"))
    rotary = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s/rad"), TIMING)
    limit = rotary.replace(safe_limit=zwidth.SafeLimit("484 mN m/rad")).safe_limit
    assert limit is not None
    assert limit.stiffness == 0.484


@pytest.mark.parametrize("change", [{"mass": 0.1}, {"rate": 2e3}, {"velocity": zwidth.LowPass(cutoff=100)}])
def test_changed_loop_keeps_the_limit_and_adds_a_warning(change):
    limit = SCENE.replace(**change).replace(**change).safe_limit
    assert limit is not None
    assert limit.allows(484, 1.13)
    (warning,) = limit.warnings
    assert warning.startswith(f"{next(iter(change))} changed after the safe limit was measured")
    assert SCENE.replace(stiffness=1e3, virtual_damping=2).safe_limit == LIMIT


@pytest.mark.parametrize(
    "requirements",
    [
        {},
        {"phase_margin": 30},
        {"gain_margin": 2},
        {"stiffness_fraction": 0.5},
        {"stiffness_fraction": 0.9},
        {"passive": True},
    ],
)
def test_recommendations_stay_within_the_limit(requirements):
    recommendation = SCENE.recommend(**requirements)
    assert recommendation.status == zwidth.Status.OK
    assert LIMIT.allows(recommendation.stiffness, recommendation.virtual_damping)
    assert recommendation.stiffness <= requirements.get("stiffness_fraction", 0.75) * 484
    assert any("a resonance may hide in the log" in note for note in recommendation.notes)
    # Without the limit each of these walls is stiffer, except the passive one.
    unlimited = SCENE.recommend(**requirements, beyond_safe=True)
    assert unlimited.stiffness > 2 * recommendation.stiffness or requirements == {"passive": True}
    assert unlimited.stiffness == pytest.approx(
        SCENE.replace(safe_limit=None).recommend(**requirements).stiffness, rel=1e-12
    )
    assert recommendation.improvements == []
    assert "limited by" in recommendation.lines()[0]
    assert "safe limit" in recommendation.lines()[0]


def test_inactive_limit_does_not_change_the_recommendation():
    unlimited = SCENE.replace(safe_limit=None).recommend()
    limited = SCENE.replace(safe_limit=zwidth.SafeLimit(16e3, 39.0)).recommend()
    assert (limited.stiffness, limited.virtual_damping) == pytest.approx(
        (unlimited.stiffness, unlimited.virtual_damping), rel=1e-3
    )
    assert limited.limited_by == unlimited.limited_by


def test_maximum_stiffness_and_verdicts_ignore_the_limit():
    unlimited = SCENE.replace(safe_limit=None)
    assert SCENE.max_stiffness() == unlimited.max_stiffness()
    assert SCENE.is_stable(5e3, 30)
    assert zwidth.assess(SCENE.replace(stiffness=5e3, virtual_damping=30)).stable


@pytest.mark.parametrize("language", ["c", "python"])
def test_programs_contain_the_limit_and_its_warnings(language):
    text = 'ends here */ """ \\'
    limit = zwidth.SafeLimit(484, 1.13, reason=text, warnings=["look at the log"])
    scene = SCENE.replace(safe_limit=limit)
    code = scene.recommend().code(language)
    assert "Safe limit: K = 484.0 N/m, B = 1.130 N s/m: ends here * /" in code
    assert "Warning: look at the log" in code
    assert "WARNING: this wall exceeds" not in code
    assert "WARNING: this wall exceeds the safe limit" in scene.recommend(beyond_safe=True).code(language)
    if language == "python":
        namespace = {}
        exec(code, namespace)
        assert namespace["Wall"]().force(0.0) == 0.0
    else:
        assert code.count("*/") == 1


def test_limit_is_read_from_a_configuration(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(
        "version: 1\nname: a\nscene:\n  mass: 80 g\n  damping: 0.5\n  period: 1 ms\n  delay: 0.7 ms\n  safe_limit:\n"
        "    stiffness: 0.484 kN/m\n    virtual_damping: 1.13 N s/m\n    reason: a resonance may hide in the log\n"
        "    warnings: [one, two]\nstudies: [{kind: recommend, name: r}, {kind: ridge, name: s, delta: 0, d: 1}]\n",
        encoding="utf-8",
    )
    limit = load_scene(file).safe_limit
    assert limit == zwidth.SafeLimit(484.0, 1.13, "a resonance may hide in the log", ("one", "two"))
    study = zwidth.load_config(file).studies[0]
    assert study.device.to_scene().safe_limit == limit  # pyright: ignore[reportAttributeAccessIssue]
    file.write_text(file.read_text("utf-8").replace("0.484 kN/m", "-1"), encoding="utf-8")
    with pytest.raises(zwidth.ConfigError, match=r"scene.safe_limit.stiffness: got -1"):
        load_scene(file)


@pytest.mark.parametrize("reserve", [0.6, "0.6 N s/m", "600 mN s/m", np.float64(0.6)])
def test_passive_recommendation_subtracts_the_damping_reserve(reserve):
    limit = zwidth.SafeLimit(15e3, 37.0, damping_reserve=reserve)
    assert limit.damping_reserve == 0.6
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing("1 ms", "1 ms"), safe_limit=limit)
    recommendation = scene.recommend(passive=True)
    margin = scene.passivity_margin(recommendation.stiffness, recommendation.virtual_damping)
    assert 0.6 <= margin < 0.601
    assert recommendation.spell_passive() == "yes"
    # Reference: Colgate's condition on a frequency grid for the device with the smallest damping; C includes the delay.
    wT = np.linspace(1e-4, np.pi, 20_001)
    C = (recommendation.stiffness + recommendation.virtual_damping * (1 - np.exp(-1j * wT)) / 1e-3) * np.exp(-1j * wT)
    required = 0.5e-3 / (1 - np.cos(wT)) * np.real((1 - np.exp(-1j * wT)) * C)
    assert 9.399 < required.max() <= 9.4
    unlimited = scene.recommend(passive=True, beyond_safe=True)
    assert scene.passivity_margin(unlimited.stiffness, unlimited.virtual_damping) < 0.1


def test_reserve_of_all_damping_leaves_no_passive_wall():
    limit = zwidth.SafeLimit(15e3, 37.0, damping_reserve=10)
    recommendation = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), safe_limit=limit).recommend(
        passive=True
    )
    assert recommendation.reason.startswith(
        "no wall is passive for certain, because the device may have no physical damping"
    )
    with pytest.raises(zwidth.InputError, match=r"safe_limit\.damping_reserve: got -1"):
        zwidth.SafeLimit(15e3, 37.0, damping_reserve=-1)
