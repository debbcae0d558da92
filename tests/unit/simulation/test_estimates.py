"""Test simulations with position estimates and further feedback.

Reference: an independent program that computes every estimate by the difference equation of its definition, in a loop
with the exactly discretized motion of the device.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

import zwidth

T = 1e-3
PERIODS = 120
PAST = 3000  # samples of uniform motion before the start; all transients of the estimates have then decayed
TOLERANCE = 1e-12  # relative to the largest value: rounding errors of both programs over all periods


def run_filter(numerator: Any, denominator: Any) -> Callable[[float], float]:
    """Return the difference equation of a transfer function in z as a function of successive inputs."""
    bottom = np.atleast_1d(np.asarray(denominator, float))
    top = np.asarray(numerator, float) / bottom[0]
    top = np.concatenate([np.zeros(bottom.size - top.size), top])
    bottom = bottom / bottom[0]
    states = np.zeros(bottom.size)

    def step(entering: float) -> float:
        output = top[0] * entering + states[0]
        states[:-1] = states[1:] + top[1:] * entering - bottom[1:] * output
        return output

    return step


def run_pll(bandwidth: float) -> Callable[[float], tuple[float, float]]:
    """Return the phase-locked loop as motor controllers compute it."""
    kp = 2.0 * bandwidth
    ki, position, velocity = kp**2 / 4.0, 0.0, 0.0

    def step(x: float) -> tuple[float, float]:
        nonlocal position, velocity
        position += T * velocity
        error = x - position
        position += T * kp * error
        velocity += T * ki * error
        return position, velocity

    return step


def draw_position(rng: np.random.Generator, kind: str) -> tuple[Any, Any]:
    """Return a position estimate, and its transfer function in z or, for an observer, its program."""
    source: Any = str(rng.choice(["position", "measured"]))
    if kind == "none":
        return None, ([1.0], [1.0])
    if kind == "average":
        a = rng.uniform(0.1, 1.0)
        return zwidth.ExponentialFilter(a, velocity_from=source), ([a, 0.0], [1.0, a - 1.0])
    if kind == "filter":
        sizes, angles = rng.uniform(0.0, 0.8, 2), rng.uniform(0.0, 3.0)
        bottom = np.poly([sizes[0], sizes[1] * np.exp(1j * angles), sizes[1] * np.exp(-1j * angles)]).real
        top = rng.uniform(-1.0, 1.0, 4)
        top *= bottom.sum() / top.sum() if abs(top.sum()) > 0.5 else 1.0
        return zwidth.PositionFilter(top.tolist(), bottom.tolist(), velocity_from=source), (top, bottom)
    if kind == "low-pass":
        cutoff, order = rng.uniform(20.0, 200.0), int(rng.integers(1, 3))
        a = 1.0 - np.exp(-2.0 * np.pi * cutoff * T)
        each = np.array([a, 0.0]), np.array([1.0, a - 1.0])
        top, bottom = each if order == 1 else (np.polymul(part, part) for part in each)
        return zwidth.LowPass(cutoff=cutoff, order=order), (top, bottom)
    if kind == "butterworth":
        cutoff, order = rng.uniform(20.0, 200.0), int(rng.integers(1, 4))
        return zwidth.Butterworth(cutoff, order), signal.butter(order, cutoff, fs=1.0 / T)
    if kind == "pll":
        bandwidth = rng.uniform(50.0, 500.0)
        return zwidth.Pll(bandwidth), run_pll(bandwidth)
    a, b = rng.uniform(0.2, 0.8), rng.uniform(0.02, 0.2)  # alpha-beta filter
    bottom = [1.0, a + b - 2.0, 1.0 - a]
    tops = [a, b - a, 0.0], [b / T, -b / T, 0.0]
    estimates = [run_filter(top, bottom) for top in tops]
    return zwidth.Observer(*tops, bottom), lambda x: tuple(step(x) for step in estimates)


def draw_velocity(rng: np.random.Generator) -> tuple[Any, Any]:
    """Return a velocity estimate and its transfer function in z."""
    difference = [1.0 / T, -1.0 / T], [1.0, 0.0]
    kind = rng.integers(4)
    if kind == 0:
        return zwidth.BackwardDifference(), difference
    if kind == 1:
        n = int(rng.integers(2, 12))
        return zwidth.WindowedDifference(n), (np.append(1.0, [*np.zeros(n - 1), -1.0]) / (n * T), np.eye(1, n + 1)[0])
    if kind == 2:
        cutoff = rng.uniform(20.0, 300.0)
        top, bottom = signal.butter(2, cutoff, fs=1.0 / T)
        return zwidth.Butterworth(cutoff, 2), (np.polymul(top, difference[0]), np.polymul(bottom, difference[1]))
    top, bottom = np.polymul([0.4, 0.1], difference[0]), [1.0, -0.5, 0.0]
    return zwidth.VelocityFilter(top.tolist(), bottom), (top, bottom)


def draw_feedback(rng: np.random.Generator, kind: Any) -> tuple[Any, Any]:
    """Return further feedback and its transfer function in z, from position in m to force in N."""
    weights = {}
    if rng.integers(2):
        weights = {"position": rng.uniform(0.5, 1.5), "velocity": rng.uniform(0.0, 0.02)}
    if kind == "none":
        return None, ([0.0], [1.0])
    if kind == "filter":
        top, bottom = rng.uniform(-500.0, 500.0, 3), np.poly([1.0, rng.uniform(-0.5, 0.9)])
        return zwidth.Feedback(top.tolist(), bottom.tolist(), **weights), (top, bottom)
    gain = rng.uniform(100.0, 5000.0)
    tops = {"backward": [T, 0.0], "forward": [0.0, T], "trapezoidal": [0.5 * T, 0.5 * T]}
    return zwidth.IntegralFeedback(gain, kind, **weights), (gain * np.array(tops[kind]), [1.0, -1.0])


POSITIONS = ("none", "average", "filter", "low-pass", "butterworth", "pll", "observer")
FEEDBACKS = ("none", "filter", "backward", "forward", "trapezoidal")


def draw_scene(seed: int) -> tuple[zwidth.Scene, Callable[[float, bool], tuple[float, float, float]]]:
    """Return a scene and its program: position estimate, velocity estimate and force of the further feedback."""
    rng = np.random.default_rng(seed)
    kind, further = POSITIONS[seed % 7], FEEDBACKS[1 + seed % 4 if seed % 7 == 0 else seed % 5]
    position, p_of = draw_position(rng, kind)
    velocity, v_of = draw_velocity(rng)
    feedback, r_of = draw_feedback(rng, further)
    own = kind in ("pll", "observer")
    estimate_position: Any = p_of if own else run_filter(*p_of)
    estimate_velocity, feed_back = run_filter(*v_of), run_filter(*r_of)
    series = getattr(position, "velocity_from", "position") == "position"

    def program(x: float, touching: bool) -> tuple[float, float, float]:
        if own:
            p, v = estimate_position(x)
        else:
            p = estimate_position(x)
            v = estimate_velocity(p if series else x)
        entering = x
        if feedback is not None and feedback.position is not None:
            entering = feedback.position * p + feedback.velocity * v
        return p, v, feed_back(entering) if touching else 0.0

    device, timing = (
        zwidth.Device(rng.uniform(0.05, 1.0), rng.uniform(0.5, 10.0)),
        zwidth.Timing(T, f"{rng.uniform(0, 3)} periods"),
    )
    wall = zwidth.VirtualWall(rng.uniform(100.0, 2000.0), rng.uniform(0.0, 4.0))
    parts = {} if own else {"velocity": velocity}
    return zwidth.Scene(device, timing, wall, position=position, feedback=feedback, **parts), program


def simulate_directly(scene: zwidth.Scene, program: Any, start: float, speed: float) -> np.ndarray:
    """Return measured position, estimated velocity and command at each sample of the independent loop."""
    m, b, (K, B) = scene.mass, scene.damping, (scene.wall.stiffness, scene.wall.virtual_damping)
    whole = int(np.floor(scene.d))
    share = scene.d - whole
    rate = np.array([[0.0, 1.0, 0.0], [0.0, -b / m, 1.0 / m], [0.0, 0.0, 0.0]])
    first, second = expm(rate * share * T), expm(rate * (1.0 - share) * T)
    for k in range(-PAST, 0):
        program(start + k * speed * T, False)
    state, commands, rows = np.array([start, speed]), np.zeros(PERIODS + 5), []
    for k in range(PERIODS):
        p, v, r = program(state[0], True)
        commands[k] = -(K * p + B * v + r)
        rows.append((state[0], v, commands[k]))
        for motion, late in ((first, whole + 1), (second, whole)):
            force = commands[k - late] if k >= late else 0.0
            state = (motion @ [*state, force])[:2]
    return np.array(rows).T


SCENES = 56


@pytest.fixture(scope="module")
def motions() -> dict[int, Any]:
    rng = np.random.default_rng(1)
    starts = {seed: (rng.uniform(-1e-3, 1e-3), rng.uniform(-2e-3, 2e-3)) for seed in range(SCENES)}
    drawn = [draw_scene(seed)[0] for seed in starts]
    positions, speeds = np.array(list(starts.values())).T
    motion = zwidth.simulate(drawn, start_position=positions, start_velocity=speeds, periods=PERIODS)
    rows = np.stack([motion.measured, motion.estimated_velocity, motion.command], 1)
    return {seed: (start, row) for (seed, start), row in zip(starts.items(), rows, strict=True)}


@pytest.mark.parametrize("seed", range(SCENES))
def test_simulation_agrees_with_the_difference_equations(seed, motions):
    scene, program = draw_scene(seed)
    start, simulated = motions[seed]
    expected = simulate_directly(scene, program, *start)
    scale = np.abs(expected).max(1, keepdims=True)
    np.testing.assert_allclose(simulated / scale, expected / scale, rtol=0, atol=TOLERANCE)


def test_contact_depends_on_the_estimated_position():
    """The filtered position of a device that enters the wall becomes positive later than the measured one."""
    scene = zwidth.Scene(zwidth.Device(1, 1), zwidth.Timing("1 ms"), position=zwidth.ExponentialFilter(0.1))
    motion = scene.simulate(1000, 5, start_position="-5 mm", start_velocity=1, contact="unilateral", periods=40)
    first = np.argmax(motion.contact)
    assert motion.measured[first - 1] > 0
    # For a ramp, the filter lags by (1 - a)/a = 9 samples.
    assert first - np.argmax(motion.measured > 0) == 9
    assert np.all(motion.command[:first] == 0)


def test_integral_is_zero_outside_of_contact():
    """Each contact starts with the force of the spring and one summand of the integral."""
    hand = zwidth.Operator(stiffness=100)
    feedback = zwidth.IntegralFeedback(20_000)
    scene = zwidth.Scene(zwidth.Device(0.1, 1), zwidth.Timing(1e-3), operator=hand, feedback=feedback)
    force = 2 * np.sin(np.arange(1000) / 25)
    motion = scene.simulate(
        2000, periods=1000, start_position=-0.01, external_force_history=force, contact="unilateral"
    )
    starts = np.flatnonzero(motion.contact[1:] & ~motion.contact[:-1]) + 1
    assert starts.size >= 2
    x = motion.measured[starts]
    np.testing.assert_allclose(motion.command[starts], -(2000 + 20_000 * T) * x, rtol=1e-12)
    following = motion.measured[starts + 1]
    np.testing.assert_allclose(
        motion.command[starts + 1], -(2000 * following + 20_000 * T * (x + following)), rtol=1e-12
    )


def test_integral_removes_the_static_error():
    """A constant external force deflects a wall with an integral only for some time."""
    device, timing = zwidth.Device("0.1 kg", "10 N s/m"), zwidth.Timing(rate="1 kHz")
    wall = zwidth.VirtualWall("2 N/mm", 20)
    plain, integral = zwidth.simulate(
        [zwidth.Scene(device, timing, wall), zwidth.Scene(device, timing, wall, feedback=zwidth.IntegralFeedback(2e4))],
        external_force=1,
        periods=3000,
    ).position[:, -1]
    assert plain == pytest.approx(1 / 2000, rel=1e-9)
    assert abs(integral) < 1e-9 * plain


def test_law_receives_the_estimated_position():
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), position=zwidth.Pll(500))
    options: Any = {"start_position": 1e-3, "start_velocity": 0.01, "periods": 200}
    law = scene.simulate(force=lambda position, velocity, time: -(1000 * position + 10 * velocity), **options)
    np.testing.assert_allclose(law.position, scene.simulate(1000, 10, **options).position, rtol=0, atol=1e-15)


def test_adaptive_estimate_uses_the_filtered_position():
    """FOAW with a large noise bound is the difference over its longest window, of the filtered position."""
    parts: Any = {"wall": zwidth.VirtualWall(1000, 10), "position": zwidth.ExponentialFilter(0.3)}
    scenes = [
        zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=velocity, **parts)
        for velocity in (zwidth.FOAW(1, 8), zwidth.WindowedDifference(8))
    ]
    adaptive, window = (scene.simulate(start_position=1e-3, periods=100).position for scene in scenes)
    np.testing.assert_allclose(adaptive, window, rtol=0, atol=1e-15)


def test_motion_decays_at_the_rate_of_the_dominant_pole():
    scene = zwidth.Scene(
        zwidth.Device(0.1, 2),
        zwidth.Timing(1e-3, "1.5 periods"),
        **zwidth.pid(1000, 2e4, 12, units="m", position=zwidth.Pll(600)),
    )
    x = scene.simulate(start_position=1e-3, periods=500).position
    # The second largest pole is 0.936, so after 400 periods only the motion of the dominant, real pole remains.
    assert x[-1] / x[-2] == pytest.approx(float(scene.spectral_radius()), rel=1e-5)
    assert x[-1] / x[-101] == pytest.approx(float(scene.spectral_radius()) ** 100, rel=1e-4)
