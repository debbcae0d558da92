"""Scenes with a tool and a position estimate or further feedback, against eigenvalues of programs as matrices."""

from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from coupling_loop import count_drifts, draw_coupling, find_coupling_radius

import zwidth
from zwidth.cli import cli
from zwidth.studies import load_config

DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing("1 ms", "1 ms")
N_SCENES = 24
INTEGRATORS = ("semi-implicit", "implicit")
PARTS: dict[str, dict[str, Any]] = {
    "filter": {"position": zwidth.ExponentialFilter(0.4)},
    "measured": {"position": zwidth.ExponentialFilter(cutoff="150 Hz", velocity_from="measured")},
    "pll": {"position": zwidth.Pll(800)},
    "velocity loop": {"feedback": zwidth.Feedback([5000, -5000], [1, 0])},
    "cascade": {"position": zwidth.Pll(700), "feedback": zwidth.IntegralFeedback(30, "forward", 20, 1)},
}


def make_scene(name, mass: Any = 0.3, integrator: Any = "semi-implicit"):
    return zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool(mass, 1, 10, integrator), **PARTS[name])


def draw_walls(scene, rng, count=5):
    unit = min(float(scene.mass), scene.tool.mass) / scene.timing.period**2
    return unit * 10 ** rng.uniform(-3, 0.3, count), unit * scene.timing.period * 10 ** rng.uniform(-3, 0.3, count)


def list_radii(scene, K, B):
    return np.array([find_coupling_radius(scene, *wall) for wall in zip(K.tolist(), B.tolist(), strict=True)])


@pytest.mark.parametrize("seed", range(N_SCENES))
def test_random_loops(seed):
    rng = np.random.default_rng([11, seed])
    scene = draw_coupling(rng)
    K, B = draw_walls(scene, rng)
    top = scene.max_stiffness()
    if top.status == zwidth.Status.OK and np.isfinite(top.stiffness):
        best = float(top.stiffness), float(top.virtual_damping)
        K, B = np.append(K, best[0] * rng.uniform(0.1, 1.2, 3)), np.append(B, best[1] * rng.uniform(0.5, 1.3, 3))
        # The poles of the stiffest coupling may be double, so compare the stiffness instead of the radius.
        assert find_coupling_radius(scene, best[0] * (1 - 1e-6), best[1]) < 1
        assert find_coupling_radius(scene, best[0] * (1 + 1e-9), best[1]) > 1
    expected = list_radii(scene, K, B)
    np.testing.assert_allclose(scene.spectral_radius(K, B), expected, rtol=1e-9)
    clear = np.abs(expected - 1) > 1e-7
    for method in ("auto", "companion", "certified"):
        np.testing.assert_array_equal(scene.is_stable(K, B, method=method)[clear], expected[clear] < 1)
    eigenvalues = np.linalg.eigvals(scene.state_space(K[0], B[0]).A)
    moving = np.delete(eigenvalues, np.argsort(np.abs(eigenvalues - 1))[: count_drifts(scene)])
    assert np.abs(moving).max() == pytest.approx(expected[0], abs=1e-7)


@pytest.mark.parametrize("seed", range(8))
def test_lightest_tool(seed):
    rng = np.random.default_rng([13, seed])
    scene = draw_coupling(rng)
    (K,), (B,) = (part.tolist() for part in draw_walls(scene, rng, 1))
    result = scene.lightest_tool(K, B)
    for mass in (scene.tool.mass * 10 ** rng.uniform(-2, 2, 6)).tolist():
        radius = find_coupling_radius(scene.replace(**{"tool.mass": mass}), K, B)
        inside = any(low < mass < high for low, high in result.intervals)
        assert inside == (radius < 1) or abs(radius - 1) < 1e-7


@pytest.mark.parametrize("seed", range(16))
def test_delay_margin(seed):
    rng = np.random.default_rng([12, seed])
    scene = draw_coupling(rng)
    scene = scene.replace(position=None, feedback=None) if seed % 2 and scene.position is not None else scene
    walls = zip(*draw_walls(scene, rng, 60), strict=True)
    K, B = next(((K, B) for K, B in walls if scene.is_stable(K, B)), (np.nan, np.nan))
    if np.isnan(K):
        return
    margin = float(scene.margins(K, B).delay_margin) / scene.timing.period

    def radius(added):
        return find_coupling_radius(scene.replace(delay=f"{float(scene.d + added)!r} periods"), K, B)

    end = min(margin, 8.0)
    assert max(radius(share * end) for share in np.linspace(0, 1 - 1e-6, 24)) < 1 + 1e-9
    if margin < 40:
        assert radius(margin) == pytest.approx(1, abs=1e-8)
        assert radius(margin + 1e-6 * (1 + margin)) > 1 - 1e-10


def test_margins_of_several_couplings():
    scene = make_scene("filter")
    margins = scene.margins([2e3, 5e3, 1e6], [[15], [30]])
    assert margins.delay_margin.shape == (2, 3)
    assert (margins.delay_margin[:, 2] == 0).all()
    single = scene.margins("5 kN/m", "30 N s/m")
    assert margins.delay_margin[1, 1] == pytest.approx(single.delay_margin, rel=1e-12)
    gain = float(single.gain_margin)
    assert find_coupling_radius(scene, 5e3 * gain, 30 * gain) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", ["filter", "measured", "cascade"])
def test_derivatives(name, integrator, x64):
    scene = make_scene(name, integrator=integrator)

    def compute(scene, field):
        if field == "stiffness":
            return scene.max_stiffness().stiffness
        return getattr(scene.margins(2e3, 15.0), field)

    for field, step in (("stiffness", 1e-6), ("delay_margin", 1e-5), ("phase_margin", 1e-5)):
        if field == "stiffness" and not np.isfinite(compute(scene, field)):
            continue
        slopes = jax.grad(compute)(scene, field).parameters()
        for path in ("tool.mass", "damping"):
            x = float(scene.parameters()[path])
            ends = [float(compute(scene.replace(**{path: x * (1 + h)}), field)) for h in (step, -step)]
            assert float(slopes[path]) == pytest.approx((ends[0] - ends[1]) / (2 * step * x), rel=1e-3, abs=1e-9)
            if field == "stiffness":
                assert scene.sensitivities().per[path] == pytest.approx(float(slopes[path]), rel=1e-9)


def test_traced_scenes(x64):
    scene = make_scene("pll")
    K = np.linspace(1e3, 3e4, 5)
    labels = jax.jit(lambda scene, K: scene.is_stable(K, 20.0))(scene, K)
    np.testing.assert_array_equal(labels, scene.is_stable(K, 20))
    many = jax.vmap(lambda mass: scene.replace(**{"tool.mass": mass}).max_stiffness().stiffness)(np.array([0.3, 0.5]))
    for mass, stiffness in zip((0.3, 0.5), many, strict=True):
        assert float(stiffness) == pytest.approx(float(make_scene("pll", mass).max_stiffness().stiffness), rel=1e-12)
    walls = zwidth.stiffest_walls(scene, {"tool.mass": [0.3, 0.5]})
    np.testing.assert_allclose(walls.stiffness, many, rtol=1e-9)


@pytest.mark.parametrize("name", ["filter", "measured", "pll", "velocity loop"])
def test_heavy_tool_is_a_wall(name):
    wall = zwidth.Scene(DEVICE, TIMING, **PARTS[name]).max_stiffness(negative_damping=False)
    assert make_scene(name, "1e6 kg").max_stiffness().stiffness == pytest.approx(float(wall.stiffness), rel=1e-4)


def test_couplings_without_a_limit():
    # With a PLL and an implicit tool, every K is stable with a large B, although no single B is stable for all K.
    scene = make_scene("pll", integrator="implicit")
    top = scene.max_stiffness()
    assert (top.stiffness, top.virtual_damping, top.status) == (np.inf, np.inf, zwidth.Status.OK)
    assert scene.is_stable([1e5, 1e6, 1e8], [1e5, 1e6, 1e8]).all()
    assert not scene.is_stable([1e5, 1e6, 1e8], [20, 1e4, 1e5]).any()
    assert zwidth.limits_of(scene) == []
    assert zwidth.assess(scene.replace(stiffness=2e3, virtual_damping=20)).stable


def test_recommendation_and_limits():
    scene = make_scene("filter")
    advice = scene.recommend()
    assert scene.margins(advice.stiffness, advice.virtual_damping).phase_margin > 29.9
    assert any(limit.name == "tool" for limit in zwidth.limits_of(scene))


def test_changes_that_harm_are_named():
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool("10 g"))
    limits = {limit.label: limit for limit in zwidth.limits_of(scene)}
    assert limits["half the delay"].gain < 1
    assert limits["half the delay"].note == "harmful"
    assert limits["half the delay"].spell().endswith("harmful)")
    assert limits["a tool twice as heavy"].note == ""
    assert "a tool half as heavy" not in limits


def test_configuration_and_command(tmp_path):
    file = tmp_path / "config.yaml"
    parts = "position: {kind: pll, bandwidth: 800}, tool: {mass: 300 g, damping: 1, stiffness: 10}"
    scene = f"scene: {{mass: 100 g, damping: 10, rate: 1 kHz, delay: 1 ms, {parts}}}"
    file.write_text(f"version: 1\nname: test\n{scene}\nstudies: [{{name: top, kind: boundary}}]\n", encoding="utf-8")
    expected = make_scene("pll").max_stiffness().stiffness
    loaded = load_config(file).scene
    assert loaded is not None
    assert loaded.to_scene().max_stiffness().stiffness == pytest.approx(float(expected), rel=1e-12)
    options = {
        "mass": 0.1, "damping": 10, "rate": "1 kHz", "delay": "1 ms", "position-bandwidth": 800, "stiffness": 4e3,
        "virtual-damping": 20, "tool-mass": "300 g", "tool-damping": 1, "tool-stiffness": 10,
    }  # fmt: skip
    arguments = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    text = CliRunner().invoke(cli, ["check", *arguments, "--verbose"]).output
    assert text.startswith("STABLE")
    assert f"{np.floor(float(expected) / 10) / 100:.2f} kN/m" in text
    assert "not known" not in next(line for line in text.splitlines() if line.startswith("margins"))
