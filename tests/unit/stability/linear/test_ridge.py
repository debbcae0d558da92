"""The maximum stiffness of linear scenes, against a published table, pole labels, the closed form and finite
differences.
"""

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
from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.derivatives import list_ridge_parameters
from zwidth.stability.linear.ridge import Condition, RidgeSolution, find_ridge

# Mass 0.1 kg, period and delay 1 ms: K_max in kN/m at b = 0 and b = 10 N s/m, from a grid search with polynomial roots,
# with a step of 10 N/m.
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


def solve_ridge(scene: Scene, negative: bool) -> RidgeSolution:
    solution = find_ridge(scene.loop.stable_set, negative)
    assert solution is not None
    return solution


@pytest.mark.parametrize("velocity, undamped, damped", TABLE)
def test_maximum_stiffness_of_filters_agrees_with_the_table(velocity, undamped, damped):
    for damping, expected in ((0.0, undamped), (10.0, damped)):
        wall = PAPER.replace(velocity=velocity, damping=damping).max_stiffness()
        assert wall.status == Status.OK
        # A grid search underestimates the maximum by up to one step.
        assert -0.0051 <= wall.stiffness / 1e3 - expected <= 0.0151
        at_zero_damping = wall.kind == RidgeKind.NO_DAMPING
        assert at_zero_damping == (expected == 6.85) == (wall.virtual_damping == 0)


@pytest.mark.parametrize(
    "delay, damping, velocity",
    [(4.3e-3, 0.5, LowPass(30.0)), (0.05, 10.0, LowPass(100.0)), (0.12, 0.0, WindowedDifference(4))],
)
def test_stable_edges_of_the_curve_agree_with_pole_counts(delay, damping, velocity):
    scene = PAPER.replace(delay=delay, damping=damping, velocity=velocity)
    boundary = scene.loop.boundary
    curve = evaluate_curve(boundary.loop, boundary.w)
    # Exclude points near other crossings or with an ill-defined normal, where the compared sides may differ.
    sides = [boundary.count_outside(curve.alpha * (1.0 + side), curve.beta) for side in (-1e-9, 1e-9)]
    clear = (np.abs(sides[0] - sides[1]) == 2) & (np.minimum(*sides) >= 0)
    borders = boundary.are_stable_edges(boundary.w)
    assert clear.mean() > 0.95
    assert 50 < borders.sum() < 0.5 * borders.size
    np.testing.assert_array_equal(borders[clear], np.minimum(*sides)[clear] == 0)


def test_maximum_with_an_undamped_mode():
    # The stable walls lie between two nodes of the curve; the maximum is a corner very sensitive to the angle.
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
    # Eigenvalues of the closed-loop matrix, where they are accurate.
    assert any_loop.spectral_radius(scene, K[0], B) < 1.0 < any_loop.spectral_radius(scene, K[-1], B)


def test_corner_on_the_curve_of_an_undamped_mode():
    # Along that curve, angles differ by rounding errors. Expected values: both corner conditions in 50 digits (mpmath).
    device = Device(0.0393, coupling=Coupling(mass=0.00545, stiffness=27.0))
    hand = Operator(mass=0.04, stiffness=95.0, coupling_stiffness=170000.0)
    wall = Scene(device, Timing(0.000143), velocity=WindowedDifference(8), operator=hand).max_stiffness()
    assert (wall.status, wall.kind) == (Status.OK, RidgeKind.CORNER)
    assert wall.stiffness == pytest.approx(71106.137068322691, rel=1e-11)
    assert wall.virtual_damping == pytest.approx(83.445589797423724, rel=1e-11)


def test_corner_with_a_nearly_vertical_edge():
    # Three integrators and a resonance that becomes unstable above the corner's damping. Expected: labels in balls.
    device = zwidth.LinearDevice(
        "1.5 209.3 4016.6 66588 947790 3897200 49966000 / 1 68.482 106720 7232800 151560000 2445200000 0 0 0"
    )
    scene = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(38.8))
    wall = scene.max_stiffness()
    assert (wall.status, wall.kind) == (Status.OK, RidgeKind.CORNER)
    K, B = (1.0 + np.array(s) for s in ([-1e-6, 1e-6, -1e-6], [-1e-8, -1e-8, 1e-8]))
    decision = scene.decide_stability(K * wall.stiffness, B * wall.virtual_damping, method="certified")
    np.testing.assert_array_equal(decision.status, Status.OK)
    np.testing.assert_array_equal(decision.stable, [True, False, False])


def test_island_at_negative_damping_is_excluded():
    free = WINDOW.replace(damping=0.0)
    for negative in (False, True):
        assert free.max_stiffness(negative_damping=negative).stiffness == pytest.approx(1205.99, abs=0.01)
    assert free.islands() == []
    (island,) = free.islands(negative_damping=True)
    assert island.stiffness[1] == pytest.approx(12775.14, abs=0.01)
    assert island.virtual_damping[1] < 0
    # Just below its maximum walls are stable; above it and between it and K = 0 none is.
    dampings = np.linspace(1.2 * island.virtual_damping[0], 200.0, 2001)
    assert free.is_stable(0.99 * island.stiffness[1], dampings).any()
    for stiffness in (1.0001 * island.stiffness[1], 0.9999 * island.stiffness[0]):
        assert not free.is_stable(stiffness, dampings[dampings < island.virtual_damping[1]]).any()


# Scenes by active constraints: name -> scene, whether B < 0 is allowed, the two conditions.
CONSTRAINED = {
    "smooth": (PAPER.replace(velocity=LowPass(cutoff=100), delay=1.3e-3), False, "PAIR STATIONARY"),
    "row": (WINDOW.replace(delay=0.7e-3), False, "PAIR NO_DAMPING"),
    "corner": (WINDOW.replace(delay=0.7e-3), True, "PAIR PAIR"),
    "filter and operator": (
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


@pytest.mark.parametrize("name", CONSTRAINED)
def test_sensitivities_agree_with_finite_differences(name):
    """Compare with extrapolated central differences of the NumPy solver, in every parameter of every component."""
    scene, negative, conditions = CONSTRAINED[name]
    solution = solve_ridge(scene, negative)
    assert f"{solution.first.name} {solution.second.name}" == conditions
    wall = scene.max_stiffness(negative_damping=negative)
    got = scene.sensitivities(negative_damping=negative)
    assert got.status == Status.OK
    assert got.stiffness == pytest.approx(wall.stiffness, rel=1e-11)
    assert set(got.per) == set(list_ridge_parameters(scene))
    for path, slope in got.per.items():
        value = scene.parameters()[path]
        if value:
            assert slope * value == pytest.approx(
                difference_quotient(scene, path, negative), abs=1e-8 * wall.stiffness
            ), path


def difference_quotient(scene: Scene, path: str, negative: bool) -> float:
    """Return dK/d(log of the parameter), extrapolated from two central differences."""
    value = scene.parameters()[path]

    def central(step: float) -> float:
        high, low = (
            scene.replace(**{path: value * (1.0 + side * step)}).max_stiffness(negative_damping=negative).stiffness
            for side in (1, -1)
        )
        return float(high - low) / (2.0 * step)

    first, second = central(1e-3), central(5e-4)
    return (4.0 * second - first) / 3.0


# dK_max/d(parameter) of a light link with a resonance at five times the sampling rate, from K_max solved in balls of 60
# digits at relative steps of 1e-7; steps of 0.4 % would miss the resonance.
ALIASED = {
    "coupling.stiffness": 1.0446256850735e-4, "coupling.mass": 32851.7571999, "coupling.damping": 8.3683265358629,
    "velocity.cutoff": 29.087575689, "damping": 467.84710444,
}  # fmt: skip


def test_sensitivities_of_a_link_above_the_sampling_rate():
    device = Device(0.1, 1.0, Coupling(0.02, 16979900.0, 2.128, "tip"))
    sensitivities = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(cutoff=200.0)).sensitivities()
    assert sensitivities.status == Status.OK
    for path, expected in ALIASED.items():
        assert sensitivities.per[path] == pytest.approx(expected, rel=1e-8), path


def test_sensitivities_of_random_light_links_agree_with_differences():
    generator = np.random.default_rng(41)
    for _ in range(6):
        tip, ratio = 10 ** generator.uniform(-2.3, -1.2), generator.uniform(0.6, 6.0)
        reduced = 0.1 * tip / (0.1 + tip)
        stiffness = reduced * (2e3 * np.pi * ratio) ** 2
        damping = 2.0 * 10 ** generator.uniform(-3, -1.5) * np.sqrt(stiffness * reduced)
        sensor = "tip" if generator.random() < 0.5 else "motor"
        device = Device(0.1, 10 ** generator.uniform(-1, 1.3), Coupling(tip, stiffness, damping, sensor))
        scene = Scene(device, Timing(1e-3, 1e-3), velocity=LowPass(cutoff=150.0))
        sensitivities = scene.sensitivities()
        for path in ("coupling.stiffness", "coupling.mass", "mass"):
            value, step = scene.parameters()[path], 2e-6
            high, low = (scene.replace(**{path: value * (1 + side * step)}).max_stiffness() for side in (1, -1))
            # K_max is accurate to 1e-13.
            expected = (high.stiffness - low.stiffness) / (2 * step) / sensitivities.stiffness
            assert sensitivities.per[path] * value / sensitivities.stiffness == pytest.approx(
                expected, rel=1e-6, abs=2e-7
            ), path


def test_sensitivities_of_a_rigid_scene_agree_with_the_closed_form():
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


def test_sensitivities_at_a_double_pole_agree_with_the_closed_form():
    """An operator spring of 1e-10 K_max selects the general solver and changes nothing else."""
    scene = Scene(Device(0.1, 600.0), Timing(1e-3), operator=Operator(0.02, 10.0, 3e-4))
    solution = solve_ridge(scene, True)
    assert (solution.first, solution.second) == (Condition.MINUS_ONE, Condition.STATIONARY)
    per, expected = scene.sensitivities().per, zwidth.sensitivities(mass=0.12, damping=610.0, period=1e-3)
    for name in ("mass", "damping", "period", "delay"):
        assert per[name] == pytest.approx(float(getattr(expected, f"per_{name}")), rel=1e-7), name


def filtered(cutoff):
    return PAPER.replace(velocity=LowPass(cutoff=cutoff)).max_stiffness().stiffness


def test_maximum_stiffness_inside_jax_transformations(x64):
    assert float(jax.jit(filtered)(30.0)) == pytest.approx(filtered(30.0), rel=1e-12)
    # Three batch entries have an invalid cutoff and must not affect the others.
    batch = jax.vmap(jax.value_and_grad(filtered))(np.array([30.0, 10.0, -1.0, 100.0, 500.0, np.nan]))
    assert np.isnan(np.array(batch)[:, [2, 4, 5]]).all()
    good = np.array([0, 1, 3])
    np.testing.assert_allclose(batch[0][good], [filtered(f) for f in (30.0, 10.0, 100.0)], rtol=1e-12)
    slope = difference_quotient(PAPER.replace(velocity=LowPass(cutoff=100.0)), "velocity.cutoff", False) / 100.0
    assert float(batch[1][3]) == pytest.approx(slope, rel=1e-8)
    # At 10 Hz the constraint B = 0 is active, and the filter has no effect.
    assert abs(float(batch[1][1])) < 1e-8


def test_rigid_scene_is_differentiable_in_delay_and_damping(x64):
    def maximum(delay, damping):
        return PAPER.replace(delay=delay, damping=damping).max_stiffness().stiffness

    got = jax.jit(jax.grad(maximum, argnums=(0, 1)), compiler_options=QUICKLY)(1e-3, 10.0)
    per = PAPER.sensitivities().per
    assert [float(slope) for slope in got] == pytest.approx([per["delay"], per["damping"]], rel=1e-12)

    def maximum_at_positive_damping(damping):
        return PAPER.replace(damping=damping, delay=0.0).max_stiffness(negative_damping=False).stiffness

    assert float(jax.jit(maximum_at_positive_damping)(700.0)) == pytest.approx(
        maximum_at_positive_damping(700.0), rel=1e-12
    )


@pytest.mark.parametrize("method", ["poles", "stable_stiffness", "state_space"])
def test_traced_parameter_is_named_in_the_error(method):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0), stiffness=1e3, virtual_damping=1.0)
    with pytest.raises(InputError, match=r"(damping|poles): got a value traced by JAX"):
        jax.jit(lambda damping: getattr(scene.replace(damping=damping), method)())(5.0)


def test_period_may_be_traced_without_a_delay(x64):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0), delay=0.0)
    slope = jax.grad(lambda period: scene.replace(period=period).max_stiffness().stiffness)(1e-3)
    assert float(slope) == pytest.approx(difference_quotient(scene, "period", False) / 1e-3, rel=1e-8)


def test_derivative_of_a_linear_device_with_fractional_delay(x64):
    scene = Scene(zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0])), Timing(1e-3, 0.4e-3), velocity=LowPass(cutoff=100.0))

    def stiffness(cutoff):
        return scene.replace(velocity=LowPass(cutoff=cutoff)).max_stiffness().stiffness

    slope = jax.jit(jax.grad(stiffness), compiler_options=QUICKLY)(100.0)
    assert float(slope) == pytest.approx(scene.sensitivities().per["velocity.cutoff"], rel=1e-9)


def test_maximum_is_nan_without_a_stable_wall():
    # The sign of the velocity is wrong: every B >= 0 drives an undamped device.
    wrong = zwidth.VelocityFilter([-1e3, 1e3], [1.0, 0.0])
    scene = PAPER.replace(velocity=wrong, damping=0.0)
    wall = scene.max_stiffness()
    assert np.isnan([wall.stiffness, wall.virtual_damping, wall.frequency]).all()
    assert wall.status == Status.NO_BOUNDARY
    right = PAPER.replace(damping=0.0).max_stiffness()
    mirrored = scene.max_stiffness(negative_damping=True)
    assert (mirrored.stiffness, mirrored.virtual_damping) == pytest.approx((right.stiffness, -right.virtual_damping))
    assert mirrored.frequency == pytest.approx(right.frequency)


def test_inconsistent_solution_has_status_not_converged(monkeypatch):
    scene = PAPER.replace(velocity=LowPass(cutoff=100.0))
    solution = solve_ridge(scene, False)
    monkeypatch.setattr(
        "zwidth.stability.linear.ridge._identify_conditions", lambda *_: solution._replace(alpha=0.9 * solution.alpha)
    )
    wall = scene.max_stiffness()
    assert np.isnan(wall.stiffness)
    assert wall.status == Status.NOT_CONVERGED


def test_fractional_power_with_a_filter_raises():
    with pytest.raises(InputError, match="delay_model"):
        WINDOW.replace(delay_model="fractional_power")


def test_frequency_at_a_corner_is_the_higher_one():
    scene, negative, _ = CONSTRAINED["corner"]
    solution = solve_ridge(scene, negative)
    assert solution.second == Condition.PAIR
    assert solution.w2 > solution.w1
    wall = scene.max_stiffness(negative_damping=negative)
    assert wall.frequency == pytest.approx(solution.w2 / (2e-3 * np.pi), rel=1e-14)
    poles = np.array([solution.w1, solution.w2])
    walls = scene.boundary(poles / 1e-3)
    np.testing.assert_allclose(walls.stiffness, wall.stiffness, rtol=1e-9)
    np.testing.assert_allclose(walls.virtual_damping, wall.virtual_damping, rtol=1e-9)


def test_maximum_stiffness_does_not_import_jax():
    program = """
import sys, zwidth
scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=100))
assert scene.max_stiffness().status == 0 and "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=LONGEST)


def test_sensitivities_are_continuous_at_zero_parameters():
    scene = Scene(Device(1.5, 0.0, Coupling(1.0, 300.0, 0.0)), Timing(period=2e-4))
    tiny = scene.replace(**{"damping": 1e-7, "coupling.damping": 1e-7, "delay": 1e-13})
    at_zero, near_zero = scene.sensitivities().per, tiny.sensitivities().per
    # With finite differences, rounding errors were 4e-3 in both dampings and 7e-6 in the delay.
    for path in ("damping", "coupling.damping", "delay", "coupling.stiffness"):
        assert near_zero[path] == pytest.approx(at_zero[path], rel=1e-7)


@pytest.mark.parametrize("delay", [0.0, 0.5e-3, 1e-3])
@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=20.8)], ids=repr)
def test_device_with_negative_gain_is_limited_by_its_own_stiffness(velocity, delay):
    # A pole reaches z = 1 at K equal to the device's own stiffness, at any damping.
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
