"""Test simulations against energy rules of the literature, energy balances and closed forms of friction."""

import numpy as np
import pytest
from independent_scenes import KINDS, random_scene
from tolerances import ENERGY_KEPT, FRICTION_TRUTH, SIMULATED_AGAIN

import zwidth

DEVICE = zwidth.Device(mass=0.1, damping=0.5)
FREE = zwidth.Device(mass=0.1, damping=0.0)


def simulate_impacts(rng, count, low, high):
    """Simulate impacts on walls with a stiffness relative to the limit min(2 b/T, 2 f_c/Q) of Abbott and Okamura."""
    mass, period = 10 ** rng.uniform(-2, 0.5, count), 10 ** rng.uniform(-4, -2.5, count)
    quantum = 10 ** rng.uniform(-6.5, -3.5, count)
    damping = 10 ** rng.uniform(-3.3, 0.3, count) * mass / period
    friction = damping * quantum / period * 10 ** rng.uniform(-1.5, 1.5, count)
    limit = np.minimum(2 * damping / period, 2 * friction / quantum)
    speed = 10 ** rng.uniform(-2, 3, count) * quantum / period
    # Slower devices would be stopped by friction before they reach the wall.
    speed = np.maximum(speed, 2 * friction / mass * period * 10 ** rng.uniform(-1, 2, count))
    motion = zwidth.simulate(
        [
            zwidth.Scene(zwidth.Device(m, b), zwidth.Timing(T, 0.0))
            for m, b, T in zip(mass, damping, period, strict=True)
        ],
        limit * rng.uniform(low, high, count),
        0.0,
        periods=384,
        start_position=-rng.uniform(0, 1.5, count) * speed * period,
        start_velocity=speed,
        contact="unilateral",
        coulomb=friction,
        resolution=quantum,
    )
    return motion, 2 * damping / period < 2 * friction / quantum


def compute_energy_gain(motion):
    """Return the largest net energy from the wall, relative to the energy at the start.

    The gain is counted from any sample outside the wall to a later one. Outside means x <= 0: up to half a quantum
    inside, the program detects no contact yet, and the energy that a spring would store there is not that of the wall.
    """
    net = motion.wall_work - motion.damping_loss - motion.friction_loss
    gain = np.maximum.accumulate(net[:, ::-1], 1)[:, ::-1] - net
    return np.where((motion.position <= 0) & ~motion.contact, gain, -np.inf).max(1) / motion.energy[:, 0]


def test_contact_gains_no_energy_below_the_limit_of_abbott_and_okamura():
    rng = np.random.default_rng(2)
    below, _ = simulate_impacts(rng, 256, 0.3, 1.0)
    assert np.sum(below.contact.any(1)) > 128
    assert compute_energy_gain(below).max() <= ENERGY_KEPT.float64
    above, by_damping = simulate_impacts(rng, 256, 1.5, 20.0)
    gains = compute_energy_gain(above) > 1e-3
    assert np.sum(gains & by_damping) > 10
    assert np.sum(gains & ~by_damping) > 10


@pytest.mark.parametrize(
    ("kind", "with_friction"),
    [*((kind, False) for kind in KINDS), ("filter", True), ("tip", True), ("coupled hand", True)],
)
def test_energy_is_conserved_with_every_part(kind, with_friction):
    rng = np.random.default_rng(40 + KINDS.index(kind))
    scenes = [random_scene(kind, rng) for _ in range(6)]
    units = [scene.units for scene in scenes]
    force, period = (
        np.array(part) for part in ([u.stiffness * 1e-3 for u in units], [s.timing.period for s in scenes])
    )
    options = {}
    if with_friction:
        options = {
            "coulomb": rng.uniform(0, 0.02, 6) * force,
            "resolution": 1e-6,
            "noise": 1e-6,
            "jitter": 0.5 * period,
            "max_force": 0.5 * force,
            "max_rate": 0.1 * force / period,
            "contact": "unilateral",
        }
    motion = zwidth.simulate(
        scenes,
        0.1 * force * 1e3,
        [0.1 * u.virtual_damping for u in units],
        periods=80,
        substeps=2,
        start_position=1e-3,
        start_velocity=rng.uniform(-1, 1, 6) * 1e-4 / period,
        external_force=rng.uniform(-0.01, 0.01, 6) * force,
        external_force_history=rng.normal(size=(6, 80)) * force[:, None] * 0.01,
        **options,
    )
    flows = [motion.energy, -motion.wall_work, -motion.external_work, motion.damping_loss, motion.friction_loss]
    balance = np.sum(flows, axis=0)
    drift = np.abs(balance - balance[:, :1]).max(1)
    assert np.all(drift <= ENERGY_KEPT.float64 * np.abs(flows).max((0, 2)))
    assert (motion.friction_loss.max() > 0) == with_friction


# Each test with friction uses three or four simulations, so that all share one compiled program.
SUBSTEPS = 3


def simulate_without_wall(device, **options):
    options = {"stiffness": 0.0, "virtual_damping": 0.0, "periods": 100, "substeps": SUBSTEPS, **options}
    return zwidth.simulate(zwidth.Scene(device, zwidth.Timing(1e-3, 0.0)), **options)


def test_sliding_mass_stops_when_friction_has_dissipated_its_energy():
    speed, friction = np.array([0.01, 0.1, 0.3, -0.2]), np.array([0.2, 1.0, 0.6, 0.9])
    motion = simulate_without_wall(FREE, start_velocity=speed, coulomb=friction)
    assert motion.position[:, -1] == pytest.approx(
        np.sign(speed) * 0.1 * speed**2 / (2 * friction), rel=FRICTION_TRUTH.float64
    )
    assert motion.friction_loss[:, -1] == pytest.approx(0.05 * speed**2, rel=FRICTION_TRUTH.float64)
    for x, v, sticks, stop in zip(
        motion.position, motion.velocity, motion.sticking, 0.1 * np.abs(speed) / friction, strict=True
    ):
        after = motion.time > stop * (1 + 1e-12)
        assert np.ptp(x[after]) == 0.0
        assert not np.any(v[after])
        np.testing.assert_array_equal(sticks, after)


def test_damped_sliding_mass_stops_at_closed_form_position():
    mass, damping, speed, friction = 0.1, 0.5, np.array([0.02, 0.05, 0.1, 0.3]), 0.7
    motion = simulate_without_wall(DEVICE, start_velocity=speed, coulomb=friction)
    decay = damping / mass
    stop = np.log1p(damping * speed / friction) / decay
    distance = (speed + friction / damping) * -np.expm1(-decay * stop) / decay - friction / damping * stop
    assert motion.position[:, -1] == pytest.approx(distance, rel=10 * FRICTION_TRUTH.float64)
    assert not np.any(motion.velocity[:, -1])


def test_mass_at_rest_moves_only_above_static_friction():
    ramp = np.linspace(0.0, 2.0, 101)[1:]
    motion = simulate_without_wall(FREE, external_force_history=np.stack([ramp, -ramp] * 2), coulomb=0.5, static=1.01)
    first = int(np.argmax(ramp > 1.01))
    # At the instant of the increase of the force the mass still sticks.
    sticks = np.arange(300) <= 3 * first
    np.testing.assert_array_equal(motion.sticking, np.stack([sticks] * 4))
    assert not np.any(motion.position[:, sticks])
    gained = (np.cumsum(ramp[first:] - 0.5) * 1e-3 / 0.1)[:-1]
    assert motion.velocity[0, 3 * (first + 1) :: 3] == pytest.approx(gained, rel=1e3 * FRICTION_TRUTH.float64)
    tolerance = SIMULATED_AGAIN.float64 * np.abs(motion.position).max()
    np.testing.assert_allclose(motion.position[0], -motion.position[1], rtol=0, atol=tolerance)


def test_mass_on_spring_sticks_after_the_closed_form_number_of_half_cycles():
    """Each half cycle reduces the amplitude by 2 F/k, until the spring force is below friction."""
    stiffness, friction, start = 200.0, 0.5, np.array([0.0021, 0.0112, 0.0249])
    hand = zwidth.Operator(0.1, 0.0, stiffness)
    scene = zwidth.Scene(FREE, zwidth.Timing(1e-3, 0.0), operator=hand)
    motion = zwidth.simulate(scene, 0.0, 0.0, periods=1000, start_position=start, coulomb=friction, substeps=SUBSTEPS)
    for x, end in zip(start, motion.position[:, -1], strict=True):
        while abs(x) * stiffness > friction:
            x = -(x - np.sign(x) * 2 * friction / stiffness)
        assert end == pytest.approx(x, rel=0, abs=FRICTION_TRUTH.float64 * 0.0249)
    assert motion.sticking[:, -1].all()
