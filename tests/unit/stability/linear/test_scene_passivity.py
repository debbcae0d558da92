"""Passivity of linear scenes, against the condition on a fine frequency grid and energies of trajectories; invalid
scenes.
"""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from any_loop import velocity_polynomials
from independent_scenes import random_scene, random_velocity
from tolerances import LEAST_DAMPING

import zwidth
from zwidth.core.errors import InputError


def required_on_grid(scene, stiffness, damping):
    """Return the damping in N s/m required by the condition for fractional delays, at 40,000 frequencies."""
    period = scene.timing.period
    n_delay, fraction = scene.integer_delay, scene.d - scene.integer_delay
    w = np.concatenate([np.geomspace(1e-4, 0.1, 4000), np.linspace(0.1, np.pi, 36000)])
    z = np.exp(1j * w)
    top, bottom = velocity_polynomials(scene)
    wall = stiffness + damping * np.polyval(top, z) / np.polyval(bottom, z)
    g = np.conj(wall) * (z - 1) * z**n_delay / 2
    real, u = (((1 - fraction) + fraction * z) * g).real, 1 - np.cos(w)
    # b/T solves 2 u x^2 + 2 x Re(...) - f (1 - f) |g|^2 = 0, with g in N/m.
    root = np.sqrt(real**2 + 2 * u * fraction * (1 - fraction) * np.abs(g) ** 2)
    return period * np.max((-real + root) / (2 * u))


def draw_filtered_scene(rng):
    period = 10 ** rng.uniform(-4, -2.5)
    return zwidth.Scene(
        zwidth.Device(10 ** rng.uniform(-1.5, 0.5), 10 ** rng.uniform(-1, 1.5)),
        zwidth.Timing(period, rng.choice([0, 1, 2, 0.3, 1.6, 3]) * period),
        velocity=random_velocity(rng, period),
    )


def test_required_damping_agrees_with_a_frequency_grid():
    rng = np.random.default_rng(1)
    for _ in range(15):
        scene = draw_filtered_scene(rng)
        unit = scene.device.damping
        stiffness, damping = unit / scene.timing.period * rng.uniform(0, 2), unit * rng.uniform(-1, 2)
        required = scene.device.damping - scene.passivity_margin(stiffness, damping)
        grid = required_on_grid(scene, stiffness, damping)
        # Allow for rounding errors of the subtraction and of the grid at low frequencies.
        assert grid <= required * (1 + 1e-6) + 1e-9 * unit
        assert grid >= required * (1 - 1e-4) - 1e-9 * unit


def delayed(values, count):
    return np.concatenate([np.zeros_like(values[:count]), values])[: len(values)]


def smallest_dissipative_damping(scene, wall, periods):
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
def test_required_damping_is_the_limit_of_finite_trajectories(kind):
    rng = np.random.default_rng(2)
    for _ in range(6):
        scene = random_scene(kind, rng)
        period = scene.timing.period
        delay = rng.choice([0, 1, 2, 3, 0.3, 0.5, 1.6, 2.95])
        device = zwidth.Device(scene.device.mass, 10 ** rng.uniform(-1, 1.5), scene.device.coupling)
        scene = scene.replace(device=device, timing=zwidth.Timing(period, delay * period))
        angle = rng.uniform(-0.5, 0.5) * np.pi
        wall = np.cos(angle) * device.damping / period, np.sin(angle) * device.damping
        required = device.damping - float(scene.passivity_margin(*wall))
        damping_by_length = [smallest_dissipative_damping(scene, wall, periods) for periods in (40, 80, 160)]
        assert damping_by_length == sorted(damping_by_length)
        assert damping_by_length[-1] <= required * (1 + LEAST_DAMPING.float64)
        # The difference decreases as 1/periods^2.
        assert required - damping_by_length[-1] < 0.6 * (required - damping_by_length[0])


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
        is_passive = scene.is_passive(stiffness, damping)
        passive += is_passive.sum()
        assert np.all(scene.is_stable(stiffness, damping)[is_passive])
    assert passive > 5


def test_damping_of_the_operator_does_not_affect_passivity():
    device, timing = zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3)
    free, coupled = (zwidth.Scene(device, timing, operator=hand) for hand in (None, zwidth.Operator(0.5, 100.0)))
    assert coupled.passivity_margin(1e3, 1.0) == pytest.approx(free.passivity_margin(1e3, 1.0), rel=1e-12)


def test_passivity_margin_of_negative_and_nan_stiffness():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
    margin = scene.passivity_margin([-100.0, np.nan])
    assert margin[0] == pytest.approx(-100.0 * 1e-3)
    assert np.isnan(margin[1])
    assert not scene.is_passive(np.nan)


def test_passivity_with_the_sensor_at_the_tip_raises():
    coupling = zwidth.Coupling(0.05, 20e3, 1.0, "tip")
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0, coupling), zwidth.Timing(1e-3))
    with pytest.raises(InputError, match="with the sensor at the tip: there is no passivity condition"):
        scene.is_passive(1e3)
