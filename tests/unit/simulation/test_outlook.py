"""What is proved of motions: bounds beside the steps themselves, decisions beside those of the motion simulated on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import zwidth
from zwidth.simulation.maps import bound_rows, solve_lanes, square

SCENE = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), zwidth.Timing(period=1e-3, delay=1e-3))
TOP = SCENE.max_stiffness()
CODES = zwidth.MotionKind
# More than 64 motions at a time, and recorded: one program is compiled for all of one kind.
MANY = 80


def turn(radius: float, angle: float) -> np.ndarray:
    """A map that turns by the angle and shrinks by the radius."""
    return radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def beside(*parts: np.ndarray) -> np.ndarray:
    """Maps side by side, in coordinates that mix them."""
    n = sum(len(part) for part in parts)
    whole, at = np.zeros((n, n)), 0
    for part in parts:
        whole[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    mix = np.eye(n) + 0.3 * np.random.default_rng(n).standard_normal((n, n))
    return mix @ whole @ np.linalg.inv(mix)


SHIFT = np.diag(np.ones(3), -1)
STABLE = {
    "slow turn and a shift register": beside(turn(0.9995, 0.05), SHIFT),
    "slow and quick": beside(turn(0.999, 0.3), np.array([[0.8]]), np.array([[-0.4]]), SHIFT),
    "equal eigenvalues": beside(np.array([[0.97, 1.0], [0.0, 0.97]]), SHIFT),
}


@pytest.mark.parametrize("name", STABLE)
def test_bounds_hold_every_step_and_are_near(name):
    A, rng = STABLE[name], np.random.default_rng(1)
    n = len(A)
    states, rows = rng.standard_normal((20, n)), rng.standard_normal((20, 3, n))
    maps = np.broadcast_to(A, (20, n, n))
    low, high, _ = bound_rows(maps, states, rows, np.zeros((20, 0, n)))
    now, least, most = states, np.inf, -np.inf
    for _ in range(30_000):
        values = np.einsum("lrn,ln->lr", rows, now)
        least, most = np.minimum(least, values), np.maximum(most, values)
        now = now @ A.T
    reach = np.maximum(np.abs(least), np.abs(most))
    assert np.all((low <= least + 1e-12) & (high >= most - 1e-12))
    assert np.all((least - low <= 0.06 * reach) & (high - most <= 0.06 * reach))


def test_of_what_does_not_decay_nothing_is_said():
    maps = np.stack([beside(turn(radius, 0.3), SHIFT) for radius in (1.01, 0.9)])
    low, high, above = bound_rows(maps, np.ones((2, 6)), np.ones((2, 1, 6)), np.ones((2, 1, 6)))
    assert np.isnan([low[0], high[0]]).all()
    assert np.isfinite([low[1], high[1]]).all()
    assert not above.any()


def test_a_row_stays_above_zero_where_the_slowest_part_wins():
    """``0.99^k + a 0.9^k`` from a = -1.2 to 1: it is above 0 if it is so at k = 0."""
    share = np.array([-1.2, -1.01, -0.9, 0.5, 1.0])
    maps = np.broadcast_to(np.diag([0.99, 0.9]), (5, 2, 2))
    state = np.stack([np.ones(5), share], 1)
    _, _, above = bound_rows(maps, state, np.zeros((5, 0, 2)), np.ones((5, 1, 2)))
    assert above.tolist() == [False, False, True, True, True]
    _, _, below = bound_rows(maps, -state, np.zeros((5, 0, 2)), np.ones((5, 1, 2)))
    assert not below.any()


def test_squarings_show_decay_and_growth():
    radii = np.array([0.5, 0.99, 0.9999, 1.0, 1.0001, 1.3])
    found = square(np.stack([beside(turn(radius, 1.0), SHIFT) for radius in radii]))
    assert np.sign(found).tolist() == [1, 1, 1, 0, -1, -1]
    # Half of it within twice as many periods as the radius asks for, but for what the mixed coordinates take.
    halving = np.log(0.5) / np.log(radii[1:3])
    assert np.all((2.0 ** found[1:3] >= halving) & (2.0 ** found[1:3] <= 16 * halving))


def test_a_lane_without_a_solution_spoils_no_other():
    maps = np.stack([np.eye(2), np.zeros((2, 2)), 2.0 * np.eye(2)])
    found = solve_lanes(maps, np.ones((3, 2, 1)))[..., 0]
    assert found[[0, 2]].tolist() == [[1.0, 1.0], [0.5, 0.5]]
    assert np.isnan(found[1]).all()


def _limit_force(motion: zwidth.Motion, given: dict) -> np.ndarray:
    return np.abs(motion.command) >= given["max_force"][:, None] * (1 - 1e-9)


def _limit_rate(motion: zwidth.Motion, given: dict) -> np.ndarray:
    change = np.abs(np.diff(motion.command, axis=-1, prepend=0.0)) / 1e-3
    return change >= given["max_rate"][:, None] * (1 - 1e-9)


def _leave(motion: zwidth.Motion, given: dict) -> np.ndarray:
    return ~motion.contact


def _pull(motion: zwidth.Motion, given: dict) -> np.ndarray:
    return (motion.command >= 0.0) | ~motion.contact


SPREAD = np.linspace(0.0, 1.0, 120)
HIT = {"start_position": 1e-3, "stiffness": 0.7 * float(TOP.stiffness), "virtual_damping": float(TOP.virtual_damping)}
# What each motion may meet, and at which samples it does.
MEETS = {
    "the motor's limit": ({"max_force": 0.5 + 4.0 * SPREAD, "push": 0.4}, _limit_force),
    "the limit of its rate": ({"max_rate": 10.0 ** (1.0 + 3.0 * SPREAD)}, _limit_rate),
    "the surface": ({"push": 4.0 * SPREAD, "contact": "unilateral"}, _leave),
    "a force that would pull": ({"push": 8.0 * SPREAD, "contact": "push_only"}, _pull),
}


@pytest.mark.parametrize("name", MEETS)
def test_who_is_said_to_come_to_rest_meets_no_decision_any_more(name):
    given, meets = MEETS[name]
    periods = 40
    now = SCENE.simulate(**HIT, **given, periods=periods)
    later = SCENE.simulate(**HIT, **given, periods=3000)
    met = meets(later, given)
    # At a limit it may not be again; the side of the wall is the last one.
    before = met[:, periods - 1 : periods] & (given.get("contact") is not None)
    changes = np.any(met[:, periods:] != before, axis=1)
    settles = np.isin(now.outcome, [CODES.REST, CODES.DECAYING])
    assert settles.sum() > 10
    assert changes.sum() > 10
    assert not np.any(settles & changes)
    assert np.all(later.amplitude[settles] < 1e-9)
    # A bound that is too wide says too little.
    assert np.mean(settles | changes) > 0.95


def test_who_pushes_harder_than_motor_and_friction_goes_on():
    push, coulomb = np.tile([[1.4, 1.6, -1.6, 1.6], [0.5, 0.5, 0.5, 0.7]], MANY // 4)
    found = SCENE.simulate(1e3, 5.0, push=push, max_force=1.0, coulomb=coulomb, periods=4000)
    assert [CODES(code).name for code in found.outcome] == ["REST", "RESTLESS", "RESTLESS", "REST"] * (MANY // 4)
    assert found.amplitude[1] == pytest.approx(found.amplitude[2])


def test_who_creeps_while_it_slips_comes_to_rest():
    """Overdamped and rubbed, the device slips one way for good, and so it does in 20 times as many periods."""
    push = np.concatenate([np.linspace(0.2, 2.0, MANY // 2), np.linspace(-2.0, -0.6, MANY // 2)])
    given = {"start_position": -1e-3, "push": push, "coulomb": 0.1, "static": 0.12}
    now = SCENE.simulate(200.0, 30.0, **given, periods=300)
    later = SCENE.simulate(200.0, 30.0, **given, periods=6000)
    settles = np.isin(now.outcome, [CODES.REST, CODES.DECAYING])
    turned = (np.sign(later.velocity[:, 300:]) * np.sign(now.velocity[:, -1:]) < 0).any(1)
    assert settles[: MANY // 2].sum() > MANY // 4
    assert settles[MANY // 2 :].sum() > MANY // 4
    assert not np.any(settles & turned)
    assert np.all(later.amplitude[settles] < 1e-9)


def test_who_is_said_to_come_to_rest_while_it_slips_never_turns():
    """Walls from such that the device swings in to such that it creeps, shortly behind the impact."""
    damping, push = np.meshgrid(np.linspace(0.0, 30.0, 30), [0.3, 1.0, 2.0])
    given = {"virtual_damping": damping.ravel(), "push": push.ravel(), "coulomb": 0.02, "start_position": -1e-3}
    now, later = (SCENE.simulate(400.0, **given, periods=periods) for periods in (25, 2500))
    slips = ~now.sticking[:, -1]
    turns = (np.sign(later.velocity[:, 24:]) * np.sign(now.velocity[:, -1:]) < 0).any(1)
    settles = np.isin(now.outcome, [CODES.REST, CODES.DECAYING])
    assert (slips & turns).sum() > 10
    assert not np.any(slips & turns & settles)
    # Who creeps is told early, and who hardly moves any more at last.
    assert (settles & slips).sum() > 5
    assert (~later.sticking[:, -1]).sum() > 5
    assert not np.any(later.outcome == CODES.UNCLEAR)


@pytest.mark.parametrize("name", ["resolution", "coulomb"])
def test_who_is_too_wide_for_steps_and_friction_to_stop_grows(name):
    """Friction stops the narrow ones of these unstable motions, and no one says that they grow."""
    given: dict[str, Any] = {name: np.geomspace(*{"resolution": (1e-7, 3e-4), "coulomb": (1e-4, 30.0)}[name], MANY)}
    wall = 1.04 * float(TOP.stiffness), float(TOP.virtual_damping)
    now, later = (SCENE.simulate(*wall, **given, start_position=1e-3, periods=periods) for periods in (80, 800))
    grew = later.amplitude > 2.0 * now.amplitude
    grows = now.outcome == CODES.GROWING
    assert grows.sum() > 20
    assert not np.any(grows & ~grew)
    assert np.mean(grows[grew]) > 0.5
    assert name == "resolution" or (~grew).sum() > 10


VELOCITIES = {"difference": zwidth.BackwardDifference(), "low pass": zwidth.LowPass(cutoff=80.0)}


@pytest.mark.parametrize("name", VELOCITIES)
def test_a_damper_without_a_spring_comes_to_rest_where_it_is(name):
    """No place is asked for: the device coasts by ``m v/(b + B)``, and readings shift with it."""
    scene = SCENE.replace(velocity=VELOCITIES[name])
    damping = np.linspace(5.0, 8.0, MANY)
    given: dict[str, Any] = {"start_position": 2e-3, "start_velocity": 0.05}
    now, later = (scene.simulate(0.0, damping, **given, periods=periods) for periods in (60, 6000))
    assert now.outcome.tolist() == [CODES.DECAYING] * MANY
    assert later.outcome.tolist() == [CODES.REST] * MANY
    np.testing.assert_allclose(later.position[:, -1], 2e-3 + 0.1 * 0.05 / (2.0 + damping), rtol=0.05)


def test_who_is_pushed_on_no_spring_is_at_rest_only_where_20_times_as_long_does_not_tell():
    given = {"push": np.geomspace(1e-17, 1e-6, 40), "start_position": 2e-3, "record": False}
    now, later = (SCENE.simulate(0.0, 5.0, **given, periods=periods) for periods in (2000, 40_000))
    settles = np.isin(now.outcome, [CODES.REST, CODES.DECAYING])
    assert settles.sum() > 5
    assert (~settles).sum() > 5
    assert np.all(later.amplitude[settles] < 1e-8 * 2e-3)


def test_a_held_body_is_let_go_by_what_swings_behind_it():
    """Friction holds the motor; the tip's swing falls slowly, and breaks it loose in some of these."""
    coupled = zwidth.Scene(zwidth.Device(0.1, 2.0, zwidth.Coupling(0.05, 5e3, 0.5)), zwidth.Timing(1e-3, 1e-3))
    given = {"start_velocity": 0.2, "coulomb": np.linspace(0.05, 6.0, 60)}
    later = coupled.simulate(2e3, 5.0, **given, periods=1500)
    told, broken, clear = 0, 0, 0.0
    for periods in range(10, 100, 20):
        now = coupled.simulate(2e3, 5.0, **given, periods=periods)
        held, loose = later.sticking[:, periods - 1], ~later.sticking[:, periods:].all(1)
        settles = np.isin(now.outcome, [CODES.REST, CODES.DECAYING])
        told, broken = told + np.sum(settles & held), broken + np.sum(held & loose)
        assert not np.any(settles & loose)
        clear = np.mean(settles | loose)
    assert clear > 0.25
    assert min(told, broken) > 20


@pytest.mark.parametrize("more", [{}, {"resolution": 1e-5, "coulomb": 0.05}], ids=str)
def test_what_is_proved_of_a_motion_hangs_on_its_own_jitter_alone(more):
    scene = SCENE.replace(delay=1.4e-3)
    given = {"start_position": 1e-3, "periods": 1500, "record": False, **more}
    walls = [[float(TOP.stiffness) * share] for share in (0.3, 1.2)], float(TOP.virtual_damping)
    alone, beside_it = (scene.simulate(*walls, jitter=jitter, **given).outcome for jitter in (0.0, [0.0, 2e-5]))
    assert CODES.UNCLEAR not in alone
    np.testing.assert_array_equal(beside_it[:, 0], alone[:, 0])
    assert set(beside_it[:, 1]) <= {CODES.UNCLEAR, CODES.DIVERGED}


LATE = zwidth.Scene(zwidth.Device(mass=0.1, damping=1.0), zwidth.Timing(period=1e-3, delay=0.05))


@pytest.mark.parametrize("damping", [5.0, 0.1])
@pytest.mark.parametrize("more", [{}, {"resolution": 1e-6}, {"coulomb": 1e-4}, {"max_force": 100.0}])
def test_who_has_not_moved_yet_is_not_at_rest_while_its_commands_are_on_their_way(damping, more):
    """The first command arrives 50 periods after the start: until then nothing moves, whatever becomes of it."""
    given: dict[str, Any] = {"stiffness": damping * 10.0, "virtual_damping": damping, "start_position": 1e-3, **more}
    now, later = (LATE.simulate(**given, periods=periods) for periods in (40, 4000))
    assert np.ptp(now.position) == 0.0
    assert np.ptp(later.position) > 1e-4
    assert now.outcome != CODES.REST
    assert {now.outcome, later.outcome} & {CODES.UNCLEAR, CODES.RESTLESS} or now.outcome == later.outcome


@pytest.mark.parametrize(("stiffness", "outcome"), [(0.5, CODES.DECAYING), (50.0, CODES.GROWING)])
def test_who_was_moved_and_put_back_is_not_at_rest_while_its_commands_are_on_their_way(stiffness, outcome):
    """A hand moves a device without damping forth and back within four periods; the wall answers 50 later."""
    push = np.zeros(40)
    push[:4] = 1.0, -1.0, -1.0, 1.0
    free = LATE.replace(damping=0.0)
    found = free.simulate(stiffness, 0.2 * stiffness**0.5, push_history=push, periods=40, tail=20)
    assert np.ptp(found.position[20:]) < 1e-15
    assert found.outcome == outcome


# A hand on a spring balances its push by readings; one on none would be restless.
READ = {
    "wall": (SCENE, 0.0),
    "window": (SCENE.replace(delay=1.4e-3, velocity=zwidth.WindowedDifference(2)), 0.0),
    "push": (SCENE.replace(delay=1.4e-3, operator=zwidth.Operator(0.1, 1.0, 2e3)), 0.3),
}


@pytest.mark.parametrize("name", READ)
def test_readings_that_are_said_to_repeat_do_so(name):
    scene, push = READ[name]
    periods, top = 1200, scene.max_stiffness()
    wall = 0.6 * float(top.stiffness), float(top.virtual_damping)
    given = {"start_position": 1e-3, "resolution": np.geomspace(3e-6, 1e-4, 80), "max_force": 20.0, "max_rate": 2e4}
    given["push"] = push
    # Nothing said depends on whether the motion is kept: once that is looked at, then one program serves both.
    now = scene.simulate(*wall, **given, periods=periods, record=name != "wall")
    later = scene.simulate(*wall, **given, periods=8 * periods)
    counts = np.round(later.measured / given["resolution"][:, None]).astype(int)
    cyclic = np.array(
        [any(np.array_equal(row[periods:], row[periods - p : -p]) for p in range(2, 250)) for row in counts]
    )
    steady = now.outcome == CODES.STEADY
    assert steady.sum() > 20
    assert not np.any(steady & ~cyclic)
    assert np.mean(steady[cyclic]) > 0.5


def test_who_repeats_by_now_but_was_wider_in_the_tail_is_restless():
    """A window of three samples: the tail has the end of the impact, 9 um wide, and what goes on is 2.4 um wide."""
    scene = SCENE.replace(damping=10.0, velocity=zwidth.WindowedDifference(3))
    given = {"start_position": 1e-3, "resolution": 1.2395340354523154e-06, "record": False}
    wall = 10577.713816316867, 12.84142590488951
    now, later = (scene.simulate(*wall, **given, periods=periods) for periods in (1500, 12_000))
    assert now.amplitude > 3.0 * later.amplitude
    assert (now.outcome, later.outcome) == (CODES.RESTLESS, CODES.STEADY)
    assert now.trend < 0.5
