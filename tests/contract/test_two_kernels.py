"""One contract, two kernels: what the rigid loop's closed forms say, the loop of any linear device says of it as well.

A rigid scene is a linear scene; the general kernels share nothing with the closed forms but the sampled device.
"""

import numpy as np
import pytest

import zwidth
from zwidth.loops.linear.columns import stable_dampings
from zwidth.loops.linear.margins import OpenLoop, margins_of
from zwidth.loops.linear.passivity import PassivityCondition, passivity_margins
from zwidth.loops.linear.poles import all_poles
from zwidth.loops.linear.radius import spectral_radius
from zwidth.loops.linear.ridge import find_ridge
from zwidth.loops.linear.rows import label_walls, stable_intervals

DELAYS = (0.0, 0.3, 1.0, 1.6, 2.0, 4.0, 8.5)


@pytest.fixture(scope="module", params=range(24))
def rigid(request):
    """A random rigid scene of T = 1 s and m = 1 kg, whose SI quantities are the normalized ones; and its ridge."""
    random = np.random.default_rng(request.param)
    delta, d = float(10.0 ** random.uniform(-3, 1.5)), DELAYS[request.param % len(DELAYS)]
    scene = zwidth.Scene(zwidth.Device(1.0, delta), zwidth.Timing(1.0, d))
    assert scene.is_rigid
    top = zwidth.alpha_max(delta, d)
    shares = random.uniform(0.02, 1.2, 40), random.uniform(-0.1, 1.8, 40)
    return scene, top, shares[0] * top.alpha, -delta + shares[1] * (top.beta + delta)


def test_labels(rigid):
    scene, _, alpha, beta = rigid
    expected = zwidth.is_stable(alpha[:, None], beta, scene.delta, scene.d)
    np.testing.assert_array_equal(label_walls(scene.traced_boundary, alpha[:, None], beta), expected)
    assert 0.1 < np.mean(expected) < 0.9


def test_rows_and_columns(rigid):
    scene, top, alpha, beta = rigid
    row = zwidth.boundary_point(scene.delta, scene.d, beta=beta)
    found = stable_intervals(scene.traced_boundary, beta)
    there = row.status == zwidth.Status.OK
    np.testing.assert_array_equal(np.isfinite(found.high[:, 0]), there)
    np.testing.assert_allclose(found.high[there, 0], row.alpha[there], rtol=1e-9)
    assert np.isnan(found.high[:, 1:]).all()
    for stiffness in alpha[:6]:
        ends = [zwidth.boundary_point(scene.delta, scene.d, alpha=stiffness, side=side) for side in ("lower", "upper")]
        column = stable_dampings(scene.traced_boundary, float(stiffness))
        assert len(column) == (stiffness < top.alpha)
        if len(column):
            expected = [float(end.beta) for end in ends]
            np.testing.assert_allclose(column[0], expected, rtol=1e-8, atol=1e-8 * (scene.delta + abs(expected[1])))


def test_the_stiffest_wall(rigid):
    scene, top, _, _ = rigid
    found = find_ridge(scene.border, True)
    assert found is not None
    assert found.kind == top.kind
    np.testing.assert_allclose([found.alpha, found.omega], [top.alpha, top.omega], rtol=1e-7)
    np.testing.assert_allclose(found.alpha, top.alpha, rtol=1e-12)


def test_poles_and_radius(rigid):
    scene, _, alpha, beta = rigid
    alpha, beta = alpha[:8], beta[:8]
    stable = zwidth.is_stable(alpha, beta, scene.delta, scene.d)
    expected = zwidth.spectral_radius(alpha, beta, scene.delta, scene.d)
    np.testing.assert_allclose(spectral_radius(scene.loop, alpha, beta, stable), expected, rtol=1e-8)
    size = np.abs(1.0 + all_poles(scene.loop, alpha, beta)).max(-1)
    np.testing.assert_allclose(size, expected, rtol=1e-6)


def test_margins(rigid):
    scene, _, alpha, beta = rigid
    for a, b in zip(alpha[:4], beta[:4], strict=True):
        closed = zwidth.margins(a, b, scene.delta, scene.d)
        stable = bool(zwidth.is_stable(a, b, scene.delta, scene.d))
        found = margins_of(OpenLoop.lay_out(scene.loop, float(a), float(b), scene.traced_boundary.w), stable)
        np.testing.assert_allclose(found.modulus_margin, closed.modulus_margin, rtol=1e-7)
        if stable:
            np.testing.assert_allclose(found.phase_margin, closed.phase_margin, rtol=1e-7)


def test_passivity(rigid):
    scene, _, alpha, beta = rigid
    condition = PassivityCondition.derive(scene.velocity.estimate(1.0), scene.d)
    found = passivity_margins(condition, alpha[:6], beta[:6], scene.delta)
    expected = zwidth.passivity_margin(alpha[:6], beta[:6], scene.delta, scene.d)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * scene.delta)
