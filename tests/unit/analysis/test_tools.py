"""Scenes with a simulated tool, against eigenvalues of the composed loop and published limits."""

from typing import Any

import jax
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import tf2ss

import zwidth

PERIOD = 1e-3
INTEGRATORS = ("semi-implicit", "implicit")
untyped: Any = zwidth  # for arguments of wrong types


def make_scene(mass, n_delay: float = 1, integrator: Any = "semi-implicit", damping=10, **parts):
    tool = zwidth.Tool(mass, integrator=integrator) if mass else None
    return zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(PERIOD, f"{n_delay} periods"), tool=tool, **parts)


def sample_device(device, hand, d):
    """Return A, B and C of a device with a hand on a spring, with a zero-order hold and a delay of d periods."""
    mass, damping = device
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    m_h, b_h, k_h, k_g, c_g = hand
    A[1] = np.array([-k_g, -damping - c_g, k_g, c_g]) / mass
    A[3] = np.array([k_g, c_g, -k_h - k_g, -b_h - c_g]) / m_h
    B = np.array([0.0, 1.0 / mass, 0.0, 0.0])

    def flow(time):
        block = expm(np.vstack([np.column_stack([A, B]), np.zeros(5)]) * time)
        return block[:4, :4], block[:4, 4]

    n = int(d)
    transition, full = flow(PERIOD)
    late = flow((1.0 - (d - n)) * PERIOD)[1]
    size = 5 + n
    sampled, force = np.zeros((size, size)), np.zeros(size)
    sampled[:4, :4], force[4] = transition, 1.0
    sampled[np.arange(5, size), np.arange(4, size - 1)] = 1.0
    sampled[:4, 4 + n] += full - late
    if n:
        sampled[:4, 3 + n] += late
    else:
        force[:4] = late
    return sampled, force, np.eye(size)[0]


def compute_radius(plant, velocity, tool, integrator, K, B):
    """Return the spectral radius of the composed state equation of device, velocity estimate and tool."""
    (A, force, C), (numerator, denominator), (M, c, k) = plant, velocity, tool
    a, b, q, feedthrough = tf2ss(K * denominator + B * numerator, denominator)
    q, g = q[0], feedthrough[0, 0]
    n, m = len(A), len(a)
    rows = np.eye(n + m + 2)
    x, position, speed = C @ rows[:n], rows[-2], rows[-1]
    inner = q @ rows[n : n + m]
    rate = PERIOD / M
    if integrator == "semi-implicit":
        y = position
        f = inner + g * (x - y)
        new_speed = speed + rate * (f - c * speed - k * y)
        new_position = y + PERIOD * new_speed
    else:
        # The position state is that of the previous sample. Solve the coupling force and the new velocity together.
        pull = inner + g * (x - position) - k * position
        new_speed = (speed + rate * pull) / (1.0 + rate * (c + PERIOD * (k + g)))
        y = new_position = position + PERIOD * new_speed
        f = inner + g * (x - y)
    loop = [A @ rows[:n] - np.outer(force, f), a @ rows[n : n + m] + np.outer(b[:, 0], x - y)]
    return np.max(np.abs(np.linalg.eigvals(np.vstack([*loop, new_position, new_speed]))))


@pytest.mark.parametrize("seed", range(16))
def test_random_couplings_against_eigenvalues(seed):
    rng = np.random.default_rng(seed)

    def draw(low, high):
        return float(10 ** rng.uniform(low, high))

    device, hand = (draw(-2, 0), draw(-1, 1)), (draw(-1, 0), draw(0, 1.5), draw(1, 3), draw(2, 4), draw(-1, 1))
    tool, integrator = (draw(-2, 0.5), draw(-1, 1), draw(0, 3)), INTEGRATORS[seed % 2]
    d, cutoff = float(rng.choice([0, 1, 2, rng.uniform(0, 4)])), draw(1, 2.6)
    pole = np.exp(-2 * np.pi * cutoff * PERIOD)
    velocity = np.array([1.0, -1.0]) * (1 - pole) / PERIOD, np.array([1.0, -pole])
    grasp = dict(zip(("mass", "damping", "stiffness", "coupling_stiffness", "coupling_damping"), hand, strict=True))
    scene = zwidth.Scene(
        zwidth.Device(*device),
        zwidth.Timing(PERIOD, f"{d!r} periods"),
        velocity=zwidth.LowPass(cutoff=cutoff),
        operator=zwidth.Operator(**grasp),
        tool=zwidth.Tool(*tool, integrator=integrator),
    )
    plant = sample_device(device, hand, d)
    unit = min(device[0], tool[0]) / PERIOD**2
    K, B = unit * 10 ** rng.uniform(-3, 0.6, 8), unit * PERIOD * 10 ** rng.uniform(-3, 0.5, 8)
    exact = np.array([compute_radius(plant, velocity, tool, integrator, *wall) for wall in zip(K, B, strict=True)])
    away = np.abs(exact - 1) > 1e-7
    assert (scene.is_stable(K, B) == (exact < 1))[away].all()
    np.testing.assert_allclose(scene.spectral_radius(K, B), exact, rtol=1e-10)
    top = scene.max_stiffness()
    if top.status == zwidth.Status.OK and np.isfinite(top.stiffness):
        radius = compute_radius(plant, velocity, tool, integrator, float(top.stiffness), float(top.virtual_damping))
        assert abs(radius - 1) < 1e-9


@pytest.mark.parametrize(
    ("n_delay", "mass", "expected"),
    [
        (1, 1, 20_462), (1, 0.3, 22_201), (1, 0.1, 30_832), (0, 1, 83_758), (0, 0.3, 86_584), (0, 0.1, 94_033),
        (0, 0.03, 84_413), (0, 0.01, 36_020), (0, 0.003, 11_641),
    ],
)  # fmt: skip
def test_stiffest_couplings(n_delay, mass, expected):
    assert make_scene(mass, n_delay).max_stiffness().stiffness == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_heavy_tool_is_a_wall(integrator):
    heavy, wall = make_scene(1e9, integrator=integrator).max_stiffness(), make_scene(None).max_stiffness()
    assert heavy.stiffness == pytest.approx(wall.stiffness, rel=1e-6)
    assert heavy.virtual_damping == pytest.approx(wall.virtual_damping, rel=1e-3)


def test_light_implicit_tool_has_no_largest_stiffness():
    scene = make_scene(0.03, integrator="implicit")
    assert scene.max_stiffness().stiffness == np.inf
    assert scene.is_stable([1, 1e5, 1e9, 1e15], 0).all()
    assert (scene.spectral_radius([1e5, 1e9, 1e15], 0) < 1).all()
    with pytest.raises(zwidth.InputError, match="every stiffness"):
        scene.recommend()
    with pytest.raises(zwidth.InputError, match="no boundary"):
        scene.stable_region()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_method_agrees(integrator):
    scene = make_scene("300 g", integrator=integrator, velocity=zwidth.LowPass(cutoff=200))
    K = np.array([2e3, 10e3, 15e3, 40e3])
    expected = scene.is_stable(K, 30)
    assert expected.tolist() == [True, True, True, False]
    for method in ("companion", "certified"):
        assert scene.decide_stability(K, 30, method=method).stable.tolist() == expected.tolist()
    gain = scene.margins(5e3, 20).gain_margin
    assert scene.is_stable(0.999999 * gain * 5e3, 0.999999 * gain * 20)
    assert not scene.is_stable(1.000001 * gain * 5e3, 1.000001 * gain * 20)
    late = float(scene.margins(5e3, 20).delay_margin)
    assert scene.replace(delay=1e-3 + 0.999999 * late).is_stable(5e3, 20)
    assert not scene.replace(delay=1e-3 + 1.000001 * late).is_stable(5e3, 20)
    assert scene.stable_region()[0].stiffness.max() == pytest.approx(float(scene.max_stiffness().stiffness), rel=1e-4)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_sensitivities(integrator):
    tool = zwidth.Tool(0.3, 2, 100, integrator)
    scene = make_scene(None).replace(tool=tool)
    slopes = scene.sensitivities()
    for path in ("tool.mass", "tool.damping", "tool.stiffness", "damping"):
        value = scene.parameters()[path]
        ends = [float(scene.replace(**{path: value * (1 + h)}).max_stiffness().stiffness) for h in (1e-4, -1e-4)]
        assert slopes.per[path] == pytest.approx((ends[0] - ends[1]) / (2e-4 * value), rel=1e-5)
    with jax.enable_x64(True):
        gradient = jax.grad(lambda mass: scene.replace(**{"tool.mass": mass}).max_stiffness().stiffness)(0.3)
        labels = jax.jit(lambda scene, K: scene.is_stable(K, 20))(scene, np.array([5e3, 80e3]))
    assert gradient == pytest.approx(slopes.per["tool.mass"], rel=1e-9)
    assert labels.tolist() == [True, False]


@pytest.mark.parametrize("n_delay", [0, 1, 1.5])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("coupling", [(4900, 0), (4900, 2), (20_000, 40), (80_000, 60)])
def test_lightest_tool(n_delay, integrator, coupling):
    scene = make_scene(None, n_delay)
    result = scene.lightest_tool(*coupling, integrator=integrator)
    for mass in np.geomspace(1e-4, 100, 40).tolist():
        inside = any(low < mass < high for low, high in result.intervals)
        assert bool(make_scene(mass, n_delay, integrator).is_stable(*coupling)) == inside
    if result.intervals:
        assert (result.mass, result.heaviest) == result.intervals[-1]


def test_lightest_tool_without_stable_mass():
    result = make_scene(None).lightest_tool(0, 5)
    assert np.isnan(result.mass)
    assert result.status == zwidth.Status.NO_BOUNDARY
    assert result.intervals == ()


def test_semi_implicit_tool_is_unstable_with_a_safe_coupling():
    scene = make_scene("1 g")
    assert scene.is_safe_for_every_world(4900, 0)
    assert scene.spectral_radius(4900, 0) == pytest.approx(2.5, abs=0.1)
    assert make_scene("1 g", integrator="implicit").is_stable(4900, 0)


def test_rotary_tool():
    device, timing = zwidth.Device("1e-4 kg m^2", "0.01 N m s/rad"), zwidth.Timing("1 ms", "1 ms")
    top = zwidth.Scene(device, timing, tool=zwidth.Tool("3e-4 kg m^2")).max_stiffness()
    assert top.stiffness == pytest.approx(22.201, abs=1e-3)
    with pytest.raises(zwidth.InputError, match="rotary units"):
        zwidth.Scene(zwidth.Device(0.1, 10), timing, tool=zwidth.Tool("3e-4 kg m^2"))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene: zwidth.Tool(0), "tool.mass"),
        (lambda scene: untyped.Tool(1, integrator="verlet"), "tool.integrator"),
        (lambda scene: scene.simulate(5e3, 5, contact="unilateral"), "contact: got 'unilateral'"),
        (lambda scene: zwidth.diagnose(scene, 5e3, 5), "diagnose supports walls only"),
        (lambda scene: scene.open_loop(5e3, 5), "excludes a tool"),
        (lambda scene: scene.is_passive(5e3, 5), "is_safe_for_every_world"),
        (lambda scene: scene.recommend(passive=True), "is_safe_for_every_world"),
        (lambda scene: scene.lightest_tool(5e3, 5, integrator="euler"), "integrator"),
        (lambda scene: scene.replace(tool=3), "tool: got 3"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(zwidth.InputError, match=message):
        call(make_scene(0.3))


def test_assessment_and_tolerances():
    scene = make_scene(0.3).replace(stiffness=5e3, virtual_damping=20)
    verdict = zwidth.assess(scene)
    assert verdict.stable
    assert verdict.passive is None
    assert verdict.stiffness_max == pytest.approx(22_200.57, abs=0.1)
    walls = zwidth.stiffest_walls(make_scene(0.3), {"tool.mass": [1, 0.3, 0.1]})
    np.testing.assert_allclose(walls.stiffness, [20_461.8, 22_200.6, 30_831.9], atol=0.1)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_state_space(integrator):
    tool = zwidth.Tool(0.3, 1, 0, integrator)
    scene = make_scene(None, 1.3, velocity=zwidth.LowPass(cutoff=100)).replace(tool=tool)
    model = scene.state_space(5e3, 20)
    eigenvalues = np.linalg.eigvals(model.A)
    # The state-space model includes the common drift of device and tool, a pole at z = 1.
    others = np.delete(eigenvalues, np.argmin(np.abs(eigenvalues - 1)))
    poles = scene.poles(5e3, 20)
    assert max(np.min(np.abs(others - pole)) for pole in poles) < 1e-9
    # A force of 1 N moves device and tool together against both dampers.
    response = model.step(20_000)
    assert (response[-1] - response[-2]) / PERIOD == pytest.approx(1 / 11, rel=1e-9)


@pytest.mark.parametrize("n_delay", [0, 1, 2])
def test_safe_couplings_are_stable_with_implicit_tools(n_delay):
    rng = np.random.default_rng(n_delay)
    stiffest = make_scene(None, n_delay).max_safe_coupling()
    for _ in range(8):
        mass, damping, stiffness = (10 ** rng.uniform(*ends) for ends in ((-4, 1), (-2, 1), (0, 4)))
        hand = zwidth.Operator(*(10 ** rng.uniform(*ends) for ends in ((-1, 0), (0, 1.5), (1, 3))))
        tool = zwidth.Tool(mass, damping, stiffness, "implicit")
        scene = make_scene(None, n_delay, operator=hand).replace(tool=tool)
        share = rng.uniform(0.1, 0.999)
        assert scene.is_safe_for_every_world(share * stiffest.stiffness, share * stiffest.virtual_damping)
        assert np.abs(scene.poles(share * stiffest.stiffness, share * stiffest.virtual_damping)).max() < 1
