"""Test `robust_max_stiffness` and `robust_wall` for boxes of devices.

References: random samples, certified verdicts and a local search.
"""

import numpy as np
import pytest
from scipy.optimize import minimize

import zwidth
from zwidth import Interval, max_stiffness, robust_max_stiffness, robust_wall
from zwidth.core.status import Status

BOX = {"mass": Interval(0.08, 0.12), "damping": Interval(5.0, 15.0), "period": 1e-3, "delay": Interval(0.5e-3, 1e-3)}
NAMES = ("mass", "damping", "period", "delay")


def split_bounds(box):
    pairs = [box[name] if isinstance(box[name], Interval) else Interval(box[name], box[name]) for name in NAMES]
    return np.array([pair.low for pair in pairs]), np.array([pair.high for pair in pairs])


def sample_devices(box, count, seed=11):
    """Draw random devices from a box; each parameter is at an end of its interval with probability 1/2."""
    random = np.random.default_rng(seed)
    low, high = split_bounds(box)
    shares = np.where(random.random((count, 4)) < 0.5, random.integers(0, 2, (count, 4)), random.random((count, 4)))
    return dict(zip(NAMES, (low + shares * (high - low)).T, strict=True))


def random_box(random):
    """Draw a wide or narrow box: weak or strong damping, delays across several integer periods."""
    mass, period = 10.0 ** random.uniform(-2, 0), 10.0 ** random.uniform(-3.5, -2.5)
    damping, delay = mass / period * 10.0 ** random.uniform(-2, 1.5), period * random.uniform(0, 4)
    width = random.choice([0.02, 0.1, 0.3]) * random.uniform(0.2, 1.0, 4)
    width[random.random(4) < 0.25] = 0.0
    center = np.array([mass, damping, period, delay])
    return {name: Interval(m * (1 - w), m * (1 + w)) for name, m, w in zip(NAMES, center, width, strict=True)}


def minimize_cost(box, cost, seed):
    """Return the smallest cost found by sampling and a local search from the best sample."""
    low, high = split_bounds(box)
    devices = sample_devices(box, 10_000, seed)
    values = cost(devices)
    best = int(np.argmin(values))
    start = np.array([devices[name][best] for name in NAMES])
    free = high > low
    if not free.any():
        return values[best]

    def evaluate_shares(shares):
        device = start.copy()
        device[free] = low[free] + np.clip(shares, 0, 1) * (high - low)[free]
        return float(cost({name: np.array([value]) for name, value in zip(NAMES, device, strict=True)})[0])

    result = minimize(evaluate_shares, ((start - low)[free] / (high - low)[free]), method="Nelder-Mead")
    return min(values[best], result.fun)


def build_limit_cost(wall):
    """Return a cost function: the stiffness limit at the damping of the wall, relative to the stiffness of the wall."""

    def cost(devices):
        point = zwidth.normalize(**devices, stiffness=wall.stiffness, virtual_damping=wall.virtual_damping)
        end = zwidth.boundary_point(point.delta, point.d, beta=point.beta)
        return np.where(end.status == Status.OK, end.alpha, 0.0) / point.alpha

    return cost


@pytest.mark.parametrize("seed", range(8))
def test_local_search_finds_no_weaker_device(seed):
    box = random_box(np.random.default_rng(100 + seed))
    worst, wall = robust_max_stiffness(**box), robust_wall(**box)
    assert worst.status == Status.OK, box
    assert worst.stiffness_max * (1 - 2e-6) < worst.stiffness < worst.stiffness_max
    assert minimize_cost(box, lambda devices: max_stiffness(**devices), seed) >= worst.stiffness
    assert wall.status == Status.OK, box
    assert wall.limit * (1 - 2e-6) < wall.stiffness < wall.limit <= worst.stiffness_max * (1 + 1e-9)
    assert minimize_cost(box, build_limit_cost(wall), seed) > 1.0


def decide_certified(devices, wall, factor):
    stiffness = np.full(np.shape(devices["mass"]), wall.stiffness * factor)
    point = zwidth.normalize(**devices, stiffness=stiffness, virtual_damping=wall.virtual_damping)
    return zwidth.is_stable(*point, method="certified")


def test_robust_wall_is_stable_for_all_sampled_devices():
    wall = robust_wall(**BOX)
    assert np.all(decide_certified(sample_devices(BOX, 2000), wall, 1.0))
    low, high = split_bounds(BOX)
    vertices = dict(zip(NAMES, (part.ravel() for part in np.meshgrid(*zip(low, high, strict=True))), strict=True))
    # Slightly above the limit, at least one vertex is unstable, whatever the damping.
    for damping in wall.virtual_damping * np.linspace(0.5, 1.5, 21):
        stiffer = wall._replace(stiffness=wall.limit, virtual_damping=damping)
        assert not np.all(decide_certified(vertices, stiffer, 1 + 1e-6))


def test_limiting_devices_inside_the_box():
    """The best wall for the vertices of this box is unstable for devices in its interior."""
    box = {
        "mass": (9.54e-3, 14.14e-3),
        "damping": (1.66, 2.48),
        "period": (7e-3, 8.72e-3),
        "delay": (0.355e-3, 0.61e-3),
    }
    box = {name: Interval(*ends) for name, ends in box.items()}
    wall = robust_wall(**box)
    assert wall.status == Status.OK
    assert minimize_cost(box, build_limit_cost(wall), 3) > 1.0
    low, high = split_bounds(box)
    vertices = dict(zip(NAMES, (part.ravel() for part in np.meshgrid(*zip(low, high, strict=True))), strict=True))
    stiffer = wall._replace(stiffness=wall.limit)
    assert np.all(decide_certified(vertices, stiffer, 1 + 1e-4))
    assert not np.all(decide_certified(sample_devices(box, 2000), stiffer, 1 + 1e-2))


def test_worst_case_at_interior_mass():
    # At strong damping K_max has a minimum over the mass.
    box = {"mass": Interval(0.01, 1.0), "damping": 100.0, "period": 1e-3, "delay": 2e-3}
    worst = robust_max_stiffness(**box)
    fine = max_stiffness(mass=np.linspace(0.01, 1.0, 20_001), damping=100.0, period=1e-3, delay=2e-3)
    assert not worst.is_vertex
    assert worst.stiffness_max == pytest.approx(fine.min(), rel=1e-8)
    assert 0.01 < worst.mass < 1.0


def test_worst_case_at_interior_period_with_strong_damping():
    # K_max is 1069478083 N/m at 0.89395 ms, less than at both ends.
    worst = robust_max_stiffness(
        mass=1.0, damping=2590418.159202655, period=Interval(2e-3 / 3, 1e-3), delay=0.003575165172380617
    )
    assert worst.stiffness_max == pytest.approx(1069478082.5, rel=1e-9)
    assert worst.stiffness == pytest.approx(worst.stiffness_max, rel=2e-6)
    assert not worst.is_vertex


def test_strongly_damped_devices_with_delays_near_one_period():
    # The center of the stable dampings jumps within one time constant of the device, a thousandth of a period.
    damping = Interval(9.5e2, 1.05e3)
    box = {
        "mass": Interval(0.98, 1.02),
        "damping": damping,
        "period": Interval(0.98, 1.02),
        "delay": Interval(0.8, 1.2),
    }
    worst = robust_max_stiffness(**box)
    assert worst.status == Status.OK
    assert worst.stiffness <= np.min(max_stiffness(**sample_devices(box, 20_000)))


def test_single_device_has_its_maximum_stiffness():
    device = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 1e-3}
    expected = max_stiffness(**device)
    wall = robust_wall(**device)
    assert wall.limit == pytest.approx(expected, rel=1e-9)
    assert wall.stiffness == pytest.approx(expected, rel=2e-6)
    worst = robust_max_stiffness(**device)
    assert (worst.mass, worst.damping, worst.period, worst.delay) == tuple(device.values())
    assert worst.is_vertex


def test_arrays_of_boxes_are_independent_batch_entries():
    lightest = np.array([0.08, 0.2, np.inf, 1e-31, 0.05])
    batch = robust_max_stiffness(mass=Interval(lightest, 0.12), damping=10.0, period=1e-3, delay=2e-3)
    invalid, out_of_range = Status.INVALID_INPUT, Status.OUT_OF_RANGE
    assert batch.status.tolist() == [Status.OK, invalid, invalid, out_of_range, Status.OK]
    assert np.isnan(batch.stiffness).tolist() == [False, True, True, True, False]
    one = robust_max_stiffness(mass=Interval(0.08, 0.12), damping=10.0, period=1e-3, delay=2e-3)
    assert one.stiffness == batch.stiffness[0]
    several = robust_wall(mass=np.array([0.08, 0.12]), damping=10.0, period=1e-3)
    assert several.stiffness.shape == (2,)
    assert robust_wall(mass=np.empty(0), period=1e-3).stiffness.shape == (0,)


def test_undamped_devices_without_delay_closed_form():
    """K_max = (12 - 8 sqrt 2) m/T^2 is smallest for the lightest device; damping and delay default to 0."""
    box = {"mass": Interval(0.08, 0.12), "period": Interval(0.5e-3, 1e-3)}
    worst, wall = robust_max_stiffness(**box), robust_wall(**box)
    expected = (12 - 8 * np.sqrt(2)) * 0.08 / 1e-3**2
    assert worst.status == wall.status == Status.OK
    assert worst.stiffness_max == pytest.approx(expected, rel=1e-12)
    assert expected * (1 - 2e-6) <= worst.stiffness <= expected
    assert wall.stiffness <= worst.stiffness * (1 + 1e-12)
    assert (worst.mass, worst.damping, worst.period, worst.delay) == (0.08, 0.0, 1e-3, 0.0)


def test_invalid_boxes_are_rejected():
    with pytest.raises(zwidth.InputError, match=r"mass: got .*0.2.*; the first number must not be greater"):
        robust_max_stiffness(mass=Interval(0.2, 0.1), period=1e-3)
    with pytest.raises(zwidth.InputError, match=r"delay: got -1"):
        robust_max_stiffness(mass=0.1, period=1e-3, delay=Interval(-1, 1))
    for ends in ((0.1, 0.2), [0.1, 0.2]):
        with pytest.raises(zwidth.InputError, match=r"mass: got .*; write Interval\(low, high\)"):
            robust_wall(mass=ends, period=1e-3)
