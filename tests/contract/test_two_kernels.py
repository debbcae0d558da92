"""One contract, two kernels: what the rigid loop's closed forms say, the loop of any linear device says of it as well.

A rigid scene is a linear scene; the general kernels share nothing with the closed forms but the sampled device.
"""

import inspect

import numpy as np
import pytest

import zwidth
from zwidth.analysis.loop import LinearLoop, RigidLoop

DELAYS = (0.0, 0.3, 1.0, 1.6, 2.0, 4.0, 8.5)


@pytest.fixture(scope="module", params=range(14))
def loops(request):
    """A random rigid scene of T = 1 s and m = 1 kg, whose SI quantities are the normalized ones, and walls around it.

    Both of its loops, its ridge, and alpha and beta of 40 walls each.
    """
    random = np.random.default_rng(request.param)
    delta, d = float(10.0 ** random.uniform(-3, 1.5)), DELAYS[request.param % len(DELAYS)]
    scene = zwidth.Scene(zwidth.Device(1.0, delta), zwidth.Timing(1.0, d))
    assert isinstance(scene.loop, RigidLoop)
    top = zwidth.alpha_max(delta, d)
    shares = random.uniform(0.02, 1.2, 40), random.uniform(-0.1, 1.8, 40)
    beta = -delta + shares[1] * (top.beta + delta)
    return scene.loop, LinearLoop(scene), top, shares[0] * top.alpha, beta


def test_both_answer_the_same_questions():
    for name, answer in inspect.getmembers(RigidLoop, inspect.isfunction):
        assert (
            inspect.signature(answer).parameters.keys()
            == inspect.signature(getattr(LinearLoop, name)).parameters.keys()
        ), name


def test_labels(loops):
    rigid, linear, _, alpha, beta = loops
    expected = rigid.labels(alpha[:, None], beta)
    np.testing.assert_array_equal(linear.labels(alpha[:, None], beta), expected)
    assert 0.1 < np.mean(expected) < 0.9
    for method in ("auto", "companion", "certified"):
        decided = [loop.decide(alpha[:8], beta[:8], method, (alpha[:8], beta[:8])) for loop in (rigid, linear)]
        for field in ("stable", "status", "method"):
            np.testing.assert_array_equal(*(getattr(each, field) for each in decided))


def test_rows_and_columns(loops):
    rigid, linear, top, alpha, beta = loops
    expected, found = rigid.find_stable_alpha(beta), linear.find_stable_alpha(beta)
    assert expected.shape == found.shape == (40, 1, 2)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    for stiffness in alpha[:6].tolist():
        expected, found = rigid.find_stable_beta(stiffness), linear.find_stable_beta(stiffness)
        assert expected.shape == found.shape == (int(stiffness < top.alpha), 2)
        size = rigid.scene.delta + np.abs(expected).max(initial=0.0)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * size)


def test_a_stable_set_of_one_piece(loops):
    rigid, linear, top, _, _ = loops
    assert rigid.islands(-np.inf) == linear.islands(-np.inf) == []
    wall = 0.9 * float(top.alpha), float(top.beta)
    assert rigid.is_connected(*wall)
    assert linear.is_connected(*wall)
    for least in (-np.inf, 0.0):
        expected, found = (np.array(loop.find_connected_beta(wall[0], least)) for loop in (rigid, linear))
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    assert rigid.find_connected_beta(wall[0], -np.inf)


@pytest.mark.parametrize("negative", [True, False])
def test_the_stiffest_wall(loops, negative):
    rigid, linear, top, _, _ = loops
    expected, found = rigid.stiffest(negative), linear.stiffest(negative)
    assert (found.kind, found.status) == (expected.kind, expected.status)
    np.testing.assert_allclose(found.omega, expected.omega, rtol=1e-7)
    np.testing.assert_allclose(found.alpha, expected.alpha, rtol=1e-12)
    assert negative is False or expected.alpha == top.alpha


def test_sensitivities(loops):
    rigid, linear, top, _, _ = loops
    expected, found = rigid.sensitivities(True), linear.sensitivities(True)
    for path in expected.per:
        size = float(top.alpha) * max(1.0, 1.0 / rigid.scene.parameters()[path] if path == "damping" else 1.0)
        np.testing.assert_allclose(found.per[path], expected.per[path], rtol=1e-6, atol=1e-9 * size)


def test_poles_and_radius(loops):
    rigid, linear, _, alpha, beta = loops
    alpha, beta = alpha[:8], beta[:8]
    expected = rigid.radius(alpha, beta)
    np.testing.assert_allclose(linear.radius(alpha, beta), expected, rtol=1e-8)
    for loop in (rigid, linear):
        np.testing.assert_allclose(np.nanmax(np.abs(loop.poles(alpha, beta)), -1), expected, rtol=1e-6)


def test_the_slowest_motion(loops):
    rigid, linear, _, alpha, beta = loops
    for wall in zip(alpha[:4].tolist(), beta[:4].tolist(), strict=True):
        expected, found = rigid.find_dominant(*wall), linear.find_dominant(*wall)
        assert found.marginal == expected.marginal is False
        np.testing.assert_allclose([found.radius, found.rate], [expected.radius, expected.rate], rtol=1e-6, atol=1e-9)
    # Nothing pulls back, but damping slows down.
    wall = 0.0, 0.5 * float(rigid.stiffest(True).beta)
    assert rigid.find_dominant(*wall).marginal == linear.find_dominant(*wall).marginal


def test_margins(loops):
    rigid, linear, _, alpha, beta = loops
    expected, found = rigid.margins(alpha[:2], beta[:2]), linear.margins(alpha[:2], beta[:2])
    stable = rigid.labels(alpha[:2], beta[:2])
    np.testing.assert_allclose(found.modulus_margin, expected.modulus_margin, rtol=1e-7)
    np.testing.assert_allclose(found.phase_margin[stable], expected.phase_margin[stable], rtol=1e-7)


def test_passivity(loops):
    rigid, linear, _, alpha, beta = loops
    expected = rigid.passivity_margin(alpha[:6], beta[:6])
    found = linear.passivity_margin(alpha[:6], beta[:6])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * rigid.scene.delta)


def test_variants_of_a_device():
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.3e-3), operator=zwidth.Operator(mass=0.05, damping=1.0)
    )
    drawn = {"damping": np.array([2.0, 8.0, 20.0]), "delay": np.array([0.0, 1e-3, 2.5e-3])}
    expected, found = scene.loop.vary(drawn), LinearLoop(scene).vary(drawn)
    assert type(expected) is not type(found)
    np.testing.assert_array_equal(expected.labels(12e3, 20.0), found.labels(12e3, 20.0))
    dampings = np.array([0.0, 20.0, 1e5])
    np.testing.assert_allclose(
        expected.find_stiffness_limits(dampings), found.find_stiffness_limits(dampings), rtol=1e-9
    )
    np.testing.assert_allclose(expected.stiffest(), found.stiffest(), rtol=1e-9)
