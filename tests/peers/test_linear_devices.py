"""Linear devices, against discretization, feedback, margins and step responses of python-control."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

import zwidth

T = 1e-3


def random_model(generator: np.random.Generator, pairs: int) -> Any:
    """Return a damped mass with an amplifier and ``pairs`` resonances, as a python-control system."""
    model: Any = control.ss([[0.0, 1.0], [0.0, -generator.uniform(5, 50)]], [[0.0], [10.0]], [[1.0, 0.0]], [[0.0]])
    for _ in range(pairs):
        w, ratio = 2 * np.pi * generator.uniform(40, 350), generator.uniform(0.02, 0.2)
        gain = generator.choice([-1.0, 1.0]) * generator.uniform(0.2, 2.0)
        model = model + control.ss([[0.0, 1.0], [-w * w, -2 * ratio * w]], [[0.0], [gain]], [[1.0, 0.0]], [[0.0]])
    rate = 2 * np.pi * generator.uniform(200, 800)
    return model * control.ss([[-rate]], [[rate]], [[1.0]], [[0.0]])


@pytest.fixture(scope="module", params=range(8))
def pair(request):
    """Return a scene with a wall, and the same device (with delay) and wall as python-control systems."""
    generator = np.random.default_rng(request.param)
    model, n_delay = random_model(generator, request.param % 4), int(generator.integers(0, 3))
    scene = zwidth.Scene(zwidth.LinearDevice(model), zwidth.Timing(T, n_delay * T))
    top = scene.max_stiffness()
    scene = scene.replace(stiffness=0.4 * top.stiffness, virtual_damping=0.8 * top.virtual_damping)
    z: Any = control.tf([1.0, 0.0], [1.0], T)
    device = control.c2d(model, T, "zoh") * control.ss(1 / z**n_delay if n_delay else control.tf([1.0], [1.0], T))
    spring, damper = scene.wall.stiffness, scene.wall.virtual_damping / T
    wall = control.ss(control.tf([spring + damper, -damper], [1.0, 0.0], T))
    return scene, device, wall


def test_poles_agree_with_python_control(pair):
    scene, device, wall = pair
    loop: Any = control.feedback(device, wall)
    poles = loop.poles()
    assert scene.spectral_radius() == pytest.approx(np.abs(poles).max(), rel=1e-7)
    moduli = np.sort(np.abs(scene.poles()))[::-1]
    np.testing.assert_allclose(moduli[:4], np.sort(np.abs(poles))[::-1][:4], rtol=1e-6)
    assert scene.is_stable()


def test_margins_agree_with_python_control(pair):
    scene, device, wall = pair
    gains, _, _, crossings, *_ = control.stability_margins(device * wall, returnall=True)
    margins = scene.margins()
    above = gains[gains > 1.0]
    assert margins.gain_margin == pytest.approx(above.min(), rel=1e-5)
    assert np.min(np.abs(crossings - 2 * np.pi * margins.phase_crossover)) < 1e-5 * crossings.max()


def test_step_responses_agree_with_python_control(pair):
    scene, device, wall = pair
    # An external force acts like the command, but without delay.
    n_delay = round(scene.d)
    response = control.step_response(control.feedback(device, wall), np.arange(60 + n_delay) * T).outputs
    np.testing.assert_allclose(scene.state_space().step(60), response[n_delay:], rtol=1e-6, atol=1e-12)


def test_margins_of_many_walls_agree_with_python_control(pair):
    scene, device, _ = pair
    random, unit = np.random.default_rng(3), control.tf([1.0, 0.0], [1.0, 0.0], T)
    stiffness = scene.wall.stiffness * random.uniform(0.2, 1.5, 6)
    damping = scene.wall.virtual_damping * random.uniform(0.5, 1.3, 6)
    margins = scene.margins(stiffness, damping)
    w = np.concatenate([np.geomspace(1e-4, 0.1, 2000), np.linspace(0.1, np.pi, 60_000)[1:]])
    plant: Any = device(np.exp(1j * w))
    difference: Any = control.tf([1.0, -1.0], [1.0, 0.0], T)
    estimate = np.asarray(difference(np.exp(1j * w)))
    for k in range(6):
        wall: Any = control.ss(stiffness[k] * unit + damping[k] / T * difference)
        gains, _, distances, *_ = control.stability_margins(device * wall, returnall=True)
        nearest = gains[gains > 0][np.argmin(np.abs(np.log(gains[gains > 0])))]
        assert margins.gain_margin[k] == pytest.approx(nearest, rel=1e-5)
        assert margins.modulus_margin[k] == pytest.approx(np.min(distances), rel=1e-6)
        # For devices of high order the peer finds gain crossovers at |L| = 1.5 or 0.4, so evaluate L directly.
        L = plant * (stiffness[k] + damping[k] / T * estimate)
        i = np.flatnonzero((np.abs(L[1:]) > 1) != (np.abs(L[:-1]) > 1))
        assert abs(margins.phase_margin[k]) == pytest.approx(np.abs(np.angle(-L[i], deg=True)).min(), abs=0.05)
