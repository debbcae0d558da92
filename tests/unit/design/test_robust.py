"""The worst device of a box, verified by sampling the box."""

import numpy as np
import pytest

import zwidth
from zwidth.design import max_stiffness, robust_max_stiffness, robust_wall

BOX = {"mass": (0.08, 0.12), "damping": (5.0, 15.0), "period": 1e-3, "delay": (0.5e-3, 1e-3)}


def sampled(box, count):
    random = np.random.default_rng(11)
    rows = {name: np.ravel(ends) for name, ends in box.items()}
    return {name: random.uniform(row[0], row[-1], count) for name, row in rows.items()}


def test_every_sampled_device_renders_a_wall_just_below():
    worst = robust_max_stiffness(**BOX)
    devices = sampled(BOX, 500)
    assert worst.is_vertex
    assert np.all(max_stiffness(**devices) >= worst.stiffness)
    wall = zwidth.normalize(**devices, stiffness=np.full(500, worst.stiffness * (1 - 1e-6)))
    beta = zwidth.alpha_max(wall.delta, wall.d).beta
    assert np.all(zwidth.is_stable(wall.alpha, beta, wall.delta, wall.d, method="certified"))
    # The device that attains it has no wall above.
    point = {name: np.array([getattr(worst, name)]) for name in BOX}
    assert max_stiffness(**point)[0] == pytest.approx(worst.stiffness, rel=1e-12)


def test_a_worst_case_inside():
    # Strong damping: over the mass K_max has a minimum.
    box = {"mass": (0.01, 1.0), "damping": 100.0, "period": 1e-3, "delay": 2e-3}
    worst = robust_max_stiffness(**box)
    fine = max_stiffness(mass=np.linspace(0.01, 1.0, 20_001), damping=100.0, period=1e-3, delay=2e-3)
    assert not worst.is_vertex
    assert worst.stiffness == pytest.approx(fine.min(), rel=1e-8)
    assert 0.01 < worst.mass < 1.0


def test_one_wall_for_all():
    wall = robust_wall(**BOX)
    assert wall.stiffness <= robust_max_stiffness(**BOX).stiffness
    mass, damping, delay = (part.ravel() for part in np.meshgrid(*(BOX[name] for name in ("mass", "damping", "delay"))))
    vertices = {"mass": mass, "damping": damping, "period": 1e-3, "delay": delay}
    assert np.all(stable(sampled(BOX, 300), wall, 1 - 1e-6))
    assert np.all(stable(vertices, wall, 1 - 1e-6))
    # A little stiffer, and one device or another is unstable.
    assert not np.all(stable(vertices, wall, 1.001))


def stable(devices, wall, factor):
    stiffness = np.full(devices["mass"].shape, wall.stiffness * factor)
    point = zwidth.normalize(**devices, stiffness=stiffness, virtual_damping=wall.virtual_damping)
    return zwidth.is_stable(*point, method="certified")


def test_wrong_boxes_are_named():
    with pytest.raises(zwidth.InputError, match=r"mass: got \(0.2, 0.1\); the first number must not be greater"):
        robust_max_stiffness(mass=(0.2, 0.1), period=1e-3)
    with pytest.raises(zwidth.InputError, match=r"delay: got -1"):
        robust_max_stiffness(mass=0.1, period=1e-3, delay=(-1, 1))
    with pytest.raises(zwidth.InputError, match=r"mass: got \(1, 2, 3\); give \(low, high\)"):
        robust_max_stiffness(mass=(1, 2, 3), period=1e-3)
    with pytest.raises(zwidth.InputError, match="samples: got 1"):
        robust_wall(mass=0.1, period=1e-3, samples=1)
