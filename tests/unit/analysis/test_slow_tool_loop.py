"""Scenes with a tool that makes one step every N periods, against a simulation of each event of the composed loop."""

import json
from typing import Any

import jax
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.linalg import expm

import zwidth
from zwidth.analysis.coupling_code import write_program
from zwidth.analysis.slow_tool_loop import SlowToolLoop
from zwidth.cli.commands import cli

PERIOD = 1e-3
INTEGRATORS = ("semi-implicit", "implicit")
untyped: Any = zwidth  # for arguments of wrong types


def make_scene(every, mass: Any = 0.3, n_delay: float = 1, damping=10, **tool):
    return zwidth.Scene(
        zwidth.Device(0.1, damping),
        zwidth.Timing(PERIOD, f"{n_delay} periods"),
        tool=zwidth.Tool(mass, every=every, **tool),
    )


class Composed:
    """Device with a hand, velocity estimate and tool: linear functions of the start state, changed event by event."""

    def __init__(self, device, hand, delay, pole, tool, integrator, every):
        self.tool, self.integrator, self.every, self.pole = tool, integrator, every, pole
        self.n, fraction = int(delay), delay - int(delay)
        (mass, damping), count = device, 2
        A = np.zeros((2, 2)) if hand is None else np.zeros((4, 4))
        A[0, 1], A[1, 1] = 1.0, -damping / mass
        if hand is not None:
            m_h, b_h, k_h, k_g, c_g = hand
            count, A[2, 3] = 4, 1.0
            A[1] = np.array([-k_g, -damping - c_g, k_g, c_g]) / mass
            A[3] = np.array([k_g, c_g, -k_h - k_g, -b_h - c_g]) / m_h
        B = np.zeros((count, 1))
        B[1, 0] = 1.0 / mass
        block = np.vstack([np.hstack([A, B]), np.zeros((1, count + 1))])
        # Transitions of (device, force) from a sample to the start of the force, and from there to the next sample.
        self.parts = [expm(block * PERIOD * share)[:count] for share in (fraction, 1.0 - fraction)]
        self.count, self.size = count, count + self.n + 1 + 2 + 2

    def compute_radius(self, K, B, drift=False):
        """Return the spectral radius per period; ``drift``: without the pole of a common displacement."""
        multipliers = np.linalg.eigvals(self.run(K, B, np.eye(self.size), self.every)[0])
        if drift:
            multipliers = np.delete(multipliers, np.argmin(np.abs(multipliers - 1.0)))
        return np.abs(multipliers).max() ** (1.0 / self.every)

    def run(self, K, B, state, periods):
        """Return the state after some periods; and the positions of device and tool, and the force, at each sample."""
        device, state = state[: self.count], state[self.count :]
        queue, state = list(state[: self.n + 1]), state[self.n + 1 :]
        velocity, distance, y, speed = state
        M, c, k = self.tool
        samples = []
        for period in range(periods):
            step, tick = self.every * PERIOD, period % self.every == 0
            gain = B * (1.0 - self.pole) / PERIOD
            if tick and self.integrator == "implicit":
                # f = f0 - (K + gain) y with the new y = y + step * speed and the new speed.
                f0 = K * device[0] + gain * (device[0] - distance) + B * self.pole * velocity
                stiff = K + gain
                speed = (speed + step / M * (f0 - (stiff + k) * y)) / (1.0 + step / M * (c + step * (stiff + k)))
                y = y + step * speed
            e = device[0] - y
            velocity = self.pole * velocity + (1.0 - self.pole) * (e - distance) / PERIOD
            distance, f = e, K * e + B * velocity
            samples.append((device[0], y, f))
            if tick and self.integrator == "semi-implicit":
                speed = speed + step / M * (f - c * speed - k * y)
                y = y + step * speed
            queue = [-f, *queue]
            for part, force in zip(self.parts, (queue[self.n + 1], queue[self.n]), strict=True):
                device = part @ np.concatenate([device, force[None]])
            queue = queue[: self.n + 1]
        return np.array([*device, *queue, velocity, distance, y, speed]), np.array(samples)


def draw_case(seed):
    """Return a random scene, a typical stiffness, its composed loop, and whether device and tool are free."""
    rng = np.random.default_rng(seed)

    def draw(low, high):
        return float(10 ** rng.uniform(low, high))

    device, free = (draw(-2, 0), draw(-0.5, 1)), seed % 3 == 0
    hand = None if free else (draw(-1, 0), draw(0, 1.5), draw(1, 3), draw(2, 4), draw(-1, 1))
    tool, integrator = (draw(-2, 0.5), draw(-1, 1), 0.0 if seed % 6 < 3 else draw(0, 3)), INTEGRATORS[seed % 2]
    delay, cutoff = float(rng.choice([0, 1, 2, rng.uniform(0, 4)])), draw(1, 2.6)
    every, pole = int(rng.choice([2, 3, 4, 5, 8, 16])), np.exp(-2 * np.pi * cutoff * PERIOD)
    names = "mass", "damping", "stiffness", "coupling_stiffness", "coupling_damping"
    scene = zwidth.Scene(
        zwidth.Device(*device),
        zwidth.Timing(PERIOD, f"{delay!r} periods"),
        velocity=zwidth.LowPass(cutoff=cutoff),
        operator=None if hand is None else zwidth.Operator(**dict(zip(names, hand, strict=True))),
        tool=zwidth.Tool(*tool, integrator=integrator, every=every),
    )
    composed = Composed(device, hand, delay, pole, tool, integrator, every)
    return scene, min(device[0], tool[0] / every**2) / PERIOD**2, composed, free and tool[2] == 0, rng


def bisect(is_stable, low, high):
    """Return the end of a stable interval to the last digit: stable at ``low``, unstable at ``high``."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return 0.5 * (low + high)


@pytest.mark.parametrize("seed", range(24))
def test_random_scenes_against_events(seed):
    scene, unit, composed, drift, rng = draw_case(seed)
    K, B = unit * 10 ** rng.uniform(-3, 0.6, 4), unit * PERIOD * 10 ** rng.uniform(-3, 0.5, 4)
    exact = np.array([composed.compute_radius(*wall, drift) for wall in zip(K, B, strict=True)])
    away = np.abs(exact - 1) > 1e-9
    assert (scene.is_stable(K, B) == (exact < 1))[away].all()
    np.testing.assert_allclose(scene.spectral_radius(K, B), exact, rtol=1e-10)
    damping = float(B.min())
    for low, high in scene.stable_stiffness(damping):
        for end, sign in ((low, 1), (high, -1)):
            if end != 0 and np.isfinite(end):
                near, far = end + sign * 1e-6 * abs(end), end - sign * 1e-6 * abs(end)
                if composed.compute_radius(near, damping, drift) < 1 - 1e-10:
                    found = bisect(lambda x: composed.compute_radius(x, damping, drift) < 1, near, far)
                    assert end == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_stiffest_coupling_against_events(seed):
    scene, _, composed, drift, rng = draw_case(seed)
    top = scene.max_stiffness()
    assert top.status == zwidth.Status.OK
    K, B = float(top.stiffness), float(top.virtual_damping)
    assert B >= 0
    assert composed.compute_radius(K, B, drift) == pytest.approx(1, abs=1e-9)
    assert composed.compute_radius(K * (1 - 1e-6), B, drift) < 1 or top.kind != zwidth.RidgeKind.NO_DAMPING
    # No coupling near the maximum is stable with a larger K; the distances in B are logarithmic.
    near = np.abs(
        B + (B or 1e-3 * scene.units.virtual_damping) * rng.choice([-1, 1], 60) * 10 ** rng.uniform(-8, -1, 60)
    )
    assert not scene.is_stable(K * (1 + 1e-9), near).any()
    assert all(composed.compute_radius(K * (1 + 1e-9), b, drift) > 1 for b in near[:8].tolist())


@pytest.mark.parametrize("seed", range(12))
def test_monodromy_matrix_of_one_period_equals_poles(seed):
    scene, unit, *_ = draw_case(seed)
    scene = scene.replace(**{"tool.every": 1})
    loop, rng = SlowToolLoop(scene), np.random.default_rng(seed)
    K, B = unit * 10 ** rng.uniform(-3, 0.6, 20), unit * PERIOD * 10 ** rng.uniform(-3, 0.5, 20)
    walls = scene.normalize_walls(K, B)
    expected = scene.spectral_radius(K, B)
    np.testing.assert_allclose(loop.radius(*walls), expected, rtol=1e-10)
    assert (loop.labels(*walls) == scene.is_stable(K, B))[np.abs(expected - 1) > 1e-9].all()


DEVICES = {
    "tip": zwidth.Device(0.1, 5, coupling=zwidth.Coupling(0.05, 20e3, 1, "tip")),
    "actuator": zwidth.Device(0.1, 5, actuator=zwidth.Actuator(cutoff=200, order=2)),
    "mode": zwidth.Device(0.1, 5, modes=[zwidth.Mode(frequency=80, damping_ratio=0.02, mass=0.5)]),
    "linear": zwidth.LinearDevice("1 / 0.1 5 0"),
    "spring": zwidth.LinearDevice("1 / 0.1 5 300"),
    "sampled": zwidth.LinearDevice("4.9e-6 4.8e-6 / 1 -1.95 0.95", sampled="1 ms"),
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("stiffness", [0, 50])
def test_monodromy_matrix_of_one_period_with_every_device(device, integrator, stiffness):
    tool, timing = zwidth.Tool(0.2, 0, stiffness, integrator), zwidth.Timing(PERIOD, "1 periods")
    scene = zwidth.Scene(DEVICES[device], timing, velocity=zwidth.Butterworth(100, 3), tool=tool)
    loop, rng = SlowToolLoop(scene), np.random.default_rng(1)
    K, B = 10 ** rng.uniform(1, 5, 20), 10 ** rng.uniform(-1, 2, 20)
    np.testing.assert_allclose(loop.radius(*scene.normalize_walls(K, B)), scene.spectral_radius(K, B), rtol=1e-10)
    assert scene.replace(**{"tool.every": 3}).max_stiffness().status == zwidth.Status.OK


@pytest.mark.parametrize(("mass", "n_delay"), [(1, 0), (0.3, 0), (0.3, 1), (0.1, 1)])
def test_monodromy_matrix_of_one_period_has_the_same_stiffest_coupling(mass, n_delay):
    scene = make_scene(1, mass, n_delay)
    found, top = SlowToolLoop(scene).stiffest(False), scene.max_stiffness()
    assert found.alpha * scene.units.stiffness == pytest.approx(float(top.stiffness), rel=1e-9)
    assert found.kind == top.kind


def test_one_step_per_period_is_the_default():
    assert zwidth.Tool(0.3) == zwidth.Tool(0.3, every=1)
    assert type(make_scene(1).loop) is type(make_scene(1).replace(tool=zwidth.Tool(1)).loop)
    assert not isinstance(make_scene(1).loop, SlowToolLoop)
    assert repr(zwidth.Tool(0.3, every=4.0)) == "Tool(mass=0.3, every=4)"  # pyright: ignore


# K_max in N/m of a tool of 0.3 kg on a device of 0.1 kg with 10 N s/m, at B = 0 and with the best B.
TABLE = {
    (0, 1): (15062.8, 86583.9), (0, 2): (19983.4, 19983.4), (0, 4): (6522.3, 6522.3), (0, 8): (2785.2, 39997.9),
    (0, 16): (1312.0, 49856.7), (0, 32): (666.8, 59798.0),
    (1, 1): (5028.6, 22200.6), (1, 2): (5508.4, 9716.6), (1, 4): (6660.1, 6660.1), (1, 8): (2768.1, 8011.5),
    (1, 16): (1282.4, 11494.5), (1, 32): (644.5, 13462.3),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLE)
def test_numbers_of_the_guide(case):
    n_delay, every = case
    scene = make_scene(every, n_delay=n_delay)
    undamped, top = scene.stable_stiffness(0)[0], scene.max_stiffness()
    assert undamped.tolist() == pytest.approx([0, TABLE[case][0]], rel=1e-4)
    assert top.stiffness == pytest.approx(TABLE[case][1], rel=1e-5)


@pytest.mark.parametrize("seed", range(16))
def test_simulation_against_events(seed):
    scene, unit, composed, _, _ = draw_case(seed)
    K, B, periods = 0.3 * unit, 0.05 * unit * PERIOD, 200
    start = np.zeros(composed.size)
    start[-3], start[-2] = -1e-3, 1e-3  # distance before the first sample, and position of the tool
    expected = composed.run(K, B, start, periods)[1]
    motion = zwidth.simulate(scene, K, B, start_position={"tool_position": 1e-3}, periods=periods)
    for name, values in zip(("measured", "tool_position", "coupling_force"), expected.T, strict=True):
        np.testing.assert_allclose(getattr(motion, name), values, rtol=0, atol=1e-12 * np.abs(values).max())


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_program_and_growth_of_the_simulation(integrator):
    scene = make_scene(5, damping=10, integrator=integrator).replace(wall=zwidth.VirtualWall(1500, 1))
    external = 2.0 * np.sin(np.arange(300) / 30.0)
    motion = zwidth.simulate(scene, periods=300, start_position=2e-3, external_force_history=external)
    names: dict[str, Any] = {}
    exec(write_program(scene, "python"), names)
    coupling = names["Coupling"](motion.measured[0])
    force = np.array([coupling.force(x) for x in motion.measured.tolist()])
    np.testing.assert_allclose(force, motion.command, rtol=0, atol=1e-12 * np.abs(motion.command).max())
    limit = scene.stable_stiffness(0)[0, 1]
    kinds = [scene.simulate(factor * limit, 0, start_velocity=0.1, periods=20_000).outcome for factor in (0.98, 1.02)]
    assert kinds == [zwidth.MotionKind.DECAYING, zwidth.MotionKind.GROWING]


def test_cutoff_above_the_nyquist_frequency_is_refused():
    scene = make_scene(8).replace(velocity=zwidth.LowPass(cutoff=600))
    with pytest.raises(zwidth.InputError, match="cutoff"):
        scene.check_parts()
    with pytest.raises(zwidth.InputError, match="cutoff"):
        scene.is_stable(1e3, 1)


def test_dominant_pole_and_poles():
    scene = make_scene(4)
    K, B = np.array([[1e3, 5e3], [8e3, 40e3]]), 0.5
    poles, dominant = scene.poles(K, B), scene.dominant_pole(K, B)
    radius = np.abs(poles).max(-1) ** 0.25
    np.testing.assert_allclose(scene.spectral_radius(K, B), radius, rtol=1e-12)
    np.testing.assert_allclose(dominant.radius, radius, rtol=1e-12)
    np.testing.assert_allclose(dominant.decay_rate, -np.log(radius) / PERIOD, rtol=1e-9)
    assert (dominant.frequency <= 125).all()
    assert np.isnan(scene.spectral_radius(np.nan, 0))
    assert scene.is_stable(0, 0) == np.False_
    assert scene.is_stable([], []).shape == (0,)


def test_growth_beyond_the_range_of_floats():
    scene = make_scene(1000)
    assert scene.spectral_radius(1e9, 10) == pytest.approx(make_scene(900).spectral_radius(1e9, 10), rel=1e-2)
    assert not scene.is_stable(1e9, 10)
    assert scene.decide_stability(1e9, 10).status == zwidth.Status.OK


@pytest.mark.parametrize(
    "call",
    [
        lambda s: s.margins(1e3, 1), lambda s: s.sensitivities(), lambda s: s.islands(), lambda s: s.stable_region(),
        lambda s: s.recommend(), lambda s: s.best_damping(1e3), lambda s: s.damper_range(), lambda s: s.boundary(100),
        lambda s: s.lightest_tool(1e3, 1), lambda s: s.is_safe_for_every_world(1e3, 1), lambda s: s.max_safe_coupling(),
        lambda s: s.state_space(1e3, 1), lambda s: s.frequency_response(1e3, 1, 10),
        lambda s: s.decide_stability(1e3, 1, method="certified"), lambda s: s.max_stiffness(negative_damping=True),
    ],
)  # fmt: skip
def test_other_results_are_refused(call):
    with pytest.raises(zwidth.InputError, match=r"tool\.every"):
        call(make_scene(8))


@pytest.mark.parametrize(
    "part", [{"position": zwidth.ExponentialFilter(cutoff=100)}, {"feedback": zwidth.IntegralFeedback(1)}]
)
def test_position_estimates_are_refused(part):
    (name,) = part
    with pytest.raises(zwidth.InputError, match=rf"{name}: not allowed with tool\.every = 8"):
        make_scene(8).replace(**part)


@pytest.mark.parametrize("value", [0, -1, 1.5, 1001, "2", None, True])
def test_invalid_steps(value):
    with pytest.raises(zwidth.InputError, match=r"tool\.every: got"):
        untyped.Tool(0.3, every=value)


def test_assessment_and_improvements():
    scene = make_scene(8).replace(wall=zwidth.VirtualWall("1 kN/m", 0.5))
    verdict = zwidth.assess(scene)
    assert verdict.stable
    assert verdict.stiffness_max == pytest.approx(8011.5, rel=1e-4)
    assert verdict.spectral_radius == pytest.approx(float(scene.spectral_radius()))
    assert np.isnan(verdict.gain_margin)
    labels = [limit.label for limit in zwidth.limits_of(make_scene(4))]
    assert "a physics engine twice as fast" in labels
    walls = zwidth.stiffest_walls(scene, {"tool.every": [1, 8]})
    assert walls.stiffness.tolist() == pytest.approx([22200.6, 8011.5], rel=1e-4)


def test_command_line_and_configuration(tmp_path):
    options = [
        *("--mass", "0.1", "--damping", "10", "--rate", "1kHz", "--delay", "1ms"),
        *("--tool-mass", "300g", "--tool-every", "8"),
    ]
    result = CliRunner().invoke(cli, ["check", *options, "--stiffness", "1 kN/m", "--virtual-damping", "0.5", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["stiffness_max"] == pytest.approx(8011.5, rel=1e-4)
    ridge = CliRunner().invoke(cli, ["ridge", *options])
    assert ridge.exit_code == 0, ridge.output
    assert "8.011 kN/m" in ridge.output
    refused = CliRunner().invoke(cli, ["recommend", *options])
    assert refused.exit_code != 0
    assert "is available only for every = 1" in refused.output
    (tmp_path / "sweep.yaml").write_text(
        """
version: 1
name: engines
scene: {mass: 100 g, damping: 10, period: 1 ms, delay: 1 ms, tool: {mass: 300 g, every: 8}}
studies:
  - kind: sweep
    name: walls
    axes: {tool.every: [1, 8], stiffness: [500, 5000], virtual_damping: [0.5]}
    outputs: [stable, spectral_radius]
"""
    )
    run = CliRunner().invoke(cli, ["run", str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / "out")])
    assert run.exit_code == 0, run.output
    with zwidth.open_dataset(tmp_path / "out" / "walls.zarr") as sweep:
        radius = sweep.spectral_radius.squeeze().values
    expected = [make_scene(every).spectral_radius([500, 5000], 0.5) for every in (1, 8)]
    np.testing.assert_allclose(radius, expected, rtol=1e-12)


def test_transformations_of_jax():
    scene = make_scene(8)
    with jax.enable_x64(True):
        labels = jax.jit(lambda scene, K: scene.is_stable(K, 0.5))(scene, np.array([1e3, 8e3]))
        radius = jax.jit(lambda scene, K: scene.spectral_radius(K, 0.5))(scene, np.array([1e3, 8e3]))
        with pytest.raises(zwidth.InputError, match=r"tool\.every"):
            jax.grad(lambda K: scene.spectral_radius(K, 0.5))(1e3)
    assert labels.tolist() == scene.is_stable([1e3, 8e3], 0.5).tolist()
    np.testing.assert_allclose(radius, scene.spectral_radius([1e3, 8e3], 0.5), rtol=1e-12)
