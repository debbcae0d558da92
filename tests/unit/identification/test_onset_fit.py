"""A device from buzzing walls: exact ones give it back, noisy ones with the error they claim, poor ones are refused."""

import numpy as np
import pytest
import tolerances
from measured_devices import OTHERS, PERIOD, OtherDevice
from scipy.linalg import expm

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status

EXACT = tolerances.FIT_EXACT.float64
HEARD = [(6846.364, 0.0, 40.0945620), (15860.788, 18.7195, 68.6254)]


def walls_of(scene, shares):
    """Exact walls on the edge of stability of a rigid device, at shares of the damping of the stiffest one."""
    beta = np.asarray(shares) * float(zwidth.alpha_max(scene.delta, scene.d).beta)
    point = zwidth.boundary_point(scene.delta, scene.d, beta=beta)
    period = scene.timing.period
    wall = scene.to_si(alpha=point.alpha, beta=beta)
    return np.stack([wall.stiffness, wall.virtual_damping, point.omega / (2 * np.pi * period)], -1)


def scene_of(mass, delta, d, period):
    return zwidth.Scene(zwidth.Device(mass, delta * mass / period), zwidth.Timing(period=period, delay=d * period))


def assert_found(fit, scene):
    found = [fit.mass / scene.mass, fit.damping / scene.damping, (fit.delay - scene.timing.delay) / scene.timing.period]
    np.testing.assert_allclose(found, [1, 1, 0], rtol=EXACT, atol=EXACT)
    assert fit.status == Status.OK
    assert fit.warnings == ()


def random_scene(seed):
    rng = np.random.default_rng(seed)
    whole = rng.random() < 0.5
    d = float(rng.integers(0, 6)) if whole else rng.uniform(0, 6)
    return scene_of(10 ** rng.uniform(-2, 0.5), 10 ** rng.uniform(-3, 0.5), d, 10 ** rng.uniform(-4, -2.5))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [2, 4])
def test_exact_walls_give_the_device_back(seed, count):
    scene = random_scene(seed)
    walls = walls_of(scene, np.linspace(0.0, 0.8, count))
    fit = zwidth.fit_buzz(walls, period=scene.timing.period)
    assert_found(fit, scene)
    assert fit.stiffness_max == pytest.approx(float(scene.max_stiffness().stiffness), rel=EXACT)


def rightmost(mass, damping, period, whole, stiffness, virtual_damping):
    """The largest pole of a loop with whole delays, by the eigenvalues of its matrix exponential."""
    step = expm(np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]]) * period)
    size = 3 + whole
    # Position, velocity, the position before, and the forces that wait.
    loop = np.zeros((size, size))
    loop[:2, :2] = step[:2, :2]
    loop[2, 0] = 1.0
    law = np.zeros(size)
    law[0], law[2] = -stiffness - virtual_damping / period, virtual_damping / period
    acting = law if whole == 0 else np.eye(size)[3]
    loop[:2] += np.outer(step[:2, 2], acting)
    for k in range(whole):
        loop[3 + k] = np.eye(size)[4 + k] if k + 1 < whole else law
    poles = np.linalg.eigvals(loop)
    return poles[np.argmax(np.abs(poles))]


@pytest.mark.parametrize("whole", [0, 2])
def test_walls_that_eigenvalues_find_give_the_device_back(whole):
    mass, damping, period = 0.2, 8.0, 5e-4
    walls = []
    for virtual_damping in (4.0, 25.0):
        low, high = 1.0, 2e5
        while high - low > 1e-13 * high:
            middle = 0.5 * (low + high)
            growing = abs(rightmost(mass, damping, period, whole, middle, virtual_damping)) > 1
            low, high = (low, middle) if growing else (middle, high)
            if middle in (low, high) and high - low <= 2 * np.spacing(high):
                break
        pole = rightmost(mass, damping, period, whole, low, virtual_damping)
        walls.append(zwidth.BuzzPoint(low, virtual_damping, abs(np.angle(pole)) / (2 * np.pi * period)))
    fit = zwidth.fit_buzz(walls, period="0.5 ms")
    # An eigenvalue on the circle knows K to some 1e-12 of it.
    np.testing.assert_allclose([fit.mass, fit.damping], [mass, damping], rtol=EXACT)
    assert fit.delay == pytest.approx(whole * period, abs=EXACT * period)


def test_with_a_filtered_velocity():
    filtered = zwidth.LowPass(cutoff=150)
    scene = zwidth.Scene(zwidth.Device(0.1, 5), zwidth.Timing(period=1e-3, delay=0.7e-3), velocity=filtered)
    omega = np.linspace(60, 500, 400)
    walls = scene.boundary(omega)
    edge = np.asarray(scene.is_stable(walls.stiffness * (1 - 1e-6), walls.virtual_damping))
    edge = edge & ~scene.is_stable(walls.stiffness * (1 + 1e-6), walls.virtual_damping) & (walls.virtual_damping > 0)
    some = np.flatnonzero(edge)[[0, -1]]
    points = np.stack([walls.stiffness, walls.virtual_damping, omega / (2 * np.pi)], -1)[some]
    assert_found(zwidth.fit_buzz(points, period=1e-3, velocity=filtered), scene)


def test_a_device_without_damping_or_delay_is_found_at_the_end_of_the_range():
    scene = scene_of(0.5, 0.0, 0.0, 1e-3)
    fit = zwidth.fit_buzz(walls_of(scene, [0.3, 0.6, 0.9]), period=1e-3)
    assert fit.damping == pytest.approx(0.0, abs=EXACT)
    assert fit.delay == pytest.approx(0.0, abs=EXACT * 1e-3)
    assert fit.mass == pytest.approx(0.5, rel=EXACT)


def test_noisy_walls_are_off_by_what_they_claim():
    scene, rng, share = scene_of(0.1, 0.1, 1.4, 1e-3), np.random.default_rng(3), 0.02
    walls, true = walls_of(scene, [0.0, 0.4, 0.8, 1.1]), float(scene.max_stiffness().stiffness)
    away, inside = [], []
    for _ in range(20):
        noisy = walls.copy()
        noisy[:, [0, 2]] *= 1 + share * rng.standard_normal((4, 2))
        fit = zwidth.fit_buzz(noisy, period=1e-3, noise=share)
        away.append((fit.stiffness_max - true) / fit.stiffness_error)
        bar = fit.intervals["stiffness_max"]
        inside.append(bar.low <= true <= bar.high)
    # 20 squares of a normal number; the chance to be out of these bounds is 1e-4 on either side.
    assert 4.3 < np.square(away).sum() < 52.4
    assert sum(inside) >= 15


def test_noise_is_estimated_where_it_is_not_given():
    scene, rng = scene_of(0.1, 0.1, 1.0, 1e-3), np.random.default_rng(1)
    walls = walls_of(scene, np.linspace(0.0, 1.1, 40))
    walls[:, [0, 2]] *= 1 + 0.01 * rng.standard_normal((40, 2))
    fit = zwidth.fit_buzz(walls, period=1e-3)
    assert isinstance(fit.noise, tuple)
    assert fit.noise[0] == fit.noise[1] == pytest.approx(0.01, rel=0.3)
    assert np.square(fit.residuals).sum() == pytest.approx(2 * 40 - 3)


def test_the_next_experiment_narrows_what_it_promises():
    walls = walls_of(scene_of(0.1, 0.1, 1.0, 1e-3), [0.0, 0.3])
    fit = zwidth.fit_buzz(walls, period=1e-3, noise=(0.03, 0.01))
    step = fit.next
    assert step is not None
    more = np.vstack([walls, [step.stiffness, step.virtual_damping, step.frequency]])
    after = zwidth.fit_buzz(more, period=1e-3, noise=(0.03, 0.01))
    assert after.stiffness_error == pytest.approx(step.stiffness_error, rel=1e-6)
    assert after.stiffness_error < 0.5 * fit.stiffness_error


def test_walls_that_contradict_each_other_cause_warnings():
    walls = walls_of(scene_of(0.1, 0.1, 1.0, 1e-3), [0.0, 0.4, 0.8])
    walls[1, 0] *= 1.5
    fit = zwidth.fit_buzz(walls, period=1e-3, noise=0.01)
    assert any("no rigid device has these walls" in warning for warning in fit.warnings)
    assert fit.status == Status.NO_BOUNDARY
    assert np.isnan(fit.stiffness_max)
    # Where nobody knows the noise, half as much again is none.
    assert zwidth.fit_buzz(walls, period=1e-3).status == Status.NO_BOUNDARY


def test_a_second_device_that_fits_as_well_is_told():
    # So strongly damped that its mass hardly shows, with noise.
    rng = np.random.default_rng(5)
    walls = walls_of(scene_of(0.4, 1.9, 2.0, 1e-3), [0.0, 0.4, 0.8, 1.1])
    told = 0
    for _ in range(3):
        noisy = walls.copy()
        noisy[:, [0, 2]] *= 1 + 0.02 * rng.standard_normal((4, 2))
        try:
            fit = zwidth.fit_buzz(noisy, period=1e-3, noise=0.02)
        except InputError as error:
            told += "not determine" in str(error)
        else:
            told += fit.status == Status.UNDECIDED or "mass is hardly" in " ".join(fit.warnings)
    assert told >= 2


def noisy_walls(seed, damped):
    """Two walls of a random device, off by 3 %."""
    scene, rng = random_scene(seed), np.random.default_rng(seed + 77)
    walls = walls_of(scene, [0.0, damped])
    walls[:, [0, 2]] *= 1 + 0.03 * rng.standard_normal((2, 2))
    return walls, scene.timing.period


@pytest.mark.parametrize("seed, agree", [(380, True), (337, False)])
def test_alternatives_leave_a_stiffness_only_where_they_agree_on_it(seed, agree):
    walls, period = noisy_walls(seed, 0.5)
    fit = zwidth.fit_buzz(walls, period=period, noise=0.03)
    assert fit.status == Status.UNDECIDED
    (alternative,) = fit.alternatives
    assert "another device" in " ".join(fit.warnings)
    # It fits the walls as well as the best one: both have them on their edges, within the noise.
    for device in (fit, alternative):
        scene = zwidth.Scene(zwidth.Device(device.mass, device.damping), zwidth.Timing(period, device.delay))
        ends = [scene.stable_stiffness(damping)[0, 1] for damping in walls[:, 1]]
        np.testing.assert_allclose(ends, walls[:, 0], rtol=0.2)
        assert float(scene.max_stiffness().stiffness) == pytest.approx(
            alternative.stiffness_max if device is alternative else float(fit.nominal.max_stiffness().stiffness),
            rel=1e-9,
        )
    best = float(fit.nominal.max_stiffness().stiffness)
    assert np.isfinite(fit.stiffness_max) == np.isfinite(fit.stiffness_error) == agree
    if agree:
        assert abs(alternative.stiffness_max - best) <= fit.stiffness_error
    assert np.isnan(fit.safe_wall().stiffness)
    assert fit.next is not None
    assert np.isfinite(fit.next.stiffness_error) == agree
    assert fit.as_dict()["alternatives"][0]["mass"] == alternative.mass
    assert fit.as_dict()["stiffness_max"] == (fit.stiffness_max if agree else None)


def test_walls_that_buzzed_before_say_nothing_of_the_stiffest():
    # A pole pair is on the circle at both, but others are outside: the second lobe of a delay of five periods.
    walls = [(218712.371, 3.76695, 201.985956), (36408.396, 538.13609, 390.421158)]
    fit = zwidth.fit_buzz(walls, period=1e-3)
    assert fit.status == Status.NO_BOUNDARY
    assert np.isnan([fit.stiffness_max, fit.stiffness_error, *fit.intervals["stiffness_max"]]).all()
    assert fit.next is None
    wall = fit.safe_wall()
    assert np.isnan(wall[:3]).all()
    assert wall.status == Status.NO_BOUNDARY


def test_a_wall_given_twice_is_no_new_information_unless_it_was_measured_twice():
    walls = [(6850, 0, 40.1), (15900, 18.7, 68.6), (19700, 37.4, 89.1)]
    once, twice = (zwidth.fit_buzz(points, period=1e-3) for points in (walls, [*walls, walls[0]]))
    assert twice.errors == once.errors
    assert any("repeat" in warning for warning in twice.warnings)
    once, twice = (zwidth.fit_buzz(points, period=1e-3, noise=0.02) for points in (walls, [*walls, walls[0]]))
    assert twice.errors["mass"] < once.errors["mass"]


@pytest.mark.parametrize(
    "points, words",
    [
        ([], "raise K at B = 0"),
        (HEARD[:1], "another damping"),
        ([HEARD[0], HEARD[0]], "another damping"),
        ([HEARD[0], (7000.0, 0.0, 41.0)], "another damping"),
        ([HEARD[0], (7000.0, 20.0, 500.0)], "half the sampling rate, 500.0 Hz"),
        ([HEARD[0], (7000.0, 20.0, 0.0)], "greater than 0"),
        ([HEARD[0], (-7000.0, 20.0, 70.0)], "points[1].stiffness"),
        ([HEARD[0], (7000.0, 20.0)], "points[1]"),
        ([HEARD[0], (7000.0, np.nan, 70.0)], "points[1]"),
    ],
)
def test_what_cannot_be_fitted_is_refused(points, words):
    with pytest.raises(InputError) as caught:
        zwidth.fit_buzz(points, period=1e-3)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_walls_of_nearly_the_same_damping_are_refused_in_their_units():
    points = [("0.4 N m/rad", 0, 40), ("0.4 N m/rad", "1e-6 N m s/rad", 40)]
    with pytest.raises(InputError, match=r"^points: B = 0, 1e-06 N m s/rad do not determine"):
        zwidth.fit_buzz(points, period="1 ms")


@pytest.mark.parametrize("noise", [0.0, -0.1, "much", (0.1, 0.1, 0.1), 1.0, "2", ("2%", "x%"), {}])
def test_noise_is_a_share(noise):
    with pytest.raises(InputError, match="noise: got"):
        zwidth.fit_buzz(HEARD, period=1e-3, noise=noise)


@pytest.mark.parametrize("noise", ["2%", " 2 %", "0.02", ("2%", 0.02), ["2%"], np.array([0.02, 0.02])])
def test_noise_may_be_given_in_percent(noise):
    assert zwidth.fit_buzz(HEARD, period="1 ms", noise=noise).noise == (0.02, 0.02)


def test_the_result_as_plain_numbers():
    fit = zwidth.fit_buzz([*HEARD, (19307.6, 50.0, 101.017455)], period=1e-3, noise=0.02)
    plain = fit.as_dict()
    assert plain["mass"] == fit.mass
    # By the logarithm of K_max.
    spread = np.exp(fit.coverage_factor * fit.stiffness_error / fit.stiffness_max)
    assert plain["intervals"]["stiffness_max"] == pytest.approx(
        [fit.stiffness_max / spread, fit.stiffness_max * spread], rel=1e-14
    )
    assert fit.nominal.device.mass == fit.mass
    # The scene to hand over is rounded as a configuration prints it.
    assert fit.scene.device.mass == pytest.approx(fit.mass, rel=1e-6)


def test_walls_of_a_weakly_damped_device_are_found():
    """Undamped, it buzzes at 1.2 Hz: a damping far below those that were looked at."""
    mass, damping, delay, period = 0.5288937, 0.0202762, 0.1651576e-3, 1e-3
    points = [(30.48348443813232, 0.0, 1.208272659601074), (133600.01096388383, 109.95602220875084, 87.03698526715972)]
    fit = zwidth.fit_buzz(points, period=period)
    assert fit.status == Status.OK
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay], [mass, damping, delay], rtol=1e-6)


def test_no_wall_to_set_has_more_damping_than_a_wall_that_was_tried():
    # From B = 26.8 N s/m on a resonance near 270 Hz shakes every wall of this device; the walls below do not show it.
    true = OtherDevice.of(OTHERS["compliance of 300 Hz, encoder at the motor"])
    walls = [(494.7, 0.0, 10.92), (4044.0, 8.053, 33.66), (6577.0, 16.11, 45.92), (8703.0, 24.16, 54.96)]
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.02)
    assert not fit.is_unreliable
    known, safe, wall = fit.safe_wall(rigid=True), fit.safe_wall(), fit.recommended
    assert known.virtual_damping > 26.8
    assert not true.is_stable(*known[:2])
    for stiffness, damping in (safe[:2], (wall.stiffness, wall.virtual_damping)):
        assert damping <= 24.16
        assert true.is_stable(stiffness, damping)
    assert safe.stiffness > 0.8 * true.limit_of_walls()
