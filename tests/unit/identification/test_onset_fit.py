"""Test `zwidth.fit_buzz` on exact, noisy and unsuitable walls at the onset of instability.

References: the closed-form boundary, and eigenvalues of a matrix exponential.
"""

import numpy as np
import pytest
import tolerances
from measured_devices import OTHERS, PERIOD, OtherDevice
from scipy.linalg import expm

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status

EXACT = tolerances.FIT_EXACT.float64
ONSETS = [(6846.364, 0.0, 40.0945620), (15860.788, 18.7195, 68.6254)]


def compute_onsets(scene, shares):
    """Return exact walls on the stability boundary of a rigid device, at shares of the damping of the stiffest wall."""
    beta = np.asarray(shares) * float(zwidth.alpha_max(scene.delta, scene.d).beta)
    point = zwidth.boundary_point(scene.delta, scene.d, beta=beta)
    period = scene.timing.period
    wall = scene.to_si(alpha=point.alpha, beta=beta)
    return np.stack([wall.stiffness, wall.virtual_damping, point.omega / (2 * np.pi * period)], -1)


def make_scene(mass, delta, d, period):
    return zwidth.Scene(zwidth.Device(mass, delta * mass / period), zwidth.Timing(period=period, delay=d * period))


def assert_recovered(fit, scene):
    estimates = [
        fit.mass / scene.mass,
        fit.damping / scene.damping,
        (fit.delay - scene.timing.delay) / scene.timing.period,
    ]
    np.testing.assert_allclose(estimates, [1, 1, 0], rtol=EXACT, atol=EXACT)
    assert fit.status == Status.OK
    assert fit.warnings == ()


def random_scene(seed):
    rng = np.random.default_rng(seed)
    is_integer = rng.random() < 0.5
    d = float(rng.integers(0, 6)) if is_integer else rng.uniform(0, 6)
    return make_scene(10 ** rng.uniform(-2, 0.5), 10 ** rng.uniform(-3, 0.5), d, 10 ** rng.uniform(-4, -2.5))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [2, 4])
def test_exact_onsets_recover_the_device(seed, count):
    scene = random_scene(seed)
    walls = compute_onsets(scene, np.linspace(0.0, 0.8, count))
    fit = zwidth.fit_buzz(walls, period=scene.timing.period)
    assert_recovered(fit, scene)
    assert fit.stiffness_max == pytest.approx(float(scene.max_stiffness().stiffness), rel=EXACT)


def compute_dominant_pole(mass, damping, period, n_delay, stiffness, virtual_damping):
    """Return the dominant pole of a loop with integer delay, from the eigenvalues of its matrix exponential."""
    step = expm(np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]]) * period)
    size = 3 + n_delay
    # States: position, velocity, previous position, and the delayed forces.
    loop = np.zeros((size, size))
    loop[:2, :2] = step[:2, :2]
    loop[2, 0] = 1.0
    law = np.zeros(size)
    law[0], law[2] = -stiffness - virtual_damping / period, virtual_damping / period
    acting = law if n_delay == 0 else np.eye(size)[3]
    loop[:2] += np.outer(step[:2, 2], acting)
    for k in range(n_delay):
        loop[3 + k] = np.eye(size)[4 + k] if k + 1 < n_delay else law
    poles = np.linalg.eigvals(loop)
    return poles[np.argmax(np.abs(poles))]


@pytest.mark.parametrize("n_delay", [0, 2])
def test_onsets_from_eigenvalues_recover_the_device(n_delay):
    mass, damping, period = 0.2, 8.0, 5e-4
    walls = []
    for virtual_damping in (4.0, 25.0):
        low, high = 1.0, 2e5
        while high - low > 1e-13 * high:
            middle = 0.5 * (low + high)
            is_unstable = abs(compute_dominant_pole(mass, damping, period, n_delay, middle, virtual_damping)) > 1
            low, high = (low, middle) if is_unstable else (middle, high)
            if middle in (low, high) and high - low <= 2 * np.spacing(high):
                break
        pole = compute_dominant_pole(mass, damping, period, n_delay, low, virtual_damping)
        walls.append(zwidth.BuzzPoint(low, virtual_damping, abs(np.angle(pole)) / (2 * np.pi * period)))
    fit = zwidth.fit_buzz(walls, period="0.5 ms")
    # An eigenvalue on the unit circle determines K to a relative accuracy of about 1e-12.
    np.testing.assert_allclose([fit.mass, fit.damping], [mass, damping], rtol=EXACT)
    assert fit.delay == pytest.approx(n_delay * period, abs=EXACT * period)


def test_exact_onsets_with_low_pass_recover_the_device():
    filtered = zwidth.LowPass(cutoff=150)
    scene = zwidth.Scene(zwidth.Device(0.1, 5), zwidth.Timing(period=1e-3, delay=0.7e-3), velocity=filtered)
    omega = np.linspace(60, 500, 400)
    walls = scene.boundary(omega)
    edge = np.asarray(scene.is_stable(walls.stiffness * (1 - 1e-6), walls.virtual_damping))
    edge = edge & ~scene.is_stable(walls.stiffness * (1 + 1e-6), walls.virtual_damping) & (walls.virtual_damping > 0)
    selected = np.flatnonzero(edge)[[0, -1]]
    points = np.stack([walls.stiffness, walls.virtual_damping, omega / (2 * np.pi)], -1)[selected]
    assert_recovered(zwidth.fit_buzz(points, period=1e-3, velocity=filtered), scene)


def test_device_without_damping_and_delay_is_recovered():
    scene = make_scene(0.5, 0.0, 0.0, 1e-3)
    fit = zwidth.fit_buzz(compute_onsets(scene, [0.3, 0.6, 0.9]), period=1e-3)
    assert fit.damping == pytest.approx(0.0, abs=EXACT)
    assert fit.delay == pytest.approx(0.0, abs=EXACT * 1e-3)
    assert fit.mass == pytest.approx(0.5, rel=EXACT)


def test_estimates_scatter_by_their_standard_errors():
    scene, rng, noise_level = make_scene(0.1, 0.1, 1.4, 1e-3), np.random.default_rng(3), 0.02
    walls, true = compute_onsets(scene, [0.0, 0.4, 0.8, 1.1]), float(scene.max_stiffness().stiffness)
    deviations, inside = [], []
    for _ in range(20):
        noisy = walls.copy()
        noisy[:, [0, 2]] *= 1 + noise_level * rng.standard_normal((4, 2))
        fit = zwidth.fit_buzz(noisy, period=1e-3, noise=noise_level)
        deviations.append((fit.stiffness_max - true) / fit.stiffness_error)
        interval = fit.intervals["stiffness_max"]
        inside.append(interval.low <= true <= interval.high)
    # The sum of 20 squared standard normal values is outside each of these bounds with probability 1e-4.
    assert 4.3 < np.square(deviations).sum() < 52.4
    assert sum(inside) >= 15


def test_unspecified_noise_is_estimated():
    scene, rng = make_scene(0.1, 0.1, 1.0, 1e-3), np.random.default_rng(1)
    walls = compute_onsets(scene, np.linspace(0.0, 1.1, 40))
    walls[:, [0, 2]] *= 1 + 0.01 * rng.standard_normal((40, 2))
    fit = zwidth.fit_buzz(walls, period=1e-3)
    assert isinstance(fit.noise, tuple)
    assert fit.noise[0] == fit.noise[1] == pytest.approx(0.01, rel=0.3)
    assert np.square(fit.residuals).sum() == pytest.approx(2 * 40 - 3)


def test_next_experiment_reduces_the_error_as_predicted():
    walls = compute_onsets(make_scene(0.1, 0.1, 1.0, 1e-3), [0.0, 0.3])
    fit = zwidth.fit_buzz(walls, period=1e-3, noise=(0.03, 0.01))
    step = fit.next
    assert step is not None
    more = np.vstack([walls, [step.stiffness, step.virtual_damping, step.frequency]])
    after = zwidth.fit_buzz(more, period=1e-3, noise=(0.03, 0.01))
    assert after.stiffness_error == pytest.approx(step.stiffness_error, rel=1e-6)
    assert after.stiffness_error < 0.5 * fit.stiffness_error


def test_contradicting_onsets_yield_a_warning():
    walls = compute_onsets(make_scene(0.1, 0.1, 1.0, 1e-3), [0.0, 0.4, 0.8])
    walls[1, 0] *= 1.5
    fit = zwidth.fit_buzz(walls, period=1e-3, noise=0.01)
    assert any("no rigid device has these walls" in warning for warning in fit.warnings)
    assert fit.status == Status.NO_BOUNDARY
    assert np.isnan(fit.stiffness_max)
    # Also with unspecified noise, because no plausible noise explains a deviation of 50 %.
    assert zwidth.fit_buzz(walls, period=1e-3).status == Status.NO_BOUNDARY


def test_undetermined_mass_of_strongly_damped_device_is_reported():
    # Damping is so strong that the mass hardly affects the noisy walls.
    rng = np.random.default_rng(5)
    walls = compute_onsets(make_scene(0.4, 1.9, 2.0, 1e-3), [0.0, 0.4, 0.8, 1.1])
    reports = 0
    for _ in range(3):
        noisy = walls.copy()
        noisy[:, [0, 2]] *= 1 + 0.02 * rng.standard_normal((4, 2))
        try:
            fit = zwidth.fit_buzz(noisy, period=1e-3, noise=0.02)
        except InputError as error:
            reports += "not determine" in str(error)
        else:
            reports += fit.status == Status.UNDECIDED or "mass is hardly" in " ".join(fit.warnings)
    assert reports >= 2


def noisy_walls(seed, share):
    """Return two walls of a random device with 3 % noise."""
    scene, rng = random_scene(seed), np.random.default_rng(seed + 77)
    walls = compute_onsets(scene, [0.0, share])
    walls[:, [0, 2]] *= 1 + 0.03 * rng.standard_normal((2, 2))
    return walls, scene.timing.period


@pytest.mark.parametrize("seed, agree", [(380, True), (337, False)])
def test_alternative_optima_keep_stiffness_only_if_they_agree(seed, agree):
    walls, period = noisy_walls(seed, 0.5)
    fit = zwidth.fit_buzz(walls, period=period, noise=0.03)
    assert fit.status == Status.UNDECIDED
    (alternative,) = fit.alternatives
    assert "another device" in " ".join(fit.warnings)
    # Both devices fit: each measured wall is on their stability boundaries, within the noise.
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


def test_walls_beyond_an_earlier_onset_yield_no_boundary():
    # Both walls have a pole pair on the unit circle, but others outside it: the second lobe at a delay of five periods.
    walls = [(218712.371, 3.76695, 201.985956), (36408.396, 538.13609, 390.421158)]
    fit = zwidth.fit_buzz(walls, period=1e-3)
    assert fit.status == Status.NO_BOUNDARY
    assert np.isnan([fit.stiffness_max, fit.stiffness_error, *fit.intervals["stiffness_max"]]).all()
    assert fit.next is None
    wall = fit.safe_wall()
    assert np.isnan(wall[:3]).all()
    assert wall.status == Status.NO_BOUNDARY


def test_repeated_wall_counts_once_unless_noise_is_given():
    walls = [(6850, 0, 40.1), (15900, 18.7, 68.6), (19700, 37.4, 89.1)]
    once, twice = (zwidth.fit_buzz(points, period=1e-3) for points in (walls, [*walls, walls[0]]))
    assert twice.errors == once.errors
    assert any("repeat" in warning for warning in twice.warnings)
    once, twice = (zwidth.fit_buzz(points, period=1e-3, noise=0.02) for points in (walls, [*walls, walls[0]]))
    assert twice.errors["mass"] < once.errors["mass"]


@pytest.mark.parametrize(
    "points, message",
    [
        ([], "raise K at B = 0"),
        (ONSETS[:1], "another damping"),
        ([ONSETS[0], ONSETS[0]], "another damping"),
        ([ONSETS[0], (7000.0, 0.0, 41.0)], "another damping"),
        ([ONSETS[0], (7000.0, 20.0, 500.0)], "half the sampling rate, 500.0 Hz"),
        ([ONSETS[0], (7000.0, 20.0, 0.0)], "greater than 0"),
        ([ONSETS[0], (-7000.0, 20.0, 70.0)], "points[1].stiffness"),
        ([ONSETS[0], (7000.0, 20.0)], "points[1]"),
        ([ONSETS[0], (7000.0, np.nan, 70.0)], "points[1]"),
    ],
)
def test_unsuitable_points_are_rejected(points, message):
    with pytest.raises(InputError) as caught:
        zwidth.fit_buzz(points, period=1e-3)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_onsets_at_nearly_equal_damping_are_rejected_in_rotary_units():
    points = [("0.4 N m/rad", 0, 40), ("0.4 N m/rad", "1e-6 N m s/rad", 40)]
    with pytest.raises(InputError, match=r"^points: B = 0, 1e-06 N m s/rad do not determine"):
        zwidth.fit_buzz(points, period="1 ms")


@pytest.mark.parametrize("noise", [0.0, -0.1, "much", (0.1, 0.1, 0.1), 1.0, "2", ("2%", "x%"), {}])
def test_invalid_noise_is_rejected(noise):
    with pytest.raises(InputError, match="noise: got"):
        zwidth.fit_buzz(ONSETS, period=1e-3, noise=noise)


@pytest.mark.parametrize("noise", ["2%", " 2 %", "0.02", ("2%", 0.02), ["2%"], np.array([0.02, 0.02])])
def test_noise_may_be_given_in_percent(noise):
    assert zwidth.fit_buzz(ONSETS, period="1 ms", noise=noise).noise == (0.02, 0.02)


def test_as_dict_and_scene_of_the_fit():
    fit = zwidth.fit_buzz([*ONSETS, (19307.6, 50.0, 101.017455)], period=1e-3, noise=0.02)
    plain = fit.as_dict()
    assert plain["mass"] == fit.mass
    # The interval is symmetric in the logarithm of K_max.
    spread = np.exp(fit.coverage_factor * fit.stiffness_error / fit.stiffness_max)
    assert plain["intervals"]["stiffness_max"] == pytest.approx(
        [fit.stiffness_max / spread, fit.stiffness_max * spread], rel=1e-14
    )
    assert fit.nominal.device.mass == fit.mass
    # The scene is rounded to the digits printed in a configuration.
    assert fit.scene.device.mass == pytest.approx(fit.mass, rel=1e-6)


def test_onsets_of_weakly_damped_device_recover_the_device():
    """Without virtual damping it oscillates at 1.2 Hz: a damping far below the initial grid of the search."""
    mass, damping, delay, period = 0.5288937, 0.0202762, 0.1651576e-3, 1e-3
    points = [(30.48348443813232, 0.0, 1.208272659601074), (133600.01096388383, 109.95602220875084, 87.03698526715972)]
    fit = zwidth.fit_buzz(points, period=period)
    assert fit.status == Status.OK
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay], [mass, damping, delay], rtol=1e-6)


def test_recommended_damping_does_not_exceed_the_tested_damping():
    # Above B = 26.8 N s/m a resonance near 270 Hz makes every wall of this device unstable; the walls below do not show
    # it.
    true = OtherDevice.of(OTHERS["compliance of 300 Hz, encoder at the motor"])
    walls = [(494.7, 0.0, 10.92), (4044.0, 8.053, 33.66), (6577.0, 16.11, 45.92), (8703.0, 24.16, 54.96)]
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.02)
    assert not fit.is_unreliable
    rigid_wall, safe, wall = fit.safe_wall(rigid=True), fit.safe_wall(), fit.recommended
    assert rigid_wall.virtual_damping > 26.8
    assert not true.is_stable(*rigid_wall[:2])
    for stiffness, damping in (safe[:2], (wall.stiffness, wall.virtual_damping)):
        assert damping <= 24.16
        assert true.is_stable(stiffness, damping)
    assert safe.stiffness > 0.8 * true.limit_of_walls()
