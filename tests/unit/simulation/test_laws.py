"""Test user-defined force laws, initial states of each body, and recorded operator positions.

References: an independent integrator, and equivalent walls.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import tolerances
from integrator import integrate

import zwidth

PERIODS = 300
RIGID = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(1e-3, 1.4e-3), velocity=zwidth.LowPass(cutoff=80))
TIP = zwidth.Device(0.1, 2.0, zwidth.Coupling(0.05, 2e4, 1.0, "tip"))
GRASPED = zwidth.Scene(TIP, zwidth.Timing(1e-3, 1e-3), operator=zwidth.Operator(0.5, 5.0, 100.0, 800.0, 3.0))


def nonlinear_spring(x: Any, v: Any, t: Any, xp: Any = jnp) -> Any:
    return -2e3 * x - 4e8 * x**3 - 3.0 * v


def hunt_crossley(x: Any, v: Any, t: Any, xp: Any = jnp) -> Any:
    depth = xp.maximum(x, 0.0)
    return -xp.maximum(6e4 * depth**1.5 * (1.0 + 1.5 * v), 0.0)


def moving_wall(x: Any, v: Any, t: Any, xp: Any = jnp) -> Any:
    surface, speed = 5e-4 * xp.sin(60.0 * t), 0.03 * xp.cos(60.0 * t)
    return xp.where(x > surface, -(2e3 * (x - surface) + 5.0 * (v - speed)), 0.0)


LAWS = [nonlinear_spring, hunt_crossley, moving_wall]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("scene", [RIGID, GRASPED], ids=["rigid", "grasped"])
def test_force_laws_match_independent_integrator(law, scene):
    start: dict[str, Any] = {"start_position": -1e-4, "start_velocity": 0.08}
    motion = scene.simulate(force=law, periods=PERIODS, **start)
    reference = integrate(
        scene, 0.0, 0.0, PERIODS, law=lambda *arguments: float(law(*arguments, np)), position=-1e-4, velocity=0.08
    )
    for name, column in (("position", reference.position[:PERIODS, 0]), ("measured", reference.measured[:PERIODS])):
        np.testing.assert_allclose(getattr(motion, name), column, rtol=0, atol=1e-9 * np.abs(column).max())
    np.testing.assert_allclose(
        motion.command, reference.command[:PERIODS], rtol=0, atol=1e-9 * np.abs(reference.command).max()
    )
    assert np.abs(reference.command).max() > 0.1


def test_force_law_of_a_wall_equals_the_wall():
    options: dict[str, Any] = {
        "periods": 400, "start_position": np.array([1e-3, -2e-3]), "start_velocity": 0.1, "contact": "push_only",
        "resolution": 1e-6, "coulomb": 0.2, "max_force": 8.0, "jitter": 1e-4, "seed": 3,
    }  # fmt: skip
    wall, law = (
        RIGID.simulate(3e3, 5.0, **options),
        RIGID.simulate(force=lambda x, v, t: -(3e3 * x + 5.0 * v), **options),
    )
    for name in ("position", "command", "wall_work", "energy"):
        one, other = getattr(wall, name), getattr(law, name)
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-10 * np.abs(one).max())


@pytest.mark.parametrize("table", [np.float64(1.0), np.linspace(0.0, 2.0, 3001)], ids=["number", "table"])
def test_force_law_uses_current_values_of_captured_variables(table):
    def spring(x: Any, v: Any, t: Any) -> Any:
        return -1e3 * x * (table if table.ndim == 0 else jnp.asarray(table)[1500])

    def command() -> float:
        return float(RIGID.simulate(force=spring, start_position=1e-3, periods=3).command[0])

    first = command()
    assert first == pytest.approx(-1.0, rel=1e-12)
    table = table * (1.0 + 1e-9)
    assert command() / first == pytest.approx(1.0 + 1e-9, rel=1e-13)


@pytest.mark.parametrize(("stiffness", "kind"), [(3e3, zwidth.MotionKind.GROWING), (1e3, zwidth.MotionKind.REST)])
def test_outcome_of_force_law_equals_that_of_the_same_wall(stiffness, kind):
    def wall(x: Any, v: Any, t: Any) -> Any:
        return -(stiffness * x + 5.0 * v)

    assert RIGID.simulate(stiffness, 5.0, start_position=1e-3).outcome == kind
    assert RIGID.simulate(force=wall, start_position=1e-3).outcome == kind


def test_unstable_force_law_diverges():
    motion = RIGID.simulate(force=lambda x, v, t: 1e6 * x, start_position=1e-3)
    assert motion.outcome == zwidth.MotionKind.DIVERGED


def test_nan_of_force_law_affects_only_its_own_motion():
    motion = RIGID.simulate(force=lambda x, v, t: jnp.where(x > 1e-3, jnp.nan, -1e3 * x), start_position=[1e-4, 2e-3])
    assert motion.status.tolist() == [zwidth.Status.OK, zwidth.Status.NOT_CONVERGED]
    assert motion.outcome.tolist() == [zwidth.MotionKind.UNCLEAR, zwidth.MotionKind.INVALID]
    assert np.isfinite(motion.position[0]).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"force": lambda x, v, t: x if x > 0 else 0.0}, "jnp.where in place of if"),
        ({"force": lambda x: x}, "position, velocity and time"),
        ({"force": 3.0}, "JAX cannot trace 3.0"),
        ({"force": lambda x, v, t: jnp.zeros(5)}, "one force in N for each"),
        ({"force": lambda x, v, t: "soft"}, "JAX cannot trace <lambda>"),
        ({"force": lambda x, v, t: -x, "stiffness": 1e3}, "include the wall in the law"),
        ({"stiffness": 1.0, "start_position": {"nose": 1e-3}}, "start_position: got 'nose', allowed are 'position'"),
        ({"stiffness": 1.0, "start_position": {"position": math.inf}}, "start_position: got inf m"),
        ({"stiffness": 1.0, "hand_history": np.zeros(11), "periods": 10}, "use operator=zwidth.Operator"),
        ({"stiffness": 1.0, "hand_history": np.zeros(10), "periods": 10}, "needs 11 values"),
        ({"stiffness": 1.0, "hand_history": [0.0, math.nan], "periods": 1}, "fill the gaps"),
    ],
)
def test_invalid_force_laws_and_arguments_are_rejected(arguments, message):
    with pytest.raises(zwidth.InputError, match=message):
        RIGID.simulate(**arguments)


def make_hysteresis() -> Any:
    contact: Any = False

    def law(x: Any, v: Any, t: Any) -> Any:
        nonlocal contact
        contact = jnp.where(contact, x > -1e-4, x > 0)
        return jnp.where(contact, -1e3 * x, 0.0)

    return law


class Damper:
    """A damper that differentiates the position itself."""

    def __init__(self) -> None:
        self.last: Any = 0.0

    def __call__(self, x: Any, v: Any, t: Any) -> Any:
        force, self.last = -5e3 * (x - self.last), x
        return force


def make_counter() -> Any:
    calls = [0]

    def law(x: Any, v: Any, t: Any) -> Any:
        calls[0] += 1
        return -1e3 * x * calls[0]

    return law


@pytest.mark.parametrize("make", [make_hysteresis, Damper, make_counter])
def test_force_law_with_memory_is_rejected(make):
    law = make()
    for _ in range(2):
        with pytest.raises(
            zwidth.InputError, match=r"keeps values between calls; it is compiled once, so use only position"
        ):
            RIGID.simulate(force=law, start_position=1e-3, periods=5)


def test_force_law_that_only_records_calls_is_accepted():
    calls: list[Any] = []

    def law(x: Any, v: Any, t: Any) -> Any:
        calls.append(1)
        return -1e3 * x

    assert RIGID.simulate(force=law, start_position=1e-3, periods=5).command[0] == pytest.approx(-1.0)


def test_every_body_has_its_own_initial_state():
    start: dict[str, Any] = {"position": 1e-3, "tip_position": "1.02 mm", "hand_position": -2e-3}
    speed = {"hand_position": 0.1}
    motion = GRASPED.simulate(1e3, 5.0, start_position=start, start_velocity=speed, periods=PERIODS)
    initial = (motion.position[0], motion.tip_position[0], motion.hand_position[0], motion.velocity[0])
    assert initial == pytest.approx((1e-3, 1.02e-3, -2e-3, 0.0), rel=1e-14, abs=1e-18)
    reference = integrate(GRASPED, 1e3, 5.0, PERIODS, position=[1e-3, 1.02e-3, -2e-3], velocity=[0.0, 0.0, 0.1])
    for name, column in zip(("position", "tip_position", "hand_position"), reference.position[:PERIODS].T, strict=True):
        size = tolerances.JUDGE.float64 * np.abs(reference.position).max()
        np.testing.assert_allclose(getattr(motion, name), column, rtol=0, atol=size)


def test_recorded_operator_position_drives_its_spring():
    stiffness, damping, mass, device_damping, span = 400.0, 2.0, 0.1, 3.0, 0.2

    def operator_position(t: Any) -> Any:
        return 2e-3 * np.sin(30.0 * t) ** 2

    def compute_rates(t: float, y: np.ndarray) -> list[float]:
        speed = 2e-3 * 30.0 * math.sin(60.0 * t)
        return [
            y[1],
            (stiffness * (operator_position(t) - y[0]) + damping * (speed - y[1]) - device_damping * y[1]) / mass,
        ]

    errors = []
    for period in (1e-3, 5e-4):
        hand = zwidth.Operator(stiffness=stiffness, damping=damping)
        scene = zwidth.Scene(zwidth.Device(mass, device_damping), zwidth.Timing(period), operator=hand)
        periods = round(span / period)
        times = period * np.arange(periods + 1)
        arguments: dict[str, Any] = {"hand_history": operator_position(times), "periods": periods}
        motion = scene.simulate(0.0, **arguments)
        reference = scipy.integrate.solve_ivp(
            compute_rates, (0, span), [0.0, 0.0], t_eval=times[:-1], rtol=1e-10, atol=1e-13
        )
        errors.append(np.abs(motion.position - reference.y[0]).max() / np.abs(reference.y[0]).max())
        combined = scene.simulate(0.0, external_force_history=np.full(periods, 0.7), **arguments)
        force_only = scene.simulate(0.0, external_force=0.7, periods=periods)
        np.testing.assert_allclose(combined.position, motion.position + force_only.position, atol=1e-15)
    # The operator force is held at its mean over each period, with an error proportional to the period squared.
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_contact_of_force_law_is_nonzero_force():
    """A force of 5 N where the position is at most 0, as in ros_falcon: contact begins and ends repeatedly."""
    scene = zwidth.Scene(zwidth.Device(0.1, 0.5), zwidth.Timing(1e-3, 1e-3))
    motion = zwidth.simulate(
        scene,
        force=lambda x, v, t: jnp.where(x <= 0, 5.0, 0.0),
        start_position=0.01,
        start_velocity=-0.1,
        external_force=-1.0,
    )
    assert motion.position is not None
    np.testing.assert_array_equal(motion.contact, motion.measured <= 0)
    ends = np.count_nonzero(motion.contact[:-1] & ~motion.contact[1:])
    assert motion.bounces == ends > 0
    first = np.argmax(motion.contact)
    assert first > 0
    assert motion.impact_velocity == pytest.approx(motion.velocity[first])
