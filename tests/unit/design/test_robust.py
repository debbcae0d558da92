"""The worst device of a box, verified by sampling the box."""

import jax
import numpy as np
import pytest

import zwidth
from zwidth.design import max_stiffness, robust_max_stiffness, robust_wall, sensitivities

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
    # A little stiffer, and one device or another is unstable, whatever the damping.
    assert not np.all(stable(vertices, wall, 1.001))
    for damping in wall.virtual_damping * np.linspace(0.5, 1.5, 21):
        assert not np.all(stable(vertices, wall._replace(virtual_damping=damping), 1 + 1e-6))


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


LIGHTEST = np.array([0.08, 0.05, 0.2, 0.01])  # the third is heavier than the heaviest


def boxes(question, lightest):
    """Four boxes at once; the last one has its worst device inside."""
    damping = np.array([5.0, 10.0, 5.0, 100.0])
    heaviest = np.array([0.12, 0.12, 0.12, 1.0])
    return question(
        mass=(lightest, heaviest),
        damping=(damping, 120.0),
        period=1e-3,
        delay=(2e-3, np.array([2e-3, 2.5e-3, 3e-3, 2e-3])),
    )


@pytest.mark.parametrize("question", [robust_max_stiffness, robust_wall])
def test_many_boxes(question, x64):
    batch = boxes(question, LIGHTEST)
    assert np.isnan(batch.stiffness).tolist() == [False, False, True, False]
    spoiled = boxes(question, np.where(np.arange(4) == 1, np.inf, LIGHTEST))
    assert np.isnan(spoiled.stiffness[1])
    assert np.array_equal(spoiled.stiffness[[0, 3]], batch.stiffness[[0, 3]])
    # Compiling is most of the cost: one transformation inside the other.
    traced = jax.jit(
        jax.vmap(lambda low, delay: question(mass=(low, 0.12), damping=(5.0, 120.0), period=1e-3, delay=(2e-3, delay)))
    )
    np.testing.assert_allclose(traced(LIGHTEST[:1], np.array([2e-3])).stiffness, batch.stiffness[:1], rtol=1e-11)
    one = question(mass=(0.08, 0.12), damping=(5.0, 120.0), period=1e-3, delay=(2e-3, 2e-3))
    assert one.stiffness == pytest.approx(batch.stiffness[0], rel=1e-11)
    if question is robust_max_stiffness:
        assert batch.is_vertex.tolist() == [True, True, False, False]
        assert (batch.mass[1], batch.damping[1], batch.delay[1]) == (0.05, 10.0, 2.5e-3)
        certified_on_both_sides({name: np.array([getattr(one, name)]) for name in BOX}, float(one.stiffness))


def certified_on_both_sides(device, stiffness):
    """The device renders a wall just below, and none just above."""
    for factor, expected in ((1 - 1e-9, True), (1 + 1e-9, False)):
        point = zwidth.normalize(**device, stiffness=stiffness * factor)
        # On a narrow column the ridge's damping is the best one.
        beta = zwidth.alpha_max(point.delta, point.d).beta * np.linspace(0.99, 1.01, 41)
        some = zwidth.is_stable(point.alpha, beta, point.delta, point.d, method="certified").any()
        assert some == expected


def test_the_slope_of_the_worst_case_is_that_of_its_device(x64):
    def stiffness(mass, damping):
        return robust_max_stiffness(
            mass=(mass, 0.12), damping=(damping, 15.0), period=1e-3, delay=(0.5e-3, 1e-3)
        ).stiffness

    slopes = jax.jit(jax.grad(stiffness, (0, 1)))(0.08, 5.0)
    gain = sensitivities(mass=0.08, damping=5.0, period=1e-3, delay=1e-3)
    np.testing.assert_allclose(slopes, [gain.per_mass, gain.per_damping], rtol=1e-10)
