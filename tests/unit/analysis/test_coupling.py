"""Virtual couplings that are safe for every passive world: published limits, random worlds, invalid scenes."""

import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.signal import cont2discrete

import zwidth

PERIOD = 1e-3
DAMPING = 10.0


def make_scene(n_delay, mass=0.1, damping=DAMPING, **parts):
    return zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, f"{n_delay} periods"), **parts)


def compute_radius(body, n_delay, coupling, world):
    """Return the largest modulus of the poles of a device with a hand, a coupling and a world.

    The poles are the roots of the composed polynomial in z. Poles next to 1, the common drift of device and tool, do
    not count.

    Args:
        body: mass, damping and stiffness of device and hand together.
        n_delay: delay in periods.
        coupling: K and B.
        world: mass, damping and stiffness of a tool that is integrated by the implicit Euler method.
    """
    numerator, denominator, _ = cont2discrete(([1.0], list(body)), PERIOD)
    K, B = coupling
    M, D, S = world
    # Impedances in the velocity (1 - 1/z)/T, in ascending powers of 1/z, times (1 - 1/z).
    step = np.array([1.0, -1.0])
    spring_damper = polynomial.polyadd(B * step, [K * PERIOD])
    tool = polynomial.polyadd(polynomial.polymul(polynomial.polyadd(M / PERIOD * step, [D]), step), [S * PERIOD])
    # Coupling and tool in series, as a stiffness: force per position of the device.
    upper = polynomial.polymul(spring_damper, tool) / PERIOD
    lower = polynomial.polyadd(spring_damper, tool)
    plant = np.append(np.zeros(n_delay), numerator.ravel())
    loop = polynomial.polyadd(polynomial.polymul(denominator, lower), polynomial.polymul(plant, upper))
    roots = np.roots(np.trim_zeros(loop, "f"))
    return float(np.max(np.abs(roots[np.abs(roots - 1.0) > 1e-6])))


@pytest.mark.parametrize(
    ("n_delay", "without_damper", "stiffest", "virtual_damping"),
    [(0, 20_000, 20_000, 0.0), (1, 5_000, 7_698, 2.82), (2, 2_222.2, 4_834.5, 3.80)],
)
def test_limits(n_delay, without_damper, stiffest, virtual_damping):
    scene = make_scene(n_delay)
    assert scene.is_safe_for_every_world([0.9999 * without_damper, 1.0001 * without_damper], 0).tolist() == [
        True,
        False,
    ]
    top = scene.max_safe_coupling()
    assert top.stiffness == pytest.approx(stiffest, rel=1e-4)
    assert top.virtual_damping == pytest.approx(virtual_damping, abs=0.01)
    assert scene.is_safe_for_every_world(*top)
    assert scene.is_safe_for_every_world(0.999 * top.stiffness, top.virtual_damping)
    assert not scene.is_safe_for_every_world(1.001 * top.stiffness, top.virtual_damping)


def test_without_delay_safe_couplings_are_the_passive_walls():
    rng = np.random.default_rng(1)
    K, B = rng.uniform(0, 4e4, 10_000), rng.uniform(0, 12, 10_000)
    scene = make_scene(0)
    assert np.array_equal(scene.is_safe_for_every_world(K, B), scene.is_passive(K, B))


def test_no_passive_world_makes_a_safe_coupling_unstable():
    rng = np.random.default_rng(2)
    unstable_beyond = 0
    scenes = [make_scene(n_delay) for n_delay in range(4)]
    limits = [scene.max_safe_coupling() for scene in scenes]
    for _ in range(600):
        n_delay = int(rng.integers(0, 4))
        scene, top = scenes[n_delay], limits[n_delay]
        B = rng.choice([0.0, rng.uniform(0, 1), 1.0]) * top.virtual_damping
        K = top.stiffness * 10 ** rng.uniform(-1, 0.5)
        hand = 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(0, 5)
        body = [0.1, DAMPING, 0.0] + rng.integers(0, 2, 3) * hand
        tool = 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(0, 5)
        # A tool that can move freely is an extreme case, a tool that cannot move is a wall.
        world = rng.integers(0, 2, 3) * tool + np.array([1e-4, 0.0, 0.0])
        radius = compute_radius(body, n_delay, (K, B), world)
        if scene.is_safe_for_every_world(K, B):
            assert radius < 1 + 1e-9
        else:
            unstable_beyond += radius > 1 + 1e-9
    assert unstable_beyond > 10


def test_stiffest_safe_coupling_is_safe():
    rng = np.random.default_rng(3)
    for _ in range(100):
        mass, damping = 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(-3, 2)
        scene = make_scene(int(rng.integers(0, 8)), mass, damping)
        assert scene.is_safe_for_every_world(*scene.max_safe_coupling())


def test_units_and_wall_of_the_scene():
    scene = make_scene(1, wall=zwidth.VirtualWall("5 kN/m", "3 N s/m"))
    assert scene.is_safe_for_every_world()
    assert scene.is_safe_for_every_world("5 kN/m", ["3 N s/m", "11 N s/m"]).tolist() == [True, False]
    assert scene.is_safe_for_every_world([-1, np.nan], 0).tolist() == [False, False]
    assert not make_scene(1, damping=0).is_safe_for_every_world(1, 0)
    assert make_scene(1, damping=0).max_safe_coupling() == (0, 0)
    held = zwidth.Operator(mass=0.2, damping=3, stiffness=500)
    assert make_scene(1, operator=held).max_safe_coupling() == make_scene(1).max_safe_coupling()


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (make_scene(0, velocity=zwidth.LowPass(cutoff=100)), "velocity"),
        (make_scene(1.5), "delay: got 1.5 periods"),
        (zwidth.Scene(zwidth.LinearDevice("1 / 1 1 0"), zwidth.Timing(1e-3, 0)), "device"),
    ],
)
def test_scenes_without_condition_are_refused(scene, message):
    with pytest.raises(zwidth.InputError, match=message):
        scene.is_safe_for_every_world(1, 0)
    with pytest.raises(zwidth.InputError, match=message):
        scene.max_safe_coupling()
