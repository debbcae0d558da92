"""First-order enclosures of boxes contain what they stand for: operations and the whole verdict, at random points."""

import numpy as np
import pytest
from proved import certified_stable

from zwidth.arrays import balls
from zwidth.arrays.held_mass import phi_functions
from zwidth.loops.rigid import certified_filter

COUNT = 400


def random_boxes(seed, width):
    """Random boxes of four quantities, and points in them as shares from -1 to 1."""
    random = np.random.default_rng(seed)
    middle = 10.0 ** random.uniform(-2, 1, (COUNT, 4))
    half = middle * width * random.uniform(0, 1, (COUNT, 4))
    shares = random.choice([-1.0, 1.0, 0.0], (COUNT, 4)) * random.uniform(0.9, 1.0, (COUNT, 4))
    forms = balls.quantities(middle - half, middle + half)
    return forms, (middle + shares * half).T, shares.T


def assert_contains(form, shares, exact):
    """The form at the point's shares, within its radius, is the exact value."""
    at = form.mid + (form.lin * shares).sum(axis=0)
    # The reference is rounded too.
    assert np.all(np.abs(at - exact) <= form.rad * (1 + 1e-9) + 1e-13 * np.abs(exact))


@pytest.mark.parametrize("width", [1e-9, 0.01, 0.3])
def test_every_operation_contains_its_result(width):
    (x, y, z, w), (a, b, c, d), shares = random_boxes(1, width)
    for form, exact in (
        (x + y, a + b),
        (x - 2.0 * y, a - 2 * b),
        (x * y - z, a * b - c),
        (x * x * w, a * a * d),
        (x / y, a / b),
        (3.0 - x / (y * w), 3 - a / (b * d)),
        ((x * y).sqrt(), np.sqrt(a * b)),
        ((x + z).inverse(), 1 / (a + c)),
    ):
        assert_contains(form, shares, exact)


@pytest.mark.parametrize("width", [1e-9, 0.01, 0.3])
def test_the_plant_contains_those_of_its_devices(width):
    (x, y, _, _), (a, b, _, _), shares = random_boxes(2, width)
    f = y / (y + 1.0)
    # mpmath is too slow for so many points; the phi-functions themselves are held to it elsewhere.
    t, fraction = 1 / (b + 1), b / (b + 1)
    c, _, phi2, psi, _ = phi_functions(a)
    _, _, phi2_t, psi_t, _ = phi_functions(a * t)
    _, _, phi2_f, psi_f, _ = phi_functions(a * fraction)
    e_t = np.exp(-a * t)
    found = certified_filter.device_forms(x, f)
    assert_contains(found.c, shares, c)
    assert_contains(found.p1, shares, phi2 + psi)
    assert_contains(found.a2, shares, t * t * phi2_t)
    assert_contains(found.a0, shares, e_t * fraction**2 * psi_f)
    mixed = t * fraction * (e_t + phi2_t + psi_t) * (phi2_f + psi_f)
    assert_contains(found.a1, shares, t * t * psi_t + mixed + fraction**2 * phi2_f)


@pytest.mark.parametrize("width", [1e-6, 0.003, 0.03])
def test_what_is_proved_for_a_box_holds_at_its_points(width):
    random = np.random.default_rng(3)
    count = 3000
    delta, d = 10.0 ** random.uniform(-3, 2, count), random.uniform(0, 6, count)
    alpha = (0.2 + delta) / (d + 1) ** 2 * 10.0 ** random.uniform(-2, 0.5, count)
    beta = random.uniform(-1, 1, count) * (0.5 + delta) / (d + 1)
    middle = np.stack([alpha, delta, d], axis=1)
    low, high = middle * (1 - width), middle * (1 + width)
    forms = balls.quantities(low, high)
    damping = balls.Form(beta, np.zeros((3, count)), np.zeros(count))
    proved = certified_filter.stable_everywhere(forms[0], damping, forms[1], forms[2])
    assert np.mean(proved) > 0.05
    for corner in range(8):
        chosen = np.where([(corner >> k) & 1 for k in range(3)], high, low)
        a, delta, d = chosen[proved].T
        assert np.all(certified_stable(a, beta[proved], delta, d).stable)


def test_nothing_is_proved_of_unstable_walls_and_nearly_all_of_stable_points():
    random = np.random.default_rng(4)
    count = 5000
    delta, d = 10.0 ** random.uniform(-3, 2, count), random.uniform(0, 8, count)
    alpha = (0.2 + delta) / (d + 1) ** 2 * 10.0 ** random.uniform(-2, 0.5, count)
    beta = random.uniform(-1, 1, count) * (0.5 + delta) / (d + 1)
    points = np.stack([alpha, beta, delta, d], axis=1)
    forms = balls.quantities(points, points)
    proved = certified_filter.stable_everywhere(*forms)
    truth = certified_stable(*points.T).stable
    assert not np.any(proved & ~truth)
    assert np.mean(proved[truth]) > 0.999
