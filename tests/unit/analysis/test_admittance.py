"""Admittance displays against eigenvalues of a composed state space, a published program, and messages."""

import numpy as np
import pytest
from composed_displays import PROGRAMS, compose, find_radius, make_display

import zwidth

LAG = zwidth.Actuator(time_constant="20 ms")
TIMING = zwidth.Timing(rate="500 Hz", delay="4 periods")


@pytest.mark.parametrize("seed", range(40))
def test_limits_of_random_displays_agree_with_eigenvalues(seed):
    rng = np.random.default_rng(seed)
    display, robot = make_display(rng)
    damper = float(rng.choice([0.0, 10.0 ** rng.uniform(-1, 0.5) * display.virtual_damping]))
    limit = display.max_environment_stiffness(damper)
    if limit.status != zwidth.Status.OK:
        # Even the softest environment is unstable, for example because its damper is too strong.
        assert find_radius(display, robot, 1e-3 * display.virtual_damping, damper) > 1
        return
    K = float(limit.stiffness)
    for share in (0.01, 0.1, 0.3, 0.6, 0.9, 0.999):
        assert find_radius(display, robot, share * K, damper) < 1
    assert find_radius(display, robot, 1.001 * K, damper) > 1
    # Newton's method for the radius 1 in the logarithm of K, with a difference quotient.
    radius, slope = (
        find_radius(display, robot, K, damper),
        (find_radius(display, robot, K * (1 + 1e-5), damper) - find_radius(display, robot, K * (1 - 1e-5), damper))
        / 2e-5,
    )
    assert abs((radius - 1.0) / slope) < 1e-9
    poles = np.sort(np.abs(display.scene(0.7 * K, damper).poles()))[-3:]
    eigenvalues = np.sort(np.abs(np.linalg.eigvals(compose(display, robot, 0.7 * K, damper))))[-3:]
    np.testing.assert_allclose(poles, eigenvalues, rtol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_smallest_virtual_mass_agrees_with_eigenvalues(seed):
    rng = np.random.default_rng(100 + seed)
    display, robot = make_display(rng)
    stiffness = float(display.max_environment_stiffness().stiffness) * rng.uniform(0.1, 1.0)
    limit = display.min_virtual_mass(stiffness)
    assert limit.status == zwidth.Status.OK

    def find_radius_of(mass):
        parts = display.robot, display.timing, display.command, display.integrator
        changed = zwidth.AdmittanceDisplay(mass, display.virtual_damping, *parts)
        return find_radius(changed, robot, stiffness, 0.0)

    low, high = limit.virtual_mass, min(limit.largest, 1e3 * limit.virtual_mass)
    assert low < display.virtual_mass < limit.largest
    assert find_radius_of(0.999 * low) > 1
    for mass in np.geomspace(1.001 * low, 0.999 * high, 5):
        assert find_radius_of(mass) < 1
    if limit.largest < np.inf:
        assert find_radius_of(1.001 * limit.largest) > 1


def test_program_of_universal_robots():
    """Trapezoidal rule, velocity command, 500 Hz, robot with a lag of 20 ms and 4 periods; eigenvalues in 60 digits."""
    display = zwidth.AdmittanceDisplay("20 kg", "60 N s/m", LAG, TIMING, "velocity", "trapezoidal")
    limit = display.max_environment_stiffness()
    assert limit.stiffness == pytest.approx(2160.09, abs=0.005)
    assert display.is_stable(2150, 0)
    assert not display.is_stable("2.17 kN/m", 0.0)
    np.testing.assert_array_equal(display.is_stable([2150, 2170], [[0], [10]]), [[True, False], [True, True]])
    scene = display.scene("1 kN/m")
    assert scene.margins().gain_margin == pytest.approx(2.160088, rel=1e-6)
    assert repr(limit) == "EnvironmentLimit(stiffness=2.16008 kN/m, frequency=1.60773 Hz, status=OK)"


def test_first_order_robot_equals_a_scaled_backward_difference():
    """Without fractional delay, the velocity of the lag is p (1 - 1/z)/(tau (1 - p)) times its position."""
    display = zwidth.AdmittanceDisplay(20, 60, LAG, TIMING)
    p, T, M, D = np.exp(-0.1), 2e-3, 20, 60
    numerator = np.array([T * T / M * (1 - p), 0, 0])
    denominator = np.polymul(np.polymul([1, -1], [1, -(1 - T * D / M)]), [1, -p, 0, 0, 0, 0])
    velocity = zwidth.VelocityFilter(p / (0.02 * (1 - p)) * np.array([1, -1]), [1, 0])
    loop = zwidth.Scene(zwidth.LinearDevice((numerator, denominator), sampled=T), zwidth.Timing(T), velocity=velocity)
    for damper in (0, 5, 50):
        expected = loop.stable_stiffness(damper)[-1, 1]
        assert display.max_environment_stiffness(damper).stiffness == pytest.approx(expected, rel=1e-9)


def test_arrays_of_dampings_and_rotary_units():
    display = zwidth.AdmittanceDisplay("0.5 kg m^2", "2 N m s/rad", LAG, TIMING)
    limits = display.max_environment_stiffness([0, 1])
    assert limits.stiffness.shape == (2,)
    assert limits.stiffness[0] < limits.stiffness[1]
    assert "N m/rad" in repr(display.max_environment_stiffness("1 N m s/rad"))
    assert "kg m^2" in repr(display.min_virtual_mass(hand_stiffness="10 N m/rad"))
    assert display.scene("10 N m/rad").wall.stiffness == 10


def test_sampled_robot_allows_only_a_spring():
    T = 2e-3
    sampled = zwidth.LinearDevice(([1 - np.exp(-0.1)], [1, -np.exp(-0.1)]), sampled=T)
    by_model, by_samples = (
        zwidth.AdmittanceDisplay(20, 60, robot, TIMING).max_environment_stiffness() for robot in (LAG, sampled)
    )
    assert by_samples.stiffness == pytest.approx(by_model.stiffness, rel=1e-12)
    with pytest.raises(zwidth.InputError, match="environment_damping: got a damper with a sampled robot"):
        zwidth.AdmittanceDisplay(20, 60, sampled, TIMING).max_environment_stiffness(1)


def test_display_without_damping_is_unstable_in_any_spring():
    display = zwidth.AdmittanceDisplay(20, 0, LAG, TIMING)
    limit = display.max_environment_stiffness()
    assert np.isnan(limit.stiffness)
    assert limit.status == zwidth.Status.NO_BOUNDARY
    assert np.isnan(display.min_virtual_mass(100).virtual_mass)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"virtual_mass": 0}, "virtual_mass: got 0"),
        ({"virtual_mass": "20 N"}, "virtual_mass: got '20 N'"),
        ({"virtual_damping": -1}, "virtual_damping: got -1"),
        ({"virtual_mass": "1 kg", "virtual_damping": "1 N m s/rad"}, "together with"),
        ({"robot": 3}, "robot: got 3; pass zwidth.Actuator"),
        ({"robot": None}, "robot: got None"),
        ({"timing": 1e-3}, "timing: got 0.001"),
        ({"command": "force"}, "command: got 'force'"),
        ({"integrator": "euler"}, "integrator: got 'euler'"),
        ({"robot": zwidth.LinearDevice("1 / 1 -0.5", sampled=2e-3), "command": "velocity"}, "velocity command"),
        ({"robot": zwidth.LinearDevice("1 / 1 -0.5", sampled=1e-3)}, "sampled at 0.001 s in a loop of 0.002 s"),
    ],
)
def test_invalid_arguments_raise(changes, message):
    given = {"virtual_mass": 20, "virtual_damping": 60, "robot": LAG, "timing": TIMING, **changes}
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.AdmittanceDisplay(**given)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda display: display.max_environment_stiffness(-1), "environment_damping: got -1"),
        (lambda display: display.scene(-1), "environment_stiffness: got -1"),
        (lambda display: display.min_virtual_mass("1 kg"), "hand_stiffness: got '1 kg'"),
        (lambda display: display.min_virtual_mass(0), "hand_stiffness: got 0"),
        (lambda display: display.is_stable(100, [np.nan, 1]), "environment_damping: got nan"),
    ],
)
def test_invalid_environments_raise(call, message):
    with pytest.raises(zwidth.InputError, match=message):
        call(zwidth.AdmittanceDisplay(20, 60, LAG, TIMING))


@pytest.mark.parametrize("program", PROGRAMS)
def test_grids_equal_single_displays(program):
    """A grid contains limits, displays without a limit, and displays near the limit of the explicit damper."""
    display = zwidth.AdmittanceDisplay(20, 60, LAG, zwidth.Timing(rate="500 Hz", delay="1.5 periods"), *program)
    masses, dampings, dampers = [[[0.1]], [[2]], [[50]]], [[0.05], [30], [150]], [0, 12.5]
    grid = display.max_environment_stiffness(dampers, virtual_mass=masses, virtual_damping=dampings)
    assert grid.stiffness.shape == grid.frequency.shape == grid.status.shape == (3, 3, 2)
    for i, j, k in np.ndindex(grid.stiffness.shape):
        single = zwidth.AdmittanceDisplay(masses[i][0][0], dampings[j][0], LAG, display.timing, *program)
        # The stable intervals of the gain come from exact polynomials (V11 to V15).
        intervals = single.scene(0, dampers[k]).stable_stiffness(0.0)
        expected = intervals[intervals[:, 0] <= 0]
        assert (grid.status[i, j, k] == zwidth.Status.OK) == (expected.size > 0)
        if expected.size:
            assert grid.stiffness[i, j, k] == pytest.approx(expected[0, 1], rel=1e-11)
            frequency = single.scene(grid.stiffness[i, j, k], dampers[k]).dominant_pole().frequency
            assert grid.frequency[i, j, k] == pytest.approx(frequency, rel=1e-9)
        else:
            assert np.isnan(grid.stiffness[i, j, k])


def test_grids_accept_texts_and_empty_arrays():
    display = zwidth.AdmittanceDisplay(20, 60, LAG, TIMING)
    limits = display.max_environment_stiffness(virtual_mass=["5 kg", "20 kg"], virtual_damping="60 N s/m")
    assert limits.stiffness[1] == display.max_environment_stiffness().stiffness
    assert display.max_environment_stiffness(virtual_mass=np.ones((0, 2))).stiffness.shape == (0, 2)
    with pytest.raises(zwidth.InputError, match="virtual_mass: got -1 kg; it must be > 0"):
        display.max_environment_stiffness(virtual_mass=-1)
    limits = display.max_environment_stiffness([0, np.nan], virtual_mass=[[20], [-1], [np.inf]])
    assert limits.stiffness[0, 0] == display.max_environment_stiffness().stiffness
    assert np.all(np.isnan(limits.stiffness.ravel()[1:]))
    np.testing.assert_array_equal(limits.status.ravel(), [0, *[zwidth.Status.INVALID_INPUT] * 5])
    with pytest.raises(zwidth.InputError, match="virtual_damping: got '3 kg'"):
        display.max_environment_stiffness(virtual_damping="3 kg")


def test_weakly_damped_and_long_delayed_displays():
    """Displays whose poles are too close to the unit circle for eigenvalues, or with many delayed commands."""
    for delay in ("0 periods", "25 periods", "40.5 periods"):
        display = zwidth.AdmittanceDisplay(100, 1e-3, LAG, zwidth.Timing("1 ms", delay), "velocity", "trapezoidal")
        for virtual_damping in (1e-3, 10.0):
            limit = display.max_environment_stiffness(virtual_damping=virtual_damping)
            single = zwidth.AdmittanceDisplay(100, virtual_damping, LAG, display.timing, "velocity", "trapezoidal")
            assert limit.stiffness == pytest.approx(single.scene().stable_stiffness(0.0)[-1, 1], rel=1e-9)


def test_robots_with_very_fast_and_very_slow_modes():
    """Robots with modes that decay within a period, and with four modes that take a hundred periods."""
    T = 0.01
    for poles in ([-37.8 + 44.8j, -37.8 - 44.8j, -4.9, -0.8], [-0.01, -0.011, -0.012 + 0.01j, -0.012 - 0.01j]):
        denominator = np.poly(np.array(poles) / T).real
        robot, timing = zwidth.LinearDevice((denominator[-1:], denominator)), zwidth.Timing(T, "0.2 periods")
        display = zwidth.AdmittanceDisplay(0.003, 2e-4, robot, timing)
        limits = display.max_environment_stiffness([0, 5e-4], virtual_damping=[[2e-4], [1e-2]])
        for i, j in np.ndindex(2, 2):
            single = zwidth.AdmittanceDisplay(0.003, [2e-4, 1e-2][i], robot, timing)
            intervals = single.scene(0, [0, 5e-4][j]).stable_stiffness(0.0)
            assert intervals[0, 0] <= 0
            assert limits.stiffness[i, j] == pytest.approx(intervals[0, 1], rel=1e-9)


def test_messages_name_the_display_and_the_remedy():
    timing = zwidth.Timing(rate="500 Hz", delay="4 periods")
    display = zwidth.AdmittanceDisplay(20, 0, zwidth.Actuator(time_constant="20 ms"), timing)
    assert "NO_BOUNDARY: The display is unstable with every virtual mass; change" in repr(display.min_virtual_mass(500))
    assert "NO_BOUNDARY: The display is unstable even in soft" in repr(display.max_environment_stiffness())
    with pytest.raises(zwidth.InputError, match=r"do not broadcast: virtual_mass \(3,\), virtual_damping \(2,\)"):
        display.max_environment_stiffness(virtual_mass=[1, 2, 3], virtual_damping=[60, 70])
    with pytest.raises(zwidth.InputError, match="do not broadcast: environment_stiffness"):
        display.is_stable([100, 200], [1, 2, 3])
    for scene in (display.scene(100), display.scene().replace(stiffness=200)):
        with pytest.raises(zwidth.InputError, match=r"recommend: got the scene of an adm.*min_virtual_mass"):
            scene.recommend()
