"""Test scenes, and the conversion between SI units and normalized parameters.

References: eqs. (14) and (16) of the paper in mpmath, and the example of the paper.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from mpmath import mpf

import oracles
import zwidth
from zwidth.core.errors import InputError

WALL = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 2.5e-3, "stiffness": 14.9e3, "virtual_damping": -41.6}


def test_normalize_equals_eqs_14_and_16():
    point = zwidth.normalize(**WALL)
    exact = {name: mpf(value) for name, value in WALL.items()}
    m, T = exact["mass"], exact["period"]
    expected = [exact["stiffness"] * T**2 / m, exact["virtual_damping"] * T / m, exact["damping"] * T / m]
    assert oracles.worst(point[:3], expected) <= tol.NORMALIZED.float64
    assert oracles.relative_error(point.d, exact["delay"] / T) <= tol.NORMALIZED.float64


@pytest.mark.parametrize("periods", [1, 3, 11, 17, 29, 500])
@pytest.mark.parametrize("period", [1e-4, 1e-3, 3e-4, 7e-3])
def test_normalize_keeps_integer_delays_exact(period, periods):
    # The quotient of the two decimals may have a rounding error, which would raise the degree of the polynomial.
    delay = float(f"{periods * period:.12g}")
    assert zwidth.normalize(mass=1.0, period=period, delay=delay).d == periods


def test_normalize_does_not_round_delays_near_integers():
    for quotient in (1 + 1e-13, 3 - 1e-13, 1e-18, 2.5):
        assert zwidth.normalize(mass=1.0, period=1.0, delay=quotient).d == quotient


def test_denormalize_inverts_normalize():
    point = zwidth.normalize(**WALL)
    back = zwidth.denormalize(mass=WALL["mass"], period=WALL["period"], **point._asdict())
    for name, value in WALL.items():
        assert getattr(back, name) == pytest.approx(value, rel=tol.NORMALIZED.float64), name


def test_normalize_gradients_in_delay_and_mass(x64):
    period = 1e-3
    slope = jax.grad(lambda delay: zwidth.normalize(mass=1.0, period=period, delay=delay).d)
    # Also at an integer delay, where the quotient is rounded.
    assert float(slope(3e-3)) == pytest.approx(1 / period)
    by_mass = jax.grad(lambda mass: zwidth.normalize(mass=mass, period=period, stiffness=1e4).alpha)
    assert float(by_mass(0.1)) == pytest.approx(-1e4 * period**2 / 0.1**2)
    assert np.isnan(by_mass(-0.1))


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"mass": 0.0}, r"mass: got 0\.0; it must be finite and greater than 0 \(in kg\)"),
        ({"mass": -0.0}, r"mass: got -0\.0; it must be finite and greater than 0"),
        ({"mass": jnp.float32(-1.0)}, r"mass: got .*-1.*; it must be finite and greater than 0"),
        ({"period": np.nan}, r"period: got nan; it must be finite and greater than 0 \(in s\)"),
        ({"damping": -1e-9}, r"damping: got -1e-09; it must be finite and at least 0 \(in N s/m\)"),
        ({"delay": np.inf}, r"delay: got inf; it must be finite and at least 0 \(in s\)"),
        ({"stiffness": np.inf}, r"stiffness: got inf; it must be finite \(in N/m\)"),
        ({"virtual_damping": "40"}, r"virtual_damping: got the text '40'; it must be a number in N s/m or"),
        ({"mass": None}, r"mass: got None, a real number"),
        ({"mass": 1j}, r"mass: got 1j, a real number"),
        ({"mass": ["1"]}, "mass: got the text '1'; .*drop the quotes"),
        ({"mass": [1.0, [2.0]]}, r"mass: got \[1.0, \[2.0\]\], a real number or a rectangular array"),
        ({"mass": np.ones(2), "delay": np.ones(3)}, r"shapes do not broadcast: mass \(2,\), .*delay \(3,\)"),
    ],
)
def test_normalize_rejects_invalid_arguments(changes, message):
    with pytest.raises(InputError, match=message):
        zwidth.normalize(**(WALL | changes))


@pytest.mark.parametrize("d", [0.0, 1e-9, 0.5, 1e5])
@pytest.mark.parametrize("delta", [0.0, 1e-9, 0.5, 1e12])
def test_denormalize_accepts_the_full_range_of_delta_and_d(delta, d):
    """Compare with b = delta m / T and t_d = d T."""
    back = zwidth.denormalize(mass=0.5, period=0.25, delta=delta, d=d)
    assert (back.damping, back.delay) == (2.0 * delta, 0.25 * d)
    for name in ("delta", "d"):
        with pytest.raises(InputError, match=f"{name}: got -1e-12; it must be finite and at least 0"):
            zwidth.denormalize(mass=0.5, period=0.25, **{name: -1e-12})


def test_scene_properties_equal_normalize():
    scene = zwidth.Scene(
        zwidth.Device(mass=0.1, damping=10.0),
        zwidth.Timing(period=1e-3, delay=2.5e-3),
        zwidth.VirtualWall(stiffness=14.9e3, virtual_damping=-41.6),
    )
    assert scene.normalized == zwidth.normalize(**WALL)
    assert (scene.alpha, scene.beta, scene.delta, scene.d) == tuple(scene.normalized)
    back = scene.to_si(alpha=scene.alpha, beta=scene.beta)
    assert back.stiffness == pytest.approx(14.9e3)
    assert back.virtual_damping == pytest.approx(-41.6)


def test_scene_parts_are_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        zwidth.Device(mass=0.1).mass = 0.2  # pyright: ignore[reportAttributeAccessIssue]


def test_scene_without_wall_has_zero_alpha_and_beta():
    scene = zwidth.Scene(zwidth.Device(mass=0.1), zwidth.Timing(period=1e-3))
    assert (scene.alpha, scene.beta, scene.delta, scene.d) == (0, 0, 0, 0)


FUNCTIONS: tuple[Any, ...] = zwidth.assess, zwidth.limits_of, zwidth.plot.region
SCENE: Any = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: zwidth.Device(mass=0.0), "mass: got 0 kg; it must be greater than 0 kg"),
        (lambda: zwidth.Device(mass=1.0, damping=-1), "damping: got -1 N s/m; it must be at least 0 N s/m"),
        (
            lambda: zwidth.Device(mass=np.ones(2)),  # pyright: ignore[reportArgumentType]
            r"mass: got an array of shape \(2,\); it must be a single number",
        ),
        (lambda: zwidth.VirtualWall(stiffness=np.nan), "stiffness: got nan; it must be finite"),
        (lambda: zwidth.Timing(period=1e-3, delay=-1.0), "delay: got -1 s; it must be at least 0 s"),
        *(
            (
                lambda function=function, argument=argument: function(argument),
                "scene: got .*; pass a zwidth.Scene, such as zwidth.Scene",
            )
            for function in FUNCTIONS
            for argument in (zwidth.Device(0.1), np.ones(2), 3)
        ),
        (
            lambda: zwidth.plot.region({"one": SCENE, "two": zwidth.Device(0.1)}),  # pyright: ignore[reportArgumentType]
            "scene: got Device.*; pass a zwidth.Scene",
        ),
        (lambda: SCENE.max_stiffness(negative_damping=np.ones(2)), "negative_damping: got array.*; pass True, False"),
        (lambda: SCENE.required(np.ones(2), 1e3), "parameter: got array"),
        (lambda: SCENE.best_damping(1e3, goal=np.ones(2)), "goal: got array"),
    ],
)
def test_scene_functions_reject_invalid_arguments(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_assess_adds_mass_of_rigidly_coupled_operator():
    timing, wall = zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(10e3, 40)
    held = zwidth.assess(zwidth.Scene(zwidth.Device(0.1, 10), timing, wall, operator=zwidth.Operator(mass=0.4)))
    assert held == zwidth.assess(zwidth.Scene(zwidth.Device(0.5, 10), timing, wall))
