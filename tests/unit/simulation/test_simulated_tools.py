"""Test simulations of a virtual coupling between a device and a tool.

Reference: an independent state-space model of device, hand, delayed commands, velocity filter and tool. It is composed
from one period of an independent program, in which the equations of the tool and of the coupling are solved together.
For position estimates and further feedback, the reference is `coupling_loop.step_coupling`.
"""

from typing import Any

import jax
import numpy as np
import pytest
from coupling_loop import draw_coupling, step_coupling
from program_loop import find_plant
from scipy import signal
from scipy.linalg import expm

import zwidth

T = 1e-3
PERIODS = 150
COUPLINGS = 300
TOLERANCE = 1e-12  # relative to the largest value: rounding errors of both programs over all periods
INTEGRATORS: tuple[Any, ...] = ("semi-implicit", "implicit")
DEVICE, TIMING = zwidth.Device("100 g", 10), zwidth.Timing("1 ms", "1 ms")


def draw_velocity(rng: np.random.Generator) -> tuple[Any, Any]:
    """Return a velocity estimate and its transfer function in z."""
    difference = [1.0 / T, -1.0 / T], [1.0, 0.0]
    kind = rng.integers(5)
    if kind == 0:
        return zwidth.BackwardDifference(), difference
    if kind == 1:
        n = int(rng.integers(2, 9))
        return zwidth.WindowedDifference(n), (np.append(1.0, [*np.zeros(n - 1), -1.0]) / (n * T), np.eye(1, n + 1)[0])
    cutoff = rng.uniform(30.0, 300.0)
    if kind == 2:
        a = 1.0 - np.exp(-2.0 * np.pi * cutoff * T)
        return zwidth.LowPass(cutoff=cutoff), (a * np.array([1.0, -1.0]) / T, [1.0, a - 1.0])
    if kind == 3:
        top, bottom = signal.butter(2, cutoff, fs=1.0 / T)
        return zwidth.Butterworth(cutoff, 2), (np.polymul(top, difference[0]), np.polymul(bottom, difference[1]))
    top, bottom = np.polymul([0.4, 0.1], difference[0]), [1.0, -0.5, 0.0]
    return zwidth.VelocityFilter(top.tolist(), bottom), (top, bottom)


def draw_scene(seed: int) -> tuple[zwidth.Scene, Any]:
    """Return a scene with a tool, and the transfer function of its velocity estimate."""
    rng = np.random.default_rng(seed)
    velocity, v_of = draw_velocity(rng)
    hand = [
        None,
        zwidth.Operator(rng.uniform(0.1, 0.6), rng.uniform(1, 8), rng.uniform(50, 500)),
        zwidth.Operator(rng.uniform(0.1, 0.6), rng.uniform(1, 8), rng.uniform(50, 500), rng.uniform(500, 5e3), 2.0),
    ][seed % 3]
    grounded = rng.integers(2)
    tool = zwidth.Tool(
        rng.uniform(0.05, 1.0),
        grounded * rng.uniform(0.0, 20.0),
        grounded * rng.uniform(0.0, 500.0),
        integrator=INTEGRATORS[seed % 2],
    )
    delay = rng.uniform(0.0, 4.0) if rng.integers(4) else int(rng.integers(5))
    wall = zwidth.VirtualWall(rng.uniform(100.0, 2000.0), rng.uniform(0.0, 4.0))
    device = zwidth.Device(rng.uniform(0.05, 1.0), rng.uniform(0.5, 10.0))
    timing = zwidth.Timing(T, f"{delay} periods")
    return zwidth.Scene(device, timing, wall, velocity, operator=hand, tool=tool), v_of


def model_bodies(scene: zwidth.Scene) -> np.ndarray:
    """Return the matrix of x' = rate @ (x, force), with the state (position, velocity) of device and hand."""
    m, b, hand = scene.device.mass, scene.device.damping, scene.operator
    m_h, b_h, k_h, k_g, c_g = 1.0, 2e3, 1e6, 0.0, 0.0  # by default, a separate body with fast decay
    k = 0.0
    if hand is not None and hand.rigid:
        m, b, k = m + hand.mass, b + hand.damping, hand.stiffness
    elif hand is not None:
        m_h, b_h, k_h = hand.mass, hand.damping, hand.stiffness
        k_g, c_g = hand.coupling_stiffness, hand.coupling_damping
    rate = np.zeros((5, 5))
    rate[0, 1] = rate[2, 3] = 1.0
    rate[1] = np.array([-k - k_g, -b - c_g, k_g, c_g, 1.0]) / m
    rate[3] = np.array([k_g, c_g, -k_h - k_g, -b_h - c_g, 0.0]) / m_h
    return rate


class Composed:
    """State-space model of a coupling, with the state (bodies, velocity filter, tool, last commands).

    The rows of ``output`` are the measured position, the estimated velocity, the command, the position of the tool and
    the force of the coupling.
    """

    def __init__(self, scene: zwidth.Scene, v_of: Any, K: float, B: float):
        top, bottom = np.atleast_1d(v_of[0]), np.atleast_1d(v_of[1])
        self.filter = np.concatenate([np.zeros(bottom.size - top.size), top]) / bottom[0], bottom / bottom[0]
        self.order = bottom.size - 1
        self.scene, self.K, self.B = scene, K, B
        self.whole = int(np.floor(scene.d))
        share, rate = scene.d - self.whole, model_bodies(scene)
        self.parts = expm(rate * share * T), expm(rate * (1.0 - share) * T)
        # Sample the held command of the age ``whole`` and of the one before it.
        self.size = 4 + self.order + 2 + self.whole + 1
        columns = [self.step(unit) for unit in np.eye(self.size)]
        self.A = np.stack([state for state, _ in columns], 1)
        self.output = np.stack([rows for _, rows in columns], 1)

    def step(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the next state and the outputs of one period of the program."""
        bodies, filtered, (y, v), commands = np.split(state, [4, 4 + self.order, 6 + self.order])
        (numerator, denominator), tool = self.filter, self.scene.tool
        assert tool is not None
        M, c, k, d = tool.mass, tool.damping, tool.stiffness, numerator[0]
        before = filtered[0] if self.order else 0.0
        # Solve for the estimated velocity, the force of the coupling, and the velocity and position of the tool after
        # its step. The filter adds d times the distance to its state.
        late = tool.integrator == "semi-implicit"
        matrix = np.array(
            [
                [1.0, 0.0, 0.0, 0.0 if late else d],
                [-self.B, 1.0, 0.0, 0.0 if late else self.K],
                [0.0, -T / M, 1.0 + (0.0 if late else T * c / M), 0.0 if late else T * k / M],
                [0.0, 0.0, -T, 1.0],
            ]
        )
        e = bodies[0] - (y if late else 0.0)
        right = [before + d * e, self.K * e, v - (T / M * (c * v + k * y) if late else 0.0), y]
        speed, force, new_v, new_y = np.linalg.solve(matrix, right)
        used = y if late else new_y
        distance = bodies[0] - used
        shifted = np.append(filtered[1:], 0.0) if self.order else filtered
        filtered = shifted + numerator[1:] * distance - denominator[1:] * speed
        sent = [-force, *commands]
        for motion, age in zip(self.parts, (self.whole + 1, self.whole), strict=True):
            bodies = (motion @ [*bodies, sent[age] if age < len(sent) else 0.0])[:4]
        following = np.concatenate([bodies, filtered, [new_y, new_v], sent[: self.whole + 1]])
        return following, np.array([state[0], speed, -force, used, force])

    def start(self, x: float, v: float, y: float, tool_v: float) -> np.ndarray:
        """Return the state at sample 0 after uniform motion of device and tool without forces."""
        state = np.zeros(self.size)
        state[:4] = x, v, x, v
        numerator, denominator = self.filter
        for k in range(-3000, 0):
            e = x - y + k * T * (v - tool_v)
            filtered = state[4 : 4 + self.order]
            speed = numerator[0] * e + (filtered[0] if self.order else 0.0)
            shifted = np.append(filtered[1:], 0.0) if self.order else filtered
            state[4 : 4 + self.order] = shifted + numerator[1:] * e - denominator[1:] * speed
        assert self.scene.tool is not None
        early = T * tool_v if self.scene.tool.integrator == "implicit" else 0.0
        state[4 + self.order : 6 + self.order] = y - early, tool_v
        return state

    def run(self, state: np.ndarray, periods: int) -> np.ndarray:
        """Return the outputs at all samples, one row per output."""
        rows = []
        for _ in range(periods):
            rows.append(self.output @ state)
            state = self.A @ state
        return np.array(rows).T


@pytest.fixture(scope="module")
def motions() -> Any:
    rng = np.random.default_rng(2)
    starts = rng.uniform(-1, 1, (4, COUPLINGS)) * np.array([1e-3, 0.1, 1e-3, 0.1])[:, None]
    x, v, y, tool_v = starts
    motion = zwidth.simulate(
        [draw_scene(seed)[0] for seed in range(COUPLINGS)],
        periods=PERIODS,
        start_position={"position": x, "tool_position": y},
        start_velocity={"position": v, "tool_position": tool_v},
    )
    names = "measured", "estimated_velocity", "command", "tool_position", "coupling_force"
    return starts.T, np.stack([getattr(motion, name) for name in names], 1)


@pytest.mark.parametrize("block", range(6))
def test_simulation_agrees_with_the_composed_state_space(block, motions):
    starts, simulated = motions
    for seed in range(block, COUPLINGS, 6):
        scene, v_of = draw_scene(seed)
        K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
        model = Composed(scene, v_of, K, B)
        expected = model.run(model.start(*starts[seed]), PERIODS)
        scale = np.abs(expected).max(1, keepdims=True)
        np.testing.assert_allclose(simulated[seed] / scale, expected / scale, rtol=0, atol=TOLERANCE, err_msg=str(seed))


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("delay", ["0 periods", "1.4 periods"])
def test_motion_grows_by_the_spectral_radius(integrator, delay):
    """Compare the growth per period of a soft and of a stiff coupling with the eigenvalues of the composed model."""
    tool = zwidth.Tool("0.3 kg", 2, 10, integrator)
    scene = zwidth.Scene(DEVICE, zwidth.Timing(T, delay), velocity=zwidth.LowPass(cutoff=200), tool=tool)
    a = 1.0 - np.exp(-2.0 * np.pi * 200 * T)
    v_of = a * np.array([1.0, -1.0]) / T, [1.0, a - 1.0]
    for K, B in ((3e3, 5), (60e3, 30)):
        radius = float(scene.spectral_radius(K, B))
        assert max(abs(np.linalg.eigvals(Composed(scene, v_of, K, B).A))) == pytest.approx(radius, rel=1e-9)
        periods = 4000 if radius < 1 else 400
        force = scene.simulate(K, B, start_velocity=0.1, periods=periods).coupling_force
        half, fifth = periods // 2, periods // 5
        late, later = (np.abs(force[k - fifth : k]).max() for k in (half, periods))
        assert (later / late) ** (1 / half) == pytest.approx(radius, rel=3e-3 if radius > 1 else 1e-5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_motion_decays_below_the_largest_stiffness_and_grows_above(integrator):
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool("300 g", integrator=integrator))
    top = scene.max_stiffness()
    below, above = scene.simulate(
        np.array([0.98, 1.02]) * top.stiffness, top.virtual_damping, start_velocity=0.1, periods=4000
    ).outcome
    assert below in (zwidth.MotionKind.DECAYING, zwidth.MotionKind.REST)
    assert above in (zwidth.MotionKind.GROWING, zwidth.MotionKind.DIVERGED)


OPTIONS: dict[str, dict[str, Any]] = {
    "encoder": {"resolution": "10 um", "noise": "3 um", "seed": 3},
    "friction": {"coulomb": "0.3 N", "static": "0.4 N", "external_force": 1},
    "motor": {"max_force": "2 N", "max_rate": "500 N/s"},
    "jitter": {"jitter": "0.3 ms", "substeps": 3},
    "history": {"external_force_history": np.sin(np.arange(200) / 7.0)},
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", OPTIONS)
def test_coupling_to_a_heavy_tool_is_a_wall(name, integrator):
    """A tool of 1e15 kg does not move, so the coupling acts like a wall with the same encoder, motor and friction."""
    start: Any = {"start_velocity": 0.1, "periods": 200, **OPTIONS[name]}
    scene = zwidth.Scene(DEVICE, TIMING, velocity=zwidth.LowPass(cutoff=150))
    wall = scene.simulate(5e3, 10, start_position=1e-4, **start)
    tool = zwidth.Tool(1e15, integrator=integrator)
    coupling = scene.replace(tool=tool).simulate(
        5e3, 10, start_position={"position": 1e-4, "tool_position": 0}, **start
    )
    for field in (
        "position",
        "measured",
        "command",
        "wall_force",
        "sticking",
        "damping_loss",
        "friction_loss",
        "wall_work",
    ):
        expected = getattr(wall, field)
        np.testing.assert_allclose(
            getattr(coupling, field), expected, rtol=0, atol=1e-12 * max(np.abs(expected).max(), 1e-12), err_msg=field
        )
    assert wall.tool_position is None
    assert wall.coupling_force is None
    limit = 2.0 if name == "motor" else np.inf
    if name == "motor":
        # The force on the tool is not limited.
        assert np.abs(coupling.coupling_force).max() > limit
    else:
        np.testing.assert_array_equal(coupling.coupling_force, -coupling.command)


def test_tool_starts_at_rest_at_the_measured_position():
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool("0.3 kg"))
    motion = scene.simulate(2e3, 5, start_position="1.004 mm", resolution="10 um", periods=50)
    assert np.all(motion.tool_position == motion.measured[0])
    assert np.all(motion.command == 0)
    assert motion.outcome == zwidth.MotionKind.REST
    released = scene.simulate("2 N/mm", "5 N s/m", start_position={"position": "1 mm", "tool_position": 0}, periods=3)
    assert released.coupling_force[0] == pytest.approx(2.0, rel=1e-15)
    # The semi-implicit Euler method moves the tool by T^2 f/M in the first step.
    assert released.tool_position[1] == pytest.approx(2e-6 / 0.3, rel=1e-15)


def test_nonlinear_couplings():
    """A law and FOAW with a large noise bound equal a linear coupling to a tool of the semi-implicit Euler method."""
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool(0.2, 1, 30))
    start: Any = {"start_velocity": 0.1, "periods": 300}
    linear = scene.simulate(2000, 5, **start)
    law = scene.simulate(force=lambda distance, velocity, time: -(2000 * distance + 5 * velocity), **start)
    scale = np.abs(linear.coupling_force).max()
    np.testing.assert_allclose(law.coupling_force, linear.coupling_force, rtol=0, atol=TOLERANCE * scale)
    window, adaptive = (
        scene.replace(velocity=velocity).simulate(2000, 5, **start).coupling_force
        for velocity in (zwidth.WindowedDifference(8), zwidth.FOAW(1, 8))
    )
    np.testing.assert_allclose(adaptive, window, rtol=0, atol=TOLERANCE * scale)


def test_batch_of_scenes_with_and_without_tools():
    plain = zwidth.Scene(DEVICE, TIMING, wall=zwidth.VirtualWall(3000, 10))
    scenes = [plain, *(plain.replace(tool=zwidth.Tool(0.3, integrator=name)) for name in INTEGRATORS)]
    start = {"position": 0, "tool_position": 1e-4}
    motion = zwidth.simulate(scenes, start_position=start, start_velocity=0.1, periods=100)
    assert np.isnan(motion.tool_position[0]).all()
    for k, scene in enumerate(scenes[1:], 1):
        single = scene.simulate(start_position=start, start_velocity=0.1, periods=100)
        np.testing.assert_array_equal(motion.tool_position[k], single.tool_position)
        np.testing.assert_array_equal(motion.coupling_force[k], single.coupling_force)
    data = motion.to_dataset("scene")
    assert data.tool_position.units == "m"
    assert data.coupling_force.dims == ("scene", "time")


def test_linear_device_and_rotary_device():
    device, rotary = zwidth.LinearDevice(([10], [1, 100, 0])), zwidth.Device("1e-4 kg m^2", "0.01 N m s/rad")
    same = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool(0.3))
    scene = zwidth.Scene(device, TIMING, tool=zwidth.Tool(0.3))
    options: Any = {"periods": 100, "external_force": 1.0, "start_position": {"tool_position": 1e-3}}
    ends = [each.simulate(2e3, 5, **options).tool_position for each in (scene, same)]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-13 * np.abs(ends).max())
    motion = zwidth.Scene(rotary, TIMING, tool=zwidth.Tool("3e-4 kg m^2")).simulate(
        "2 N m/rad", "5 mN m s/rad", start_velocity="100 deg/s", periods=50
    )
    assert "rad" in motion.to_dataset().tool_position.units


def test_displaced_tools_rest_only_if_the_tool_rests():
    """Without a coupling, the device rests, but the tool oscillates on its own spring."""
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool(0.1, 0, 400))
    motion = scene.simulate(0, 0, start_position={"tool_position": 1e-3}, periods=400)
    assert np.all(motion.position == 0)
    assert motion.outcome != zwidth.MotionKind.REST


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contact": "unilateral"}, r"contact: got 'unilateral', but a coupling to a tool has no surface"),
        ({"contact": "push_only"}, r"contact: got 'push_only'"),
        ({"force": lambda x, v, t: -1e3 * x}, r"force: got a nonlinear function, but the implicit Euler method"),
        ({"stiffness": 1e3, "start_position": {"tool": 1}}, r"start_position: .*'tool_position'"),
        ({"stiffness": 1e3, "start_position": {"tool_position": np.inf}}, r"start_position.tool_position: got inf"),
    ],
)
def test_refusals(options, message):
    scene = zwidth.Scene(DEVICE, TIMING, tool=zwidth.Tool(0.3, integrator="implicit"))
    with pytest.raises(zwidth.InputError, match=message):
        scene.simulate(**options)
    adaptive = scene.replace(velocity=zwidth.FOAW("1 um"))
    with pytest.raises(zwidth.InputError, match=r"velocity: got a nonlinear function"):
        adaptive.simulate(1e3, 5)
    with pytest.raises(zwidth.InputError, match=r"start_position: .*'tool_position'"):
        scene.replace(tool=None).simulate(1e3, 5, start_position={"tool_position": 0})
    filtered = adaptive.replace(tool=zwidth.Tool(0.3), position=zwidth.ExponentialFilter(0.3))
    with pytest.raises(zwidth.InputError, match=r"position: got position and a tool with FOAW"):
        filtered.simulate(1e3, 5)


def test_traced_scene_is_refused():
    def end(K):
        scene = zwidth.Scene(DEVICE, TIMING, wall=zwidth.VirtualWall(K, 5.0), tool=zwidth.Tool(0.3))
        return scene.simulate(start_velocity=0.1).amplitude

    with pytest.raises(zwidth.InputError, match="traced by JAX"):
        jax.jit(end)(1e3)


LOOPS = 60
PULSE = 1.0  # N; external force in the first period


@pytest.fixture(scope="module")
def controlled() -> Any:
    """Simulate random tools with a position estimate or further feedback, after an external force in one period."""
    rng = np.random.default_rng(4)
    scenes, walls = [], []
    for _ in range(LOOPS):
        scene = draw_coupling(rng)
        m, period = float(scene.mass), scene.timing.period
        scenes.append(scene)
        walls.append((rng.uniform(0.002, 0.1) * m / period**2, rng.uniform(0.0, 0.2) * m / period))
    K, B = np.array(walls).T
    force = np.eye(1, PERIODS)[0] * PULSE
    return scenes, K, B, zwidth.simulate(scenes, K, B, periods=PERIODS, external_force_history=force)


@pytest.mark.parametrize("block", range(4))
def test_position_estimates_and_feedback_agree_with_the_composed_state_space(block, controlled):
    scenes, K, B, motion = controlled
    for index in range(block, LOOPS, 4):
        scene = scenes[index]
        period = step_coupling(scene, K[index], B[index])
        A, b, C = find_plant(scene)
        n, rate = len(b), np.zeros((len(b) + 1, len(b) + 1))
        rate[:n] = np.column_stack([A, b])
        state = np.zeros(len(period))
        state[:n] = expm(rate * scene.timing.period)[:n, n] * PULSE
        rows: list[Any] = [(0.0, 0.0, 0.0)]
        for _ in range(1, PERIODS):
            position, tool = C @ state[:n], state[-2]
            state = period @ state
            rows.append((position, state[n], state[-2] if scene.tool.integrator == "implicit" else tool))
        expected = np.array(rows).T
        simulated = [getattr(motion, name)[index] for name in ("measured", "command", "tool_position")]
        for values, reference in zip(simulated, expected, strict=True):
            scale = np.abs(reference).max()
            assert scale > 0
            np.testing.assert_allclose(values, reference, rtol=0, atol=TOLERANCE * scale, err_msg=str(scene))
