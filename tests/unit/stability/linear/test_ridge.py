"""The stiffest wall of any scene: the published table, islands, the closed form, rows of the plane, and derivatives."""

import subprocess
import sys

import any_loop
import jax
import numpy as np
import pytest
from compiling import QUICKLY
from waiting import LONGEST

import zwidth
from zwidth import Actuator, Butterworth, Coupling, Device, LowPass, Operator, Scene, Status, Timing, WindowedDifference
from zwidth.core.errors import InputError, TracedDelayError
from zwidth.core.status import RidgeKind
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.ridge import Condition, RidgeSolution, find_ridge, list_ridge_parameters

# Mass 0.1 kg, period and delay 1 ms: K_max in kN/m at b = 0 and b = 10 N s/m, by a plain grid search with roots of
# polynomials, to 10 N/m (which is how wide its grid was).
TABLE = [
    (zwidth.BackwardDifference(), 14.44, 19.86),
    (WindowedDifference(5), 4.49, 8.75),
    (WindowedDifference(10), 2.05, 6.85),
    (WindowedDifference(15), 1.21, 6.85),
    (LowPass(cutoff=100), 7.27, 11.94),
    (LowPass(cutoff=30), 2.80, 7.49),
    (LowPass(cutoff=10), 1.01, 6.85),
    (LowPass(time_constant=0.05), 0.33, 6.85),
]
PAPER = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3))
WINDOW = PAPER.replace(velocity=WindowedDifference(15))


def wanted(scene: Scene, negative: bool) -> RidgeSolution:
    found = find_ridge(scene.loop.stable_set, negative)
    assert found is not None
    return found


@pytest.mark.parametrize("velocity, undamped, damped", TABLE)
def test_the_table_of_filters(velocity, undamped, damped):
    for damping, expected in ((0.0, undamped), (10.0, damped)):
        wall = PAPER.replace(velocity=velocity, damping=damping).max_stiffness()
        assert wall.status == Status.OK
        # A grid search stays below the top by up to a step.
        assert -0.0051 <= wall.stiffness / 1e3 - expected <= 0.0151
        binds = wall.kind == RidgeKind.NO_DAMPING
        assert binds == (expected == 6.85) == (wall.virtual_damping == 0)


@pytest.mark.parametrize(
    "delay, damping, velocity",
    [(4.3e-3, 0.5, LowPass(30.0)), (0.05, 10.0, LowPass(100.0)), (0.12, 0.0, WindowedDifference(4))],
)
def test_the_curve_borders_the_stable_walls_beside_it(delay, damping, velocity):
    scene = PAPER.replace(delay=delay, damping=damping, velocity=velocity)
    boundary = scene.loop.boundary
    curve = evaluate_curve(boundary.loop, boundary.w)
    # Next to other crossings, and where the curve's own angle is rounding, the two differ in which side they look at.
    sides = [boundary.count_outside(curve.alpha * (1.0 + side), curve.beta) for side in (-1e-9, 1e-9)]
    clear = (np.abs(sides[0] - sides[1]) == 2) & (np.minimum(*sides) >= 0)
    borders = boundary.are_stable_edges(boundary.w)
    assert clear.mean() > 0.95
    assert 50 < borders.sum() < 0.5 * borders.size
    np.testing.assert_array_equal(borders[clear], np.minimum(*sides)[clear] == 0)


def test_a_mode_without_damping_leaves_few_angles():
    # Its stable walls lie between two nodes of the curve, and their top is a corner that a digit of the angle moves.
    device = Device(
        3.4,
        coupling=Coupling(mass=0.0733, stiffness=190755.0, sensor="tip"),
        actuator=Actuator(68.4, order=2, damping_ratio=0.655),
    )
    scene = Scene(device, Timing(0.0065483, 0.0), velocity=Butterworth(1.404))
    wall = scene.max_stiffness()
    assert wall.status == Status.OK
    K, B = wall.stiffness * np.array([0.5, 1.0 - 1e-5, 1.0 + 1e-5, 1.5]), wall.virtual_damping
    np.testing.assert_array_equal(scene.is_stable(K, B), [True, True, False, False])
    # By the eigenvalues of the closed loop's matrix, where these know.
    assert any_loop.spectral_radius(scene, K[0], B) < 1.0 < any_loop.spectral_radius(scene, K[-1], B)


def test_a_corner_on_the_curve_of_a_mode_without_damping():
    # Along that curve angles differ by rounding. Expected: both conditions of the corner at 50 digits (mpmath).
    device = Device(0.0393, coupling=Coupling(mass=0.00545, stiffness=27.0))
    hand = Operator(mass=0.04, stiffness=95.0, coupling_stiffness=170000.0)
    wall = Scene(device, Timing(0.000143), velocity=WindowedDifference(8), operator=hand).max_stiffness()
    assert (wall.status, wall.kind) == (Status.OK, RidgeKind.CORNER)
    assert wall.stiffness == pytest.approx(71106.137068322691, rel=1e-11)
    assert wall.virtual_damping == pytest.approx(83.445589797423724, rel=1e-11)


def test_a_corner_with_an_edge_that_is_nearly_upright():
    # Three integrators, and a resonance that the dampings beyond the corner let grow. Expected: labels in balls.
    device = zwidth.LinearDevice(
        "1.5 209.3 4016.6 66588 947790 3897200 49966000 / 1 68.482 106720 7232800 151560000 2445200000 0 0 0"
    )
    scene = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(38.8))
    wall = scene.max_stiffness()
    assert (wall.status, wall.kind) == (Status.OK, RidgeKind.CORNER)
    K, B = (1.0 + np.array(s) for s in ([-1e-6, 1e-6, -1e-6], [-1e-8, -1e-8, 1e-8]))
    found = scene.decide_stability(K * wall.stiffness, B * wall.virtual_damping, method="certified")
    np.testing.assert_array_equal(found.status, Status.OK)
    np.testing.assert_array_equal(found.stable, [True, False, False])


def test_an_island_of_negative_damping_does_not_count():
    free = WINDOW.replace(damping=0.0)
    for negative in (False, True):
        assert free.max_stiffness(negative_damping=negative).stiffness == pytest.approx(1205.99, abs=0.01)
    assert free.islands() == []
    (island,) = free.islands(negative_damping=True)
    assert island.stiffness[1] == pytest.approx(12775.14, abs=0.01)
    assert island.virtual_damping[1] < 0
    # Below its top walls are stable, beyond it none is, nor between it and the soft ones.
    dampings = np.linspace(1.2 * island.virtual_damping[0], 200.0, 2001)
    assert free.is_stable(0.99 * island.stiffness[1], dampings).any()
    for stiffness in (1.0001 * island.stiffness[1], 0.9999 * island.stiffness[0]):
        assert not free.is_stable(stiffness, dampings[dampings < island.virtual_damping[1]]).any()


# Scenes by what binds them: whether B < 0 counts, the conditions.
BOUND = {
    "smooth": (PAPER.replace(velocity=LowPass(cutoff=100), delay=1.3e-3), False, "PAIR STATIONARY"),
    "row": (WINDOW.replace(delay=0.7e-3), False, "PAIR NO_DAMPING"),
    "corner": (WINDOW.replace(delay=0.7e-3), True, "PAIR PAIR"),
    "parts": (
        Scene(
            Device(0.1, 1.0, Coupling(0.05, 3e4, 1.0, "tip")),
            Timing(1e-3, 0.3e-3),
            velocity=LowPass(time_constant=1e-3, order=2, coded_period=2e-3),
            operator=Operator(0.5, 6.0, 135.0, 800.0, 4.0),
        ),
        False,
        "PAIR STATIONARY",
    ),
    "double pole": (
        Scene(Device(1.0, 19.0), Timing(1.0, 0.1), velocity=WindowedDifference(4)),
        False,
        "MINUS_ONE STATIONARY",
    ),
    "real pole": (Scene(Device(1.0, 15.4), Timing(1.0), velocity=Butterworth(0.117)), False, "PAIR MINUS_ONE"),
    "row at -1": (
        Scene(Device(1.0, 31.5), Timing(1.0), velocity=LowPass(cutoff=0.0244)),
        False,
        "MINUS_ONE NO_DAMPING",
    ),
}


@pytest.mark.parametrize("name", BOUND)
def test_derivatives_are_those_of_the_search(name):
    """Central differences of the search in NumPy, extrapolated, in every parameter of every part."""
    scene, negative, conditions = BOUND[name]
    found = wanted(scene, negative)
    assert f"{found.first.name} {found.second.name}" == conditions
    wall = scene.max_stiffness(negative_damping=negative)
    got = scene.sensitivities(negative_damping=negative)
    assert got.status == Status.OK
    assert got.stiffness == pytest.approx(wall.stiffness, rel=1e-11)
    assert set(got.per) == set(list_ridge_parameters(scene))
    for path, slope in got.per.items():
        value = scene.parameters()[path]
        if value:
            assert slope * value == pytest.approx(_difference(scene, path, negative), abs=1e-8 * wall.stiffness), path


def _difference(scene: Scene, path: str, negative: bool) -> float:
    """dK/d(log of the parameter), by two central differences."""
    value = scene.parameters()[path]

    def central(step: float) -> float:
        high, low = (
            scene.replace(**{path: value * (1.0 + side * step)}).max_stiffness(negative_damping=negative).stiffness
            for side in (1, -1)
        )
        return float(high - low) / (2.0 * step)

    first, second = central(1e-3), central(5e-4)
    return (4.0 * second - first) / 3.0


# d K_max by parameters of a light link that rings five times a period, from K_max solved in balls of 60 digits at
# parameters that differ by 1e-7 of themselves; steps of 0.4 % see nothing of its resonance.
ALIASED = {
    "coupling.stiffness": 1.0446256850735e-4, "coupling.mass": 32851.7571999, "coupling.damping": 8.3683265358629,
    "velocity.cutoff": 29.087575689, "damping": 467.84710444,
}  # fmt: skip


def test_derivatives_of_a_link_that_aliases_are_exact():
    device = Device(0.1, 1.0, Coupling(0.02, 16979900.0, 2.128, "tip"))
    found = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(cutoff=200.0)).sensitivities()
    assert found.status == Status.OK
    for path, expected in ALIASED.items():
        assert found.per[path] == pytest.approx(expected, rel=1e-8), path


def test_derivatives_of_random_light_links_are_those_of_short_steps():
    generator = np.random.default_rng(41)
    for _ in range(6):
        tip, turns = 10 ** generator.uniform(-2.3, -1.2), generator.uniform(0.6, 6.0)
        reduced = 0.1 * tip / (0.1 + tip)
        stiffness = reduced * (2e3 * np.pi * turns) ** 2
        damping = 2.0 * 10 ** generator.uniform(-3, -1.5) * np.sqrt(stiffness * reduced)
        sensor = "tip" if generator.random() < 0.5 else "motor"
        device = Device(0.1, 10 ** generator.uniform(-1, 1.3), Coupling(tip, stiffness, damping, sensor))
        scene = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(cutoff=150.0))
        found = scene.sensitivities()
        for path in ("coupling.stiffness", "coupling.mass", "mass"):
            value, step = scene.parameters()[path], 2e-6
            high, low = (scene.replace(**{path: value * (1 + side * step)}).max_stiffness() for side in (1, -1))
            # K_max is known to 1e-13.
            expected = (high.stiffness - low.stiffness) / (2 * step) / found.stiffness
            assert found.per[path] * value / found.stiffness == pytest.approx(expected, rel=1e-6, abs=2e-7), path


def test_derivatives_of_a_rigid_scene_are_the_closed_ones():
    expected = zwidth.sensitivities(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)
    got = PAPER.sensitivities()
    assert got.per == pytest.approx(
        {name: float(getattr(expected, f"per_{name}")) for name in ("mass", "damping", "period", "delay")}, rel=1e-14
    )
    held = PAPER.replace(operator=Operator(0.4, 2.0), delay=0.5e-3)
    per = held.sensitivities().per
    assert (per["operator.mass"], per["operator.damping"]) == (per["mass"], per["damping"])
    spring = 1e-2
    change = held.replace(**{"operator.stiffness": spring}).max_stiffness().stiffness - held.max_stiffness().stiffness
    assert per["operator.stiffness"] == pytest.approx(change / spring, rel=1e-4)


def test_derivatives_at_a_double_pole_of_a_chain_are_the_closed_ones():
    """A hand's spring of 1e-10 of K_max keeps the chain from being a rigid device, and changes nothing else."""
    scene = Scene(Device(0.1, 600.0), Timing(1e-3), operator=Operator(0.02, 10.0, 3e-4))
    found = wanted(scene, True)
    assert (found.first, found.second) == (Condition.MINUS_ONE, Condition.STATIONARY)
    per, expected = scene.sensitivities().per, zwidth.sensitivities(mass=0.12, damping=610.0, period=1e-3)
    for name in ("mass", "damping", "period", "delay"):
        assert per[name] == pytest.approx(float(getattr(expected, f"per_{name}")), rel=1e-7), name


def filtered(cutoff):
    return PAPER.replace(velocity=LowPass(cutoff=cutoff)).max_stiffness().stiffness


def test_inside_transformations(x64):
    assert float(jax.jit(filtered)(30.0)) == pytest.approx(filtered(30.0), rel=1e-12)
    # Three lanes have no filter, and spoil no other.
    many = jax.vmap(jax.value_and_grad(filtered))(np.array([30.0, 10.0, -1.0, 100.0, 500.0, np.nan]))
    assert np.isnan(np.array(many)[:, [2, 4, 5]]).all()
    good = np.array([0, 1, 3])
    np.testing.assert_allclose(many[0][good], [filtered(f) for f in (30.0, 10.0, 100.0)], rtol=1e-12)
    slope = _difference(PAPER.replace(velocity=LowPass(cutoff=100.0)), "velocity.cutoff", False) / 100.0
    assert float(many[1][3]) == pytest.approx(slope, rel=1e-8)
    # B = 0 binds at 10 Hz: the filter does not count.
    assert abs(float(many[1][1])) < 1e-8


def test_a_rigid_scene_is_differentiable_in_everything(x64):
    def at(delay, damping):
        return PAPER.replace(delay=delay, damping=damping).max_stiffness().stiffness

    got = jax.grad(at, argnums=(0, 1))(1e-3, 10.0)
    per = PAPER.sensitivities().per
    assert [float(slope) for slope in got] == pytest.approx([per["delay"], per["damping"]], rel=1e-12)

    def least(damping):
        return PAPER.replace(damping=damping, delay=0.0).max_stiffness(negative_damping=False).stiffness

    assert float(jax.jit(least)(700.0)) == pytest.approx(least(700.0), rel=1e-12)


def test_a_traced_delay_is_refused():
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0))
    for path in ("delay", "period"):
        with pytest.raises(TracedDelayError, match=r"timing: got a traced delay or period.*sensitivities"):
            jax.grad(lambda value, path=path: scene.replace(**{path: value}).max_stiffness().stiffness)(1e-3)


@pytest.mark.parametrize("question", ["is_stable", "margins", "stable_stiffness", "passivity_margin", "state_space"])
def test_what_takes_numbers_says_which_one_is_traced(question):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0), stiffness=1e3, virtual_damping=1.0)
    with pytest.raises(
        InputError,
        match=rf"damping: got a value (traced by JAX; call {question} with plain|that JAX traces; give) numbers",
    ):
        jax.jit(lambda damping: getattr(scene.replace(damping=damping), question)())(5.0)


def test_without_a_delay_the_period_may_be_traced(x64):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0), delay=0.0)
    slope = jax.grad(lambda period: scene.replace(period=period).max_stiffness().stiffness)(1e-3)
    assert float(slope) == pytest.approx(_difference(scene, "period", False) / 1e-3, rel=1e-8)


def test_a_linear_device_with_a_delay_of_no_whole_periods(x64):
    scene = Scene(zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0])), Timing(1e-3, 0.4e-3), velocity=LowPass(cutoff=100.0))

    def stiffness(cutoff):
        return scene.replace(velocity=LowPass(cutoff=cutoff)).max_stiffness().stiffness

    slope = jax.jit(jax.grad(stiffness), compiler_options=QUICKLY)(100.0)
    assert float(slope) == pytest.approx(scene.sensitivities().per["velocity.cutoff"], rel=1e-9)


def test_no_stable_wall_is_no_number():
    # The velocity with the wrong sign: every B >= 0 drives an undamped device.
    wrong = zwidth.VelocityFilter([-1e3, 1e3], [1.0, 0.0])
    scene = PAPER.replace(velocity=wrong, damping=0.0)
    wall = scene.max_stiffness()
    assert np.isnan([wall.stiffness, wall.virtual_damping, wall.frequency]).all()
    assert wall.status == Status.NO_BOUNDARY
    right = PAPER.replace(damping=0.0).max_stiffness()
    turned = scene.max_stiffness(negative_damping=True)
    assert (turned.stiffness, turned.virtual_damping) == pytest.approx((right.stiffness, -right.virtual_damping))
    assert turned.frequency == pytest.approx(right.frequency)


def test_a_ridge_without_its_rows_is_refused(monkeypatch):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0))
    low = wanted(scene, False)
    monkeypatch.setattr(
        "zwidth.stability.linear.ridge._identify_conditions", lambda *_: low._replace(alpha=0.9 * low.alpha)
    )
    wall = scene.max_stiffness()
    assert np.isnan(wall.stiffness)
    assert wall.status == Status.NOT_CONVERGED


def test_what_is_refused():
    with pytest.raises(InputError, match="delay_model"):
        WINDOW.replace(delay_model="fractional_power")


def test_the_frequency_is_that_of_the_higher_pair_at_a_corner():
    scene, negative, _ = BOUND["corner"]
    found = wanted(scene, negative)
    assert found.second == Condition.PAIR
    assert found.w2 > found.w1
    wall = scene.max_stiffness(negative_damping=negative)
    assert wall.frequency == pytest.approx(found.w2 / (2e-3 * np.pi), rel=1e-14)
    poles = np.array([found.w1, found.w2])
    walls = scene.boundary(poles / 1e-3)
    np.testing.assert_allclose(walls.stiffness, wall.stiffness, rtol=1e-9)
    np.testing.assert_allclose(walls.virtual_damping, wall.virtual_damping, rtol=1e-9)


def test_plain_numbers_need_no_jax():
    program = """
import sys, zwidth
scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=100))
assert scene.max_stiffness().status == 0 and "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=LONGEST)


def test_slopes_next_to_a_parameter_of_0_are_those_at_0():
    scene = Scene(Device(1.5, 0.0, Coupling(1.0, 300.0, 0.0)), Timing(period=2e-4))
    tiny = scene.replace(**{"damping": 1e-7, "coupling.damping": 1e-7, "delay": 1e-13})
    at_zero, beside = scene.sensitivities().per, tiny.sensitivities().per
    # In steps of a thousandth of themselves, rounding moved those in both dampings by 4e-3, that in the delay by 7e-6.
    for path in ("damping", "coupling.damping", "delay", "coupling.stiffness"):
        assert beside[path] == pytest.approx(at_zero[path], rel=1e-7)


@pytest.mark.parametrize("delay", [0.0, 0.5e-3, 1e-3])
@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=20.8)], ids=repr)
def test_a_device_that_moves_against_its_force_bears_what_its_own_spring_does(velocity, delay):
    # A pole comes to z = 1 where the wall's spring is as stiff as the device's own, whatever the damping.
    device = zwidth.LinearDevice(([-1.0], [0.1, 20.0, 1e3]))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3, delay), velocity=velocity)
    top = scene.max_stiffness(negative_damping=True)
    assert (top.status, top.stiffness) == (Status.OK, pytest.approx(1e3, rel=1e-12))
    softer = (1.0 - 1e-6) * top.stiffness
    assert scene.is_stable(softer, (1.0 - 1e-3) * top.virtual_damping)
    assert scene.decide_stability(softer, (1.0 - 1e-3) * top.virtual_damping, method="certified").stable
    assert not scene.is_stable((1.0 + 1e-9) * top.stiffness, np.linspace(-60.0, 60.0, 601)).any()
    slopes = scene.sensitivities(negative_damping=True)
    assert slopes.status == Status.OK
    np.testing.assert_allclose(list(slopes.per.values()), 0.0, atol=1e-3)
