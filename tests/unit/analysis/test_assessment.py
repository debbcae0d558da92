"""Test `zwidth.assess` and `assess_many`: margins, passivity and marginal walls.

References: a frequency scan of Colgate's condition, and eigenvalues of a state-space model.
"""

import csv
import dataclasses
import io
import math

import numpy as np
import pytest
from any_loop import closed_loop_matrix

import zwidth
from zwidth.core.errors import InputError

DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3)
WALL = zwidth.VirtualWall(3e3, 5)
SLOW = zwidth.LowPass(cutoff=100)
HAND = zwidth.Operator(0.5, 0, 100)
FREE_PARTS = {
    "rigid": {},
    "filter": {"velocity": SLOW},
    "hand": {"operator": zwidth.Operator(0.5, 0, 0, 1000, 2)},
    "delayed": {"timing": zwidth.Timing(1e-3, 1.4e-3)},
    "coupling": {"device": zwidth.Device(0.1, 0, zwidth.Coupling(0.05, 20e3, 1))},
}


def free_scene(name, stiffness, damping):
    parts = {"device": zwidth.Device(0.1, 0.0), "timing": zwidth.Timing(1e-3), **FREE_PARTS[name]}
    return zwidth.Scene(**parts, wall=zwidth.VirtualWall(stiffness, damping))


@pytest.mark.parametrize("parts", [{"velocity": SLOW}, {"operator": HAND}], ids=["filter", "hand"])
def test_assess_reports_margins_and_passivity_of_the_scene(parts):
    scene = zwidth.Scene(DEVICE, TIMING, WALL, **parts)
    verdict, expected = zwidth.assess(scene), scene.margins(3e3, 5)
    for name in ("gain_margin", "phase_margin", "delay_margin", "modulus_margin", "gain_crossover", "phase_crossover"):
        assert getattr(verdict, name) == getattr(expected, name)
    assert verdict.passivity_margin == scene.passivity_margin(3e3, 5)
    assert verdict.passive == bool(scene.is_passive(3e3, 5))


def test_passivity_is_undefined_with_sensor_at_tip():
    coupling = zwidth.Coupling(0.05, 20e3, 1, sensor="tip")
    verdict = zwidth.assess(zwidth.Scene(zwidth.Device(0.1, 10, coupling), TIMING, WALL))
    assert verdict.passive is None
    assert math.isnan(verdict.passivity_margin)
    assert verdict.as_dict()["passivity_margin"] is None
    assert verdict.gain_margin > 0


@pytest.mark.parametrize("parts", [{}, {"velocity": SLOW}, {"operator": HAND}], ids=["rigid", "filter", "hand"])
@pytest.mark.parametrize("wall", [(3e3, 5.0), (60e3, 5.0), (3e3, 900.0)])
def test_assess_reports_stable_intervals_and_nearest_limits(parts, wall):
    scene = zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(*wall), **parts)
    verdict = zwidth.assess(scene)
    interval_lists = verdict.stable_stiffness, verdict.stable_damping
    for reported, expected in zip(interval_lists, (scene.stable_stiffness(), scene.stable_damping()), strict=True):
        np.testing.assert_allclose(np.reshape(reported, (-1, 2)), expected, rtol=1e-9, atol=1e-9)
    ends = (verdict.stiffness_limit,), (verdict.virtual_damping_lower, verdict.virtual_damping_upper)
    for value, intervals, reported in zip(wall, interval_lists, ends, strict=True):
        assert np.all(np.isnan(reported)) == (not intervals)
        if intervals:
            assert any(reported == ends[-len(reported) :] for ends in intervals)
        assert verdict.stable == any(low < value < high for low, high in intervals)


@pytest.mark.parametrize("name", FREE_PARTS)
def test_pure_damper_is_marginal(name):
    scene = free_scene(name, 0.0, 5.0)
    verdict = zwidth.assess(scene)
    sizes = np.sort(np.abs(np.linalg.eigvals(closed_loop_matrix(scene, 0.0, 5.0))))
    # An independent state-space matrix has one pole at z = 1 and the others inside the unit circle.
    assert sizes[-1] == pytest.approx(1.0, abs=1e-9)
    assert sizes[-2] < 1 - 1e-6
    assert verdict.marginal
    assert not verdict.stable
    assert (verdict.spectral_radius, verdict.decay_rate, verdict.frequency) == (1.0, 0.0, 0.0)
    assert verdict.time_constant == math.inf


@pytest.mark.parametrize("name", FREE_PARTS)
@pytest.mark.parametrize("wall", [(0.0, 3e3), (0.0, 0.0), (0.0, -5.0), (50.0, 5.0)])
def test_other_walls_are_not_marginal(name, wall):
    # Too much damping, none (two poles at z = 1) and negative damping; the wall with stiffness is stable.
    verdict = zwidth.assess(free_scene(name, *wall))
    assert not verdict.marginal
    assert verdict.stable == (wall[0] > 0)


@pytest.mark.parametrize("name", ["rigid", "filter", "delayed"])
@pytest.mark.parametrize("damping", [0.3, 1.0, 7.7, 10.0])
def test_wall_that_cancels_all_damping_is_not_marginal(name, damping):
    # Rounding errors may split the double pole at z = 1 into one at 1 and one slightly inside; the device drifts.
    for is_marginal, share in ((False, 1.0), (True, 0.999)):
        scene = dataclasses.replace(free_scene(name, 0.0, -share * damping), device=zwidth.Device(0.1, damping))
        assert zwidth.assess(scene).marginal is is_marginal


@pytest.mark.parametrize("delay", [0.0, 1e-3, 1.4e-3])
def test_undamped_device_without_damping_has_no_stable_stiffness(delay):
    scene = dataclasses.replace(free_scene("filter", 0.0, 0.0), timing=zwidth.Timing(1e-3, delay))
    verdict = zwidth.assess(scene)
    assert verdict.stable_stiffness == ()
    assert verdict.stable_damping == ()


def test_assess_many_reports_invalid_scenes_separately():
    scenes = {
        "rigid": zwidth.Scene(DEVICE, TIMING, WALL),
        "refused": zwidth.Scene(DEVICE, TIMING, WALL, zwidth.LowPass(cutoff=900)),
        "no scene": None,
        "filter": zwidth.Scene(DEVICE, TIMING, WALL, SLOW),
    }
    records = zwidth.assess_many(scenes)  # pyright: ignore[reportArgumentType]
    assert [record["status"] for record in records] == ["OK", *["INVALID_INPUT"] * 2, "OK"]
    assert [bool(record["message"]) for record in records] == [False, True, True, False]
    for name, record in zip(scenes, records, strict=True):
        assert record["scene"] == name
        if record["status"] == "OK":
            expected = zwidth.assess(scenes[name]).as_dict()
            assert {key: record[key] for key in expected} == expected
            assert record["stiffness"] == 3e3
        else:
            assert record["stable"] is None
    assert records[3]["velocity.cutoff"] == 100.0
    assert records[0]["velocity.cutoff"] is None
    text = io.StringIO()
    table = csv.DictWriter(text, list(records[0]))
    table.writeheader()
    table.writerows(records)
    text.seek(0)
    assert [row["scene"] for row in csv.DictReader(text)] == list(scenes)


def test_assess_many_numbers_unnamed_scenes():
    records = zwidth.assess_many(zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(K, 40)) for K in (1e3, 50e3))
    assert [(record["scene"], record["stable"]) for record in records] == [(0, True), (1, False)]
    assert zwidth.assess_many([]) == []


def test_scene_accepts_parts_by_position():
    scene = zwidth.Scene(DEVICE, TIMING, SLOW, HAND)  # pyright: ignore[reportArgumentType]
    assert scene == zwidth.Scene(DEVICE, TIMING, velocity=SLOW, operator=HAND)
    assert zwidth.Scene(DEVICE, TIMING, SLOW, operator=HAND) == scene  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="but velocity is given too"):
        zwidth.Scene(DEVICE, TIMING, SLOW, zwidth.LowPass(cutoff=50))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="but velocity is given too"):
        zwidth.Scene(DEVICE, TIMING, SLOW, HAND, HAND)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("seed", range(12))
def test_passivity_margin_with_operator_matches_colgate_scan(seed):
    # Reference: a dense scan of Colgate's condition, b > T/2 (1 - cos wT)^-1 Re[(1 - e^-jwT) H(e^jwT)], with b of the
    # device, without the operator.
    rng = np.random.default_rng([seed, 7])
    device, timing = zwidth.Device(0.1, rng.uniform(1, 40)), zwidth.Timing(1e-3, 1e-3 * int(rng.integers(0, 3)))
    wall = zwidth.VirtualWall(10 ** rng.uniform(2, 4.5), rng.uniform(0, 40))
    scene = zwidth.Scene(device, timing, wall, operator=zwidth.Operator(mass=rng.uniform(0.1, 1), damping=40))
    w = np.linspace(1e-5, np.pi, 200_001)
    z = np.exp(1j * w)
    rendered = (wall.stiffness + wall.virtual_damping * (1 - 1 / z) / 1e-3) / z**scene.integer_delay
    needed = float(np.max(0.5e-3 / (1 - np.cos(w)) * ((1 - 1 / z) * rendered).real))
    verdict = zwidth.assess(scene)
    assert verdict.passivity_margin == pytest.approx(device.damping - max(needed, 0.0), rel=1e-6, abs=1e-6)
    assert verdict.passive == bool(scene.is_passive()) == (device.damping > needed)


def test_passivity_margin_excludes_damping_of_operator():
    hand = zwidth.Operator(mass=0.5, damping=40)
    scene = zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(10e3, 5), operator=hand)
    verdict = zwidth.assess(scene)
    assert verdict.passivity_margin == pytest.approx(-2.5)
    assert verdict.passive is False


def test_assess_rejects_scene_without_wall():
    with pytest.raises(InputError, match="the scene has no wall"):
        zwidth.assess(zwidth.Scene(DEVICE, TIMING))
    assert zwidth.assess_many([zwidth.Scene(DEVICE, TIMING)])[0]["status"] == "INVALID_INPUT"


def test_assess_many_rejects_too_many_poles_before_computing(monkeypatch):
    late = zwidth.Scene(DEVICE, zwidth.Timing(1e-3, "5 s"), WALL, SLOW)
    monkeypatch.setattr(zwidth.Scene, "max_stiffness", lambda scene: pytest.fail("the boundary is laid out"))
    (row,) = zwidth.assess_many([late])
    assert row["status"] == "INVALID_INPUT"
    assert "poles" in row["message"]
