"""Passivity of scenes: the condition on a fine frequency grid and by energies in time, and rejected scenes."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from any_loop import velocity_polynomials
from independent_scenes import random_scene, random_velocity
from tolerances import LEAST_DAMPING

import zwidth
from zwidth.core.errors import InputError


def needed_on_a_grid(scene, stiffness, damping):
    """The condition of a held delay as it is derived, at 40,000 frequencies, in N s/m."""
    period = scene.timing.period
    whole, part = scene.integer_delay, scene.d - scene.integer_delay
    w = np.concatenate([np.geomspace(1e-4, 0.1, 4000), np.linspace(0.1, np.pi, 36000)])
    z = np.exp(1j * w)
    top, bottom = velocity_polynomials(scene)
    wall = stiffness + damping * np.polyval(top, z) / np.polyval(bottom, z)
    g = np.conj(wall) * (z - 1) * z**whole / 2
    real, u = (((1 - part) + part * z) * g).real, 1 - np.cos(w)
    # b/T solves 2 u x^2 + 2 x Re(...) - f (1 - f) |g|^2 = 0, and g is in N/m.
    root = np.sqrt(real**2 + 2 * u * part * (1 - part) * np.abs(g) ** 2)
    return period * np.max((-real + root) / (2 * u))


def filtered(rng):
    period = 10 ** rng.uniform(-4, -2.5)
    return zwidth.Scene(
        zwidth.Device(10 ** rng.uniform(-1.5, 0.5), 10 ** rng.uniform(-1, 1.5)),
        zwidth.Timing(period, rng.choice([0, 1, 2, 0.3, 1.6, 3]) * period),
        velocity=random_velocity(rng, period),
    )


def test_no_frequency_needs_more():
    rng = np.random.default_rng(1)
    for _ in range(15):
        scene = filtered(rng)
        unit = scene.device.damping
        stiffness, damping = unit / scene.timing.period * rng.uniform(0, 2), unit * rng.uniform(-1, 2)
        needed = scene.device.damping - scene.passivity_margin(stiffness, damping)
        grid = needed_on_a_grid(scene, stiffness, damping)
        # The subtraction and the grid's own rounding at low frequencies.
        assert grid <= needed * (1 + 1e-6) + 1e-9 * unit
        assert grid >= needed * (1 - 1e-4) - 1e-9 * unit


def delayed(values, count):
    return np.concatenate([np.zeros_like(values[:count]), values])[: len(values)]


def least_damping(scene, wall, periods):
    """Return the damping below which some trajectory of that many periods extracts energy, in N s/m."""
    f, period, n = scene.d - scene.integer_delay, scene.timing.period, periods
    # One column per free position: the samples, then the positions at which delayed forces arrive between samples.
    unit = np.eye(n * (2 if f else 1))
    x = np.concatenate([np.zeros((1, unit.shape[1])), unit[:n]])
    top, bottom = velocity_polynomials(scene)
    top = np.concatenate([np.zeros(len(bottom) - len(top)), top])
    force = delayed(wall[0] * x + wall[1] * scipy.signal.lfilter(top, bottom, x, axis=0), scene.integer_delay)
    steps, forces, durations = [np.diff(x, axis=0)], [force[:-1]], [period]
    if f:
        between = unit[n:]
        steps, forces = [between - x[:-1], x[1:] - between], [delayed(force, 1)[:-1], force[:-1]]
        durations = [f * period, (1 - f) * period]
    work = np.concatenate(forces).T @ np.concatenate(steps)
    square = np.sum([step.T @ step / duration for step, duration in zip(steps, durations, strict=True)], axis=0)
    return -scipy.linalg.eigh(work + work.T, 2 * square, eigvals_only=True, subset_by_index=[0, 0])[0]


@pytest.mark.parametrize("kind", ["rigid", "filter", "hand", "coupled hand", "motor"])
def test_trajectories_need_at_most_what_the_condition_requires_and_approach_it(kind):
    rng = np.random.default_rng(2)
    for _ in range(6):
        scene = random_scene(kind, rng)
        period = scene.timing.period
        delay = rng.choice([0, 1, 2, 3, 0.3, 0.5, 1.6, 2.95])
        device = zwidth.Device(scene.device.mass, 10 ** rng.uniform(-1, 1.5), scene.device.coupling)
        scene = scene.replace(device=device, timing=zwidth.Timing(period, delay * period))
        angle = rng.uniform(-0.5, 0.5) * np.pi
        wall = np.cos(angle) * device.damping / period, np.sin(angle) * device.damping
        needed = device.damping - float(scene.passivity_margin(*wall))
        found = [least_damping(scene, wall, periods) for periods in (40, 80, 160)]
        assert found == sorted(found)
        assert found[-1] <= needed * (1 + LEAST_DAMPING.float64)
        # The difference falls as 1/periods^2.
        assert needed - found[-1] < 0.6 * (needed - found[0])


@pytest.mark.parametrize("kind", ["filter", "hand", "coupled hand", "motor"])
def test_passive_walls_are_stable(kind):
    rng = np.random.default_rng(2)
    passive = 0
    for _ in range(4):
        scene = random_scene(kind, rng)
        b = 10 ** rng.uniform(-1, 1.5)
        scene = zwidth.Scene(
            zwidth.Device(scene.device.mass, b, scene.device.coupling),
            scene.timing,
            velocity=random_velocity(rng, scene.timing.period),
            operator=scene.operator,
        )
        stiffness, damping = b / scene.timing.period * rng.uniform(0.01, 1, 12), b * rng.uniform(-0.8, 0.8, 12)
        found = scene.is_passive(stiffness, damping)
        passive += found.sum()
        assert np.all(scene.is_stable(stiffness, damping)[found])
    assert passive > 5


def test_the_hand_s_damping_does_not_count():
    device, timing = zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3)
    alone, held = (zwidth.Scene(device, timing, operator=hand) for hand in (None, zwidth.Operator(0.5, 100.0)))
    assert held.passivity_margin(1e3, 1.0) == pytest.approx(alone.passivity_margin(1e3, 1.0), rel=1e-12)


def test_a_wall_that_pushes_and_one_that_is_not_finite():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
    found = scene.passivity_margin([-100.0, np.nan])
    assert found[0] == pytest.approx(-100.0 * 1e-3)
    assert np.isnan(found[1])
    assert not scene.is_passive(np.nan)


def test_with_the_sensor_at_the_tip_there_is_no_such_condition():
    coupling = zwidth.Coupling(0.05, 20e3, 1.0, "tip")
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0, coupling), zwidth.Timing(1e-3))
    with pytest.raises(InputError, match="with the sensor at the tip: there is no passivity condition"):
        scene.is_passive(1e3)
