"""The closed forms of the rigid loop against the general linear loop, on random rigid scenes.

A rigid scene is also a linear scene; the general kernels share only the sampled device with the closed forms.
"""

import inspect

import numpy as np
import pytest

import zwidth
from zwidth.analysis.loop import LinearLoop, RigidLoop

DELAYS = (0.0, 0.3, 1.0, 1.6, 2.0, 4.0, 8.5)


@pytest.fixture(scope="module", params=range(14))
def loops(request):
    """Random rigid scene with T = 1 s and m = 1 kg, where SI and normalized quantities coincide.

    Returns both loops, the maximum-stiffness point, and alpha and beta of 40 walls.
    """
    rng = np.random.default_rng(request.param)
    delta, d = float(10.0 ** rng.uniform(-3, 1.5)), DELAYS[request.param % len(DELAYS)]
    scene = zwidth.Scene(zwidth.Device(1.0, delta), zwidth.Timing(1.0, d))
    assert isinstance(scene.loop, RigidLoop)
    maximum = zwidth.alpha_max(delta, d)
    ratios = rng.uniform(0.02, 1.2, 40), rng.uniform(-0.1, 1.8, 40)
    beta = -delta + ratios[1] * (maximum.beta + delta)
    return scene.loop, LinearLoop(scene), maximum, ratios[0] * maximum.alpha, beta


def test_both_loops_have_the_same_methods_and_parameters():
    for name, method in inspect.getmembers(RigidLoop, inspect.isfunction):
        assert (
            inspect.signature(method).parameters.keys()
            == inspect.signature(getattr(LinearLoop, name)).parameters.keys()
        ), name


def test_stability_labels_agree(loops):
    rigid, linear, _, alpha, beta = loops
    expected = rigid.labels(alpha[:, None], beta)
    np.testing.assert_array_equal(linear.labels(alpha[:, None], beta), expected)
    assert 0.1 < np.mean(expected) < 0.9
    for method in ("auto", "companion", "certified"):
        decided = [loop.decide(alpha[:8], beta[:8], method, (alpha[:8], beta[:8])) for loop in (rigid, linear)]
        for field in ("stable", "status", "method"):
            np.testing.assert_array_equal(*(getattr(decision, field) for decision in decided))


def test_stable_rows_and_columns_agree(loops):
    rigid, linear, maximum, alpha, beta = loops
    expected, actual = rigid.find_stable_alpha(beta), linear.find_stable_alpha(beta)
    assert expected.shape == actual.shape == (40, 1, 2)
    np.testing.assert_allclose(actual, expected, rtol=1e-9)
    for stiffness in alpha[:6].tolist():
        expected, actual = rigid.find_stable_beta(stiffness), linear.find_stable_beta(stiffness)
        assert expected.shape == actual.shape == (int(stiffness < maximum.alpha), 2)
        size = rigid.scene.delta + np.abs(expected).max(initial=0.0)
        np.testing.assert_allclose(actual, expected, rtol=1e-8, atol=1e-8 * size)


def test_connected_stable_sets_agree(loops):
    rigid, linear, maximum, _, _ = loops
    assert rigid.islands(-np.inf) == linear.islands(-np.inf) == []
    wall = 0.9 * float(maximum.alpha), float(maximum.beta)
    assert rigid.is_connected(*wall)
    assert linear.is_connected(*wall)
    for lower_bound in (-np.inf, 0.0):
        expected, actual = (np.array(loop.find_connected_beta(wall[0], lower_bound)) for loop in (rigid, linear))
        np.testing.assert_allclose(actual, expected, rtol=1e-11, atol=1e-12)
    assert rigid.find_connected_beta(wall[0], -np.inf)


@pytest.mark.parametrize("negative", [True, False])
def test_maximum_stiffness_agrees(loops, negative):
    rigid, linear, maximum, _, _ = loops
    expected, actual = rigid.stiffest(negative), linear.stiffest(negative)
    assert (actual.kind, actual.status) == (expected.kind, expected.status)
    np.testing.assert_allclose(actual.omega, expected.omega, rtol=1e-7)
    np.testing.assert_allclose(actual.alpha, expected.alpha, rtol=1e-12)
    assert negative is False or expected.alpha == maximum.alpha


def test_sensitivities_agree(loops):
    rigid, linear, maximum, _, _ = loops
    expected, actual = rigid.sensitivities(True), linear.sensitivities(True)
    for path in expected.per:
        size = float(maximum.alpha) * max(1.0, 1.0 / rigid.scene.parameters()[path] if path == "damping" else 1.0)
        np.testing.assert_allclose(actual.per[path], expected.per[path], rtol=1e-6, atol=1e-9 * size)


def test_poles_and_spectral_radius_agree(loops):
    rigid, linear, _, alpha, beta = loops
    alpha, beta = alpha[:8], beta[:8]
    expected = rigid.radius(alpha, beta)
    np.testing.assert_allclose(linear.radius(alpha, beta), expected, rtol=1e-8)
    for loop in (rigid, linear):
        np.testing.assert_allclose(np.nanmax(np.abs(loop.poles(alpha, beta)), -1), expected, rtol=1e-6)


def test_dominant_poles_agree(loops):
    rigid, linear, _, alpha, beta = loops
    for wall in zip(alpha[:4].tolist(), beta[:4].tolist(), strict=True):
        expected, actual = rigid.find_dominant(*wall), linear.find_dominant(*wall)
        assert actual.marginal == expected.marginal is False
        np.testing.assert_allclose([actual.radius, actual.rate], [expected.radius, expected.rate], rtol=1e-6, atol=1e-9)
    # Without stiffness a pole lies at z = 1.
    wall = 0.0, 0.5 * float(rigid.stiffest(True).beta)
    assert rigid.find_dominant(*wall).marginal == linear.find_dominant(*wall).marginal


def test_margins_agree(loops):
    rigid, linear, _, alpha, beta = loops
    expected, actual = rigid.margins(alpha[:2], beta[:2]), linear.margins(alpha[:2], beta[:2])
    stable = rigid.labels(alpha[:2], beta[:2])
    np.testing.assert_allclose(actual.modulus_margin, expected.modulus_margin, rtol=1e-7)
    np.testing.assert_allclose(actual.phase_margin[stable], expected.phase_margin[stable], rtol=1e-7)


def test_passivity_margins_agree(loops):
    rigid, linear, _, alpha, beta = loops
    expected = rigid.passivity_margin(alpha[:6], beta[:6])
    actual = linear.passivity_margin(alpha[:6], beta[:6])
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9 * rigid.scene.delta)


def test_parameter_variations_agree():
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.3e-3), operator=zwidth.Operator(mass=0.05, damping=1.0)
    )
    samples = {"damping": np.array([2.0, 8.0, 20.0]), "delay": np.array([0.0, 1e-3, 2.5e-3])}
    expected, actual = scene.loop.vary(samples), LinearLoop(scene).vary(samples)
    assert type(expected) is not type(actual)
    np.testing.assert_array_equal(expected.labels(12e3, 20.0), actual.labels(12e3, 20.0))
    dampings = np.array([0.0, 20.0, 1e5])
    np.testing.assert_allclose(
        expected.find_stiffness_limits(dampings), actual.find_stiffness_limits(dampings), rtol=1e-9
    )
    np.testing.assert_allclose(expected.stiffest(negative=True), actual.stiffest(negative=True), rtol=1e-9)
