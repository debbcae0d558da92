"""The certified method on reference labels computed in mpmath: every verdict is right or reported as undecided."""

import subprocess
import sys
from pathlib import Path

import mpmath as mp
import numpy as np
import pytest
from certified_labels import certified_stable
from mpmath import mpf
from waiting import LONGEST

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.numerics import evaluate
from zwidth.stability.rigid import certified
from zwidth.stability.rigid.certified import OPEN, filter_walls
from zwidth.stability.rigid.crossover import Verdict
from zwidth.stability.rigid.normalization import wall_status

REFERENCE = Path(__file__).resolve().parents[3] / "reference"
NAMES = ("alpha", "beta", "delta", "d")
STABLE, ON_BOUNDARY = 1, 2


def reference(name):
    with np.load(REFERENCE / name) as stored:
        return {key: stored[key] for key in stored}


def random_walls(delta, d, count, seed):
    """Return random walls in and around the stable region, about half of them outside."""
    rng = np.random.default_rng(seed)
    ridge = zwidth.alpha_max(delta, d)
    reach = abs(float(ridge.beta)) + delta
    return rng.uniform(0, 1.5 * float(ridge.alpha), count), rng.uniform(-1.2 * reach, 2.5 * reach, count)


def adversarial():
    """Return the adversarial points within the supported domain (94 %)."""
    points = reference("adversarial.npz")
    inside = wall_status(*(points[name] for name in NAMES)) == Status.OK
    assert inside.mean() > 0.9
    return {name: values[inside] for name, values in points.items()}


def test_reference_labels_are_reproduced():
    points = reference("labels.npz")
    result = certified_stable(*(points[name] for name in NAMES))
    assert (result.status == Status.OK).all()
    np.testing.assert_array_equal(result.stable, points["stable"])
    # The walls left open by the filter are within 1e-10 of the boundary.
    walls = [points[name] for name in NAMES]
    undecided = filter_walls(*walls) == OPEN
    assert undecided.mean() < 0.2
    for alpha, beta, delta, d in zip(*(column[undecided].tolist() for column in walls), strict=True):
        verdict = certified.compute_verdict(alpha, beta, delta, d, certified.BITS[0])
        assert verdict.stable or verdict.unstable


def test_adversarial_labels_are_reproduced():
    points = adversarial()
    result = certified_stable(*(points[name] for name in NAMES))
    np.testing.assert_array_equal(
        result.status, np.where(points["label"] == ON_BOUNDARY, Status.ON_BOUNDARY, Status.OK)
    )
    np.testing.assert_array_equal(result.stable, points["label"] == STABLE)
    # The filter must leave some of these points to ball arithmetic.
    code = filter_walls(*(points[name] for name in NAMES))
    assert 0.02 < (code == OPEN).mean() < 0.4


@pytest.mark.usefixtures("early_compiler")
def test_compiled_filter_agrees_with_the_labels():
    # Repeat the points beyond the size up to which NumPy is used, so that the compiled filter runs.
    points = adversarial()
    times = evaluate.FEW // points["label"].size + 1
    alpha, beta, delta, d = (np.tile(points[name], times) for name in NAMES)
    code, label = filter_walls(alpha, beta, delta, d), np.tile(points["label"], times)
    decided = code < OPEN
    assert decided.mean() > 0.6
    np.testing.assert_array_equal(code[decided] == 1, label[decided] == STABLE)


@pytest.mark.parametrize("d", [0, 1, 2, 4, 8, 0.5, 1.3, 12.9, 20, 100, 500.5])
@pytest.mark.parametrize("delta", [0.0, 1e-4, 1.0, 50.0, 1e4])
def test_filter_without_balls_decides_nearly_all_walls(monkeypatch, delta, d):
    monkeypatch.setattr(certified, "available", lambda: False)
    alpha, beta = random_walls(delta, d, 4000, seed=7)
    result = certified_stable(alpha, beta, delta, d)
    assert (result.status == Status.OK).mean() >= 0.999
    assert 0.02 < result.stable.mean() < 0.9


@pytest.mark.parametrize(
    ("point", "status", "stable"),
    [
        # alpha = 0 is a pole at z = 1; the remaining poles determine the status.
        ((0.0, 0.3, 0.1, 1.0), Status.ON_BOUNDARY, False),
        ((0.0, 0.0, 0.0, 3.0), Status.ON_BOUNDARY, False),
        ((-0.0, 0.05, 0.1, 500.0), Status.ON_BOUNDARY, False),
        ((0.0, -0.1, 0.1, 1.5), Status.ON_BOUNDARY, False),
        ((0.0, np.nextafter(-0.1, -1), 0.1, 1.5), Status.OK, False),
        ((0.0, np.nextafter(-0.1, 0), 0.1, 1.5), Status.ON_BOUNDARY, False),
        ((0.0, 3.0, 0.0, 0.0), Status.OK, False),
        ((0.0, 5.0, 0.1, 500.0), Status.OK, False),
        # R = z^2 + 1: three poles on the unit circle, undecidable at any precision.
        ((0.0, 2.0, 0.0, 0.0), Status.UNDECIDED, False),
        ((0.0, np.nextafter(2.0, 3.0), 0.0, 0.0), Status.OK, False),
        ((0.0, np.nextafter(2.0, 1.0), 0.0, 0.0), Status.ON_BOUNDARY, False),
        # A pole at exactly z = -1, others outside the unit circle.
        ((2.0, 3.0, 0.0, 1.5), Status.OK, False),
        # Poles at exactly +-j, others outside the unit circle.
        ((4.0, -2.0, 0.0, 3.0), Status.OK, False),
        ((0.0, 2.0, 0.0, 4.0), Status.OK, False),
        # Poles next to z = 1.
        ((1e-60, 0.1, 0.1, 1.0), Status.OK, True),
        ((1e-60, 0.0, 5e-324, 5e-324), Status.OK, False),
        ((-1e-60, 0.1, 0.1, 1.0), Status.OK, False),
        ((1e-60, 0.0, 0.1, 500.0), Status.OK, True),
        ((1e-60, 0.0, 1e12, 1e5), Status.OK, True),
        # On and below beta = -delta.
        ((1e-3, -0.1, 0.1, 1.0), Status.OK, False),
        ((1e-3, -0.1, 0.1, 0.0), Status.OK, False),
        ((1e-60, np.nextafter(-0.1, 0), 0.1, 0.0), Status.OK, True),
        # Largest and smallest supported values.
        ((1e60, 1e60, 1.0, 2.0), Status.OK, False),
        ((1.0, 1.0, 1e12, 2.0), Status.OK, True),
        ((1.0, 0.0, 1e6, 1.0 - 2.0**-53), Status.OK, True),
        # Outside of the supported range.
        ((5e-324, 0.1, 0.1, 0.0), Status.OUT_OF_RANGE, False),
        ((0.1, -5e-324, 0.1, 0.0), Status.OUT_OF_RANGE, False),
        ((1e300, 1e300, 1.0, 2.0), Status.OUT_OF_RANGE, False),
        ((0.1, 0.1, 1e13, 2.0), Status.OUT_OF_RANGE, False),
        ((0.1, 0.1, 0.1, 100001.0), Status.OUT_OF_RANGE, False),
    ],
)
def test_special_points_have_exact_status(point, status, stable):
    result = certified_stable(*point)
    assert (result.status, result.stable) == (status, stable)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("index", range(4))
def test_non_finite_input_has_status_invalid(value, index):
    point = [0.1, 0.2, 0.1, 1.0]
    point[index] = value
    result = certified_stable(*([other, bad] for other, bad in zip((0.1, 0.2, 0.1, 1.0), point, strict=True)))
    assert result.status.tolist() == [Status.OK, Status.INVALID_INPUT]
    assert result.stable.tolist() == [True, False]


@pytest.mark.parametrize("value", [-1.0, -5e-324])
@pytest.mark.parametrize("index", [2, 3])
def test_negative_damping_or_delay_is_invalid(value, index):
    point = [0.1, 0.2, 0.1, 1.0]
    point[index] = value
    assert certified_stable(*point).status == Status.INVALID_INPUT


def test_negative_zero_is_accepted_as_zero():
    result = certified_stable(0.1, 0.2, [-0.0, 0.0], [[-0.0], [0.0]])
    assert (result.status == Status.OK).all()
    assert result.stable.all()


def test_grid_flat_and_scattered_layouts_give_equal_labels():
    alpha, beta = np.linspace(0.0, 0.6, 1024), np.linspace(-0.3, 1.2, 640)
    grid = certified_stable(alpha[:, None], beta, 0.2, 1.0)
    assert grid.stable.shape == (1024, 640)
    a, b = np.meshgrid(alpha, beta, indexing="ij")
    # One point of another device keeps the flat layout from being recognized as a grid.
    flat = certified_stable(
        np.append(a.ravel(), 0.1), np.append(b.ravel(), 0.1), np.append(np.full(a.size, 0.2), 3.0), 1.0
    )
    np.testing.assert_array_equal(flat.stable[:-1].reshape(a.shape), grid.stable)
    np.testing.assert_array_equal(flat.status[:-1].reshape(a.shape), grid.status)
    few = slice(None, None, 997)
    scattered = certified_stable(a.ravel()[few], b.ravel()[few], 0.2, 1.0)
    np.testing.assert_array_equal(scattered.stable, grid.stable.ravel()[few])
    assert grid.stable.any()
    assert not grid.stable[0].any()


def test_mixed_delays_preserve_the_order_of_points():
    points = reference("labels.npz")
    d = np.array([0.0, 0.5, 1.0, 4.0, 60.0, 60.5])
    mixed = certified_stable(0.01, 0.1, 0.3, d)
    assert mixed.stable.tolist() == [bool(certified_stable(0.01, 0.1, 0.3, each).stable) for each in d]
    order = np.random.default_rng(3).permutation(points["d"].size)
    shuffled = certified_stable(*(points[name][order] for name in NAMES))
    np.testing.assert_array_equal(shuffled.stable, points["stable"][order])


def test_shapes_broadcast_and_may_be_empty():
    assert certified_stable(0.1, 0.2, 0.1, 1).stable.shape == ()
    assert certified_stable([], 0.2, 0.1, 1).stable.shape == (0,)
    assert certified_stable(np.zeros((2, 1)), np.ones((1, 3)), 0.1, [[[1]]]).status.shape == (1, 2, 3)
    with pytest.raises(InputError, match="broadcast"):
        certified_stable([0.1, 0.2], [0.1, 0.2, 0.3], 0.1, 1)
    with pytest.raises(InputError, match="alpha"):
        certified_stable("soft", 0.1, 0.1, 1)


def test_without_balls_open_points_are_undecided(monkeypatch):
    points = adversarial()
    chosen = slice(0, 2000)
    columns = [points[name][chosen] for name in NAMES]
    monkeypatch.setattr(certified, "available", lambda: False)
    result = certified_stable(*columns)
    undecided = result.status == Status.UNDECIDED
    assert 0.02 < undecided.mean() < 0.4
    assert not result.stable[undecided].any()
    np.testing.assert_array_equal(result.stable[~undecided], points["label"][chosen][~undecided] == STABLE)


def test_insufficient_precision_is_undecided(monkeypatch):
    monkeypatch.setattr(certified, "compute_verdict", lambda *_: Verdict(False, False))
    result = certified_stable(0.6, 0.5, 0.0, 0.0)
    assert (result.status, result.stable) == (Status.UNDECIDED, False)


@pytest.mark.usefixtures("early_compiler")
@pytest.mark.parametrize("value", [0.0, -0.0, 5e-324, -5e-324, np.nan, np.inf, 1e-61, -1e61, -0.1])
@pytest.mark.parametrize("index", range(4))
def test_special_values_have_equal_status_by_numpy_and_xla(value, index):
    # XLA flushes subnormal numbers to zero; small batches are evaluated by NumPy.
    point = [0.1, 0.2, 0.1, 1.5]
    point[index] = value
    few = certified_stable(*point)
    many = certified_stable(
        *(
            np.append(np.full(evaluate.FEW, other), each)
            for other, each in zip((0.1, 0.2, 0.1, 1.5), point, strict=True)
        )
    )
    assert (many.status[-1], many.stable[-1]) == (few.status, few.stable)
    assert few.status == wall_status(*(np.float64(x) for x in point)) or few.status == Status.ON_BOUNDARY
    assert many.stable[:-1].all()


@pytest.mark.parametrize("d", [0.0, 1e-300, 1e-16, 1e-12, 1.0 - 2.0**-53, 1.0 + 2.0**-52, 2.0 - 2.0**-52])
def test_strong_damping_with_nearly_integer_delay(d):
    # Compare with the nearest integer delay: far from the boundary a fractional part of 1e-12 is irrelevant.
    rng = np.random.default_rng(23)
    delta = 10.0 ** rng.uniform(2, 12, 300)
    alpha, beta = delta * rng.uniform(0, 5, 300), delta * rng.uniform(-1.1, 1.5, 300)
    near = certified_stable(alpha, beta, delta, d)
    assert (near.status == Status.OK).all()
    with mp.workdps(60):
        for index in range(0, 300, 3):
            # Up to terms of order 1/delta, the strongly damped loop is z^(1+d) (z - 1) + (alpha z + beta (z -
            # 1))/delta.
            n, a, b = round(d), alpha[index] / delta[index], beta[index] / delta[index]
            p = [mpf(1), mpf(-1)] + [mpf(0)] * (n + 1)
            p[-2] += mpf(a) + mpf(b)
            p[-1] -= mpf(b)
            radius = max(abs(z) for z in mp.polyroots(p[::-1], maxsteps=400, extraprec=200, asc=True))
            if abs(radius - 1) > 0.2:
                assert near.stable[index] == (radius < 1)


def test_python_flint_is_imported_only_when_needed():
    code = """
import sys
import zwidth
assert zwidth.is_stable(0.3, 0.5, 0.0, 0, method="certified")
assert "flint" not in sys.modules
assert "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=LONGEST)


def test_precision_setting_of_flint_is_restored():
    import flint

    before = flint.ctx.prec
    assert certified.decide(0.6, 0.5, 0.0, 0.0) == (True, Status.OK)
    assert flint.ctx.prec == before
