"""Diagnosis of a wall in time: the cause of a sustained oscillation, and the changes that stop it.

Symbols: K and B of the wall, Q one step of the encoder, f the Coulomb friction, T the period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from zwidth.parts.checks import check_number
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.wall import VirtualWall, resolve_wall
from zwidth.scenes.base import of_scene
from zwidth.scenes.stiffest import SceneOptima
from zwidth.simulation.result import MotionKind
from zwidth.simulation.simulate import simulate
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, round_safely, to_json, with_unit
from zwidth.words.quantities import POSITIVE
from zwidth.words.rotation import in_own_units, is_rotary
from zwidth.words.showing import shown

Cause: TypeAlias = Literal["none", "instability", "quantization", "saturation", "undecided"]

DISPLACEMENTS = (0.6, 1.3, 2.2, 3.7, 7.1, 13.0, 26.0, 50.0)  # initial displacements, in steps of the encoder
OVERLOADS = (1.5, 6.0, 30.0)  # initial spring forces, in units of the largest force of the motor
LARGEST_PUSH = 0.9  # constant external force on a linear system, in units of the largest force of the motor
SPEEDS = (0.05, 0.5)  # initial velocities of a pure damper, in steps of the encoder per period
FIRST_DISPLACEMENT = 1e-3  # in m or rad, where neither encoder nor motor sets a scale

TIME_CONSTANTS = 30.0  # length of a simulation, in time constants of the linear loop
FEWEST_PERIODS, MOST_PERIODS = 2000, 200_000
MOST_SEARCHED = 20_000  # periods of a simulation during the search for remedies
SETTLED = 2.0  # time constants after which a motion without a proof may be called sustained
SUSTAINED = 0.8  # ratio of the widths of both halves of the tail, above which a motion without a proof is sustained
RUNAWAY = 1.1  # the same ratio, above which a motion without a frequency grows without bound

SPAN = 64.0  # a remedy changes its parameter by at most this factor
COARSE, FINE = 12, 6  # values of a parameter that are simulated, first over the span, then next to the boundary
TRIALS = 16  # trials simulated together; a constant number, because JAX compiles for each
LONG_DELAY = 50.0  # periods; beyond it a single trial takes seconds, and no remedies are searched for

_REMEDIES = {
    "resolution": ("an encoder with steps of", "m"),
    "coulomb": ("friction of", "N"),
    "stiffness": ("K of", "N/m"),
    "virtual_damping": ("B of", "N s/m"),
    "delay": ("a delay of", "s"),
}


class Remedy(NamedTuple):
    """A range of one parameter in which the oscillation stops, with everything else unchanged."""

    parameter: str  # "resolution", "coulomb", "stiffness", "virtual_damping" or "delay"
    low: float  # SI units; 0 for no lower end
    high: float  # infinite for no upper end

    def spell(self) -> str:
        """Return the change in words, with its unit."""
        words, unit = _REMEDIES[self.parameter]
        low, high = (with_unit(end, unit, 3) for end in (self.low, self.high))
        if self.low > 0 and self.high < math.inf:
            return f"{words} {low} to {high}"
        text = f"{words} at least {low}" if self.low > 0 else f"{words} at most {high}"
        if self.parameter == "resolution" and is_rotary():
            text += f" ({_count_steps(self.high):,} counts per turn)"
        return text


class Hardware(NamedTuple):
    """Encoder, friction and motor of a device, in SI units."""

    resolution: float
    coulomb: float
    static: float
    max_force: float
    max_rate: float


@shown(
    ("cause", "amplitude", "frequency", "linearly_stable", "phase_margin", "remedies"),
    missing={"frequency": "no oscillation", "phase_margin": "no frequency decides it"},
    amplitude="m",
    frequency="Hz",
    phase_margin="degrees",
)
@dataclass(frozen=True)
class Diagnosis:
    """Cause of the sustained oscillation of a wall, from `diagnose`.

    Attributes:
        cause: "instability", the linear loop is unstable; "quantization", the steps of the encoder; "saturation", the
            limits of the motor; "none", every simulated motion comes to rest; "undecided", the linear loop decays too
            slowly for a simulation.
        stiffness, virtual_damping: K in N/m and B in N s/m.
        hardware: encoder, friction and motor.
        linearly_stable: whether the loop without encoder, friction and limits is stable.
        phase_margin: phase margin of that loop in degrees.
        amplitude: half of the peak-to-peak position of the widest sustained motion, in m; 0 if all come to rest,
            infinite if one grows without bound.
        frequency: frequency of that motion in Hz, of the dominant pole where it grows without bound; NaN at rest.
        outcome: code of `zwidth.MotionKind` of that motion; UNCLEAR means sustained, without a proof.
        remedies: changes that stop the oscillation, each by itself; of limit cycles none are searched for if the delay
            exceeds 50 periods.
    """

    cause: Cause
    stiffness: float
    virtual_damping: float
    hardware: Hardware
    linearly_stable: bool
    phase_margin: float
    amplitude: float
    frequency: float
    outcome: MotionKind
    remedies: tuple[Remedy, ...] = ()

    @property
    def word(self) -> str:
        """The result in capitals, as commands print it."""
        if self.cause in ("quantization", "saturation"):
            return "LIMIT CYCLE" if math.isfinite(self.amplitude) else "UNBOUNDED"
        return {"none": "AT REST", "instability": "UNSTABLE"}.get(self.cause, "UNDECIDED")

    @in_own_units
    def explain(self) -> str:
        """Return the cause in one sentence."""
        size = with_unit(self.amplitude, "m", 2)
        swing = f"{size} at {with_unit(self.frequency, 'Hz', 2)}" if math.isfinite(self.amplitude) else "without bound"
        margin = f", phase margin {plain(self.phase_margin, 3)} deg" if math.isfinite(self.phase_margin) else ""
        linear = f"the linear loop is stable{margin}" if self.linearly_stable else "no spring returns the device"
        if self.cause == "instability":
            limited = f"; the simulation reaches {swing}" if 0 < self.amplitude < math.inf else ""
            stuck = "; friction holds small displacements" if self.amplitude == 0 else ""
            return f"the linear loop is unstable at {with_unit(self.frequency, 'Hz', 3)}{limited}{stuck}"
        if self.cause == "quantization":
            return f"{swing}, caused by the encoder's steps of {with_unit(self.hardware.resolution, 'm', 3)}; {linear}"
        if self.cause == "saturation":
            limits = [with_unit(self.hardware.max_force, "N", 3)] if math.isfinite(self.hardware.max_force) else []
            limits += [with_unit(self.hardware.max_rate, "N/s", 3)] if math.isfinite(self.hardware.max_rate) else []
            return f"{swing}, caused by the motor's limit of {' and '.join(limits)}; {linear}"
        if self.cause == "undecided":
            return f"the linear loop decays too slowly to simulate until rest; {linear}"
        return f"no sustained oscillation; {linear}"

    @in_own_units
    def advise(self) -> str:
        """Return the remedies in one sentence, "" if none is needed."""
        if self.cause in ("none", "undecided"):
            return ""
        if self.remedies:
            return ", or ".join(remedy.spell() for remedy in self.remedies)
        return "no change of a single parameter is known"

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values, None in place of NaN and infinities."""
        known = {name: getattr(self, name) for name in self.__dataclass_fields__}
        known |= {"hardware": self.hardware._asdict(), "outcome": self.outcome.name}
        return to_json(known | {"remedies": [remedy._asdict() for remedy in self.remedies]})


@of_scene
def diagnose(
    scene: SceneOptima,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    *,
    resolution: float | str = 0.0,
    coulomb: float | str = 0.0,
    static: float | str | None = None,
    max_force: float | str = np.inf,
    max_rate: float | str = np.inf,
    remedies: bool = True,
) -> Diagnosis:
    """Find out why a device oscillates on a wall, and which change stops it.

    The linear loop is judged by `zwidth.Scene.is_stable`. Then the wall is simulated with encoder, friction and motor
    from several initial displacements, with and without the worst constant external force, half a step of the encoder
    times K. An oscillation that ends without the encoder, or without the limits of the motor, is attributed to
    it. Each remedy is simulated in the same way, with the value returned and with values further from the present one.

    Args:
        scene: device, timing and parts.
        stiffness: K in N/m.
        virtual_damping: B in N s/m. Neither means the scene's own wall.
        resolution: step of the encoder in m; 0 for none.
        coulomb: friction while the device slips, in N.
        static: friction that holds the device, in N; ``coulomb`` where left out.
        max_force: largest force of the motor, in N.
        max_rate: largest rate of the commanded force, in N/s.
        remedies: also search for remedies, which takes most of the time.

    Returns:
        Diagnosis: cause, amplitude, frequency and remedies. The widest of the simulated motions is reported; others may
        be wider.

    Raises:
        InputError: a value is not usable, or the scene has no wall, no poles or no model.

    References:
        Abbott, Okamura 2005, IEEE Trans. Robotics 21(5):952-964 (encoder and friction).

    Example:
        >>> import zwidth
        >>> device = zwidth.Device(mass="60 g cm^2", damping="0.02 mN m s/rad")
        >>> scene = zwidth.Scene(device, zwidth.Timing(period=1e-3, delay=0.7e-3), velocity=zwidth.LowPass(cutoff=100))
        >>> found = zwidth.diagnose(scene, 0.3, 1.4e-3, resolution="0.0005 rev", coulomb="0.1 mN m", remedies=False)
        >>> found.cause
        'quantization'
    """
    K, B = (float(value) for value in resolve_wall(scene.wall, stiffness, virtual_damping, scene.device.rotary))
    sliding = check_number("coulomb", coulomb, "N")
    hardware = Hardware(
        check_number("resolution", resolution, "m"),
        sliding,
        sliding if static is None else check_number("static", static, "N"),
        _check_limit("max_force", max_force, "N"),
        _check_limit("max_rate", max_rate, "N/s"),
    )
    scene = scene.replace(wall=VirtualWall(K, B))
    stable, dominant, margins = bool(scene.is_stable()), _find_dominant(scene), scene.margins()
    rate = TIME_CONSTANTS / FEWEST_PERIODS if dominant.marginal else dominant.rate
    periods = int(np.clip(TIME_CONSTANTS / max(rate, 1e-9), FEWEST_PERIODS, MOST_PERIODS))
    experiment = _Experiment(scene, hardware, _list_starts(scene, hardware), periods, rate * periods)
    worst = experiment.measure()
    cause, frequency = _find_cause(experiment, worst, dominant), float(worst.frequency[0])
    if cause == "instability" and not math.isfinite(frequency):
        frequency = dominant.angle / (2.0 * math.pi * scene.timing.period)
    found: list[Remedy] = []
    if remedies and cause == "instability":
        found = _stabilize(scene)
    elif remedies and cause in ("quantization", "saturation") and scene.d <= LONG_DELAY:
        found = _search(experiment, cause)
    return Diagnosis(
        cause, K, B, hardware, stable, float(margins.phase_margin), float(worst.amplitude[0]), frequency,
        MotionKind(int(worst.outcome[0])), tuple(found),
    )  # fmt: skip


def _check_limit(name: str, value: Any, unit: str) -> float:
    """Return a limit of the motor in SI units, infinite for none."""
    unlimited = isinstance(value, int | float | np.floating) and value == math.inf
    return math.inf if unlimited else check_number(name, value, unit, POSITIVE)


def _count_steps(resolution: float) -> int:
    """Return the counts per turn of an encoder with these steps in rad."""
    return math.ceil(2.0 * math.pi / resolution - 1e-6)


def _find_dominant(scene: Any) -> Any:
    """Return the dominant pole of the wall of a scene."""
    return scene.loop.slowest(float(scene.alpha), float(scene.beta))


class _Starts(NamedTuple):
    """Initial conditions of the simulations of one wall, arrays of one axis."""

    position: np.ndarray
    velocity: np.ndarray
    push: np.ndarray  # constant external force
    half_steps: np.ndarray  # additional external force, in units of K Q/2
    scaled: np.ndarray  # bool; the displacement is proportional to the steps of the encoder


def _list_starts(scene: Any, hardware: Hardware) -> _Starts:
    """Return the initial conditions for the present wall and hardware."""
    K, Q, period = float(scene.wall.stiffness), hardware.resolution, scene.timing.period
    position = [Q * factor for factor in DISPLACEMENTS if Q > 0]
    half_steps = [0.0] * len(position) + [1.0] * len(position)
    # The widest one stays when an encoder with other steps is tried; the others follow its steps.
    scaled = 2 * len(position)
    position, half_steps = position * 2 + position[-1:] * 2, half_steps + [0.0, 1.0][: 2 * len(position)]
    loads = [hardware.max_force, hardware.max_rate * period]
    position += [factor * load / K for load in loads if K > 0 and load < math.inf for factor in OVERLOADS]
    position = position or [FIRST_DISPLACEMENT]
    velocity = np.zeros(len(position))
    if K == 0:
        velocity = np.resize(SPEEDS, len(position)) * position / period
    halves = np.zeros(len(position))
    halves[: len(half_steps)] = half_steps
    starts = np.array(position), velocity, np.zeros(len(position)), halves, np.arange(len(position)) < scaled
    if isinstance(scene.device, LinearDevice):
        # A linear system starts at rest at 0: an external force displaces the rest position instead.
        push = np.minimum(K * starts[0], LARGEST_PUSH * hardware.max_force)
        return _Starts(np.zeros(len(push)), np.zeros(len(push)), push, *starts[3:])
    return _Starts(*starts)


class _Widest(NamedTuple):
    """The widest sustained motion of each of several trials, arrays of one axis."""

    amplitude: np.ndarray  # 0 if every motion comes to rest
    frequency: np.ndarray
    outcome: np.ndarray
    proved: np.ndarray  # the simulation reports a proof for each motion


class _Experiment(NamedTuple):
    """Simulations of a wall under one hardware, from the same initial conditions."""

    scene: Any
    hardware: Hardware
    starts: _Starts
    periods: int
    decay: float  # time constants of the linear loop within the periods

    @property
    def present(self) -> dict[str, float]:
        """Wall and hardware by the names of the arguments of `simulate`."""
        wall = self.scene.wall
        walls = {"stiffness": float(wall.stiffness), "virtual_damping": float(wall.virtual_damping)}
        return self.hardware._asdict() | walls

    def measure(self, **changes: Any) -> _Widest:
        """Simulate the wall with parameters changed, one trial for each value."""
        count = max([np.size(value) for value in changes.values()], default=1)
        width = TRIALS if self.scene.d <= LONG_DELAY else 1
        rows = [np.minimum(np.arange(start, start + width), count - 1) for start in range(0, count, width)]
        table = {name: np.broadcast_to(value, count) for name, value in (self.present | changes).items()}
        parts = [self._measure({name: value[row] for name, value in table.items()}) for row in rows]
        return _Widest(*(np.concatenate(columns)[:count] for columns in zip(*parts, strict=True)))

    def _measure(self, table: dict[str, np.ndarray]) -> _Widest:
        """Simulate trials, one for each row of a table."""
        starts = self.starts
        columns: dict[str, Any] = {name: value[:, None] for name, value in table.items()}
        present = self.hardware.resolution
        ratio = columns["resolution"] / present if present > 0 else 1.0
        push = starts.push + 0.5 * starts.half_steps * columns["stiffness"] * columns["resolution"]
        motion = simulate(
            self.scene,
            **columns,
            start_position=starts.position * np.where(starts.scaled, ratio, 1.0),
            start_velocity=starts.velocity,
            push=push,
            periods=self.periods,
            record=False,
        )
        if np.any(motion.outcome == MotionKind.INVALID):
            raise InputError("coulomb: friction stops and starts the device too often within a period; lower it")
        # The tail of a motion that decays as the linear loop does narrows by exp(-decay/8).
        return _pick_widest(motion, max(SUSTAINED, math.exp(-max(self.decay, 0.0) / 16.0)))


def _pick_widest(motion: Any, least_trend: float) -> _Widest:
    """Return the widest sustained motion along the last axis."""
    kind, unproved = motion.outcome, motion.outcome == MotionKind.UNCLEAR
    unbounded = (kind == MotionKind.DIVERGED) | (kind == MotionKind.GROWING)
    sustained = (kind == MotionKind.STEADY) | (kind == MotionKind.RESTLESS) | (unproved & (motion.trend > least_trend))
    # A motion without a frequency drifts, or runs away from an unstable rest position.
    oscillating = np.isfinite(motion.frequency)
    unbounded |= ~oscillating & (unproved | (kind == MotionKind.RESTLESS)) & (motion.trend > RUNAWAY)
    sustained = unbounded | (sustained & oscillating)
    amplitude = np.where(unbounded, np.inf, np.where(sustained, motion.amplitude, 0.0))
    place = np.argmax(amplitude, axis=-1)[:, None]
    size, frequency, outcome = (
        np.take_along_axis(part, place, -1)[:, 0] for part in (amplitude, motion.frequency, kind)
    )
    return _Widest(size, frequency, outcome, ~unproved.any(-1))


def _find_cause(experiment: _Experiment, worst: _Widest, dominant: Any) -> Cause:
    """Return the cause of the widest sustained motion."""
    scene, hardware = experiment.scene, experiment.hardware
    if not dominant.marginal and not scene.is_stable():
        return "instability"
    if not worst.proved[0] and experiment.decay < SETTLED:
        return "undecided"
    if worst.amplitude[0] == 0:
        return "none"
    limited = min(hardware.max_force, hardware.max_rate) < math.inf
    if limited and hardware.resolution > 0:
        unlimited = experiment.measure(max_force=np.inf, max_rate=np.inf)
        # A saturated motion is wider than the limit cycle of the encoder that remains without the limits.
        limited = bool(worst.amplitude[0] > 2.0 * unlimited.amplitude[0])
    return "saturation" if limited else "quantization" if hardware.resolution > 0 else "undecided"


def _stabilize(scene: Any) -> list[Remedy]:
    """Return the ranges of K, B and delay in which the linear loop is stable."""
    K, B, delay = float(scene.wall.stiffness), float(scene.wall.virtual_damping), float(scene.timing.delay)
    found = []
    for name, value, intervals in (
        ("stiffness", K, scene.stable_stiffness(B)),
        ("virtual_damping", B, scene.stable_damping(K)),
    ):
        if len(intervals):
            ends = min(intervals.tolist(), key=lambda ends: max(ends[0] - value, value - ends[1]))
            found.append(Remedy(name, round_safely(max(ends[0], 0.0), "above", 3), round_safely(ends[1], "below", 3)))
    low, high = 0.0, delay
    if delay and scene.replace(delay=0.0).is_stable():
        while high - low > 1e-3 * delay:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if scene.replace(delay=middle).is_stable() else (low, middle)
        if (value := round_safely(low, "below", 3)) > 0:
            found.append(Remedy("delay", 0.0, value))
    return [remedy for remedy in found if remedy.low < remedy.high and _is_stabilized(scene, remedy)]


def _is_stabilized(scene: Any, remedy: Remedy) -> bool:
    """Return whether a simulation of the linear loop decays at the ends of a range."""
    ends = [end for end in (remedy.low, remedy.high) if 0 < end < math.inf]
    start: dict[str, Any] = (
        {"push": 1.0} if isinstance(scene.device, LinearDevice) else {"start_position": FIRST_DISPLACEMENT}
    )
    changed = [scene.replace(**{remedy.parameter: end}) for end in ends]
    outcome = simulate(changed, periods=FEWEST_PERIODS, record=False, **start).outcome
    return bool(np.isin(outcome, (MotionKind.REST, MotionKind.DECAYING)).all())


class _Candidates(NamedTuple):
    """Values of one parameter in the direction of a remedy, the mildest change first."""

    parameter: str
    values: np.ndarray
    increasing: bool

    def select(self, at_rest: np.ndarray) -> int:
        """Return the index of the first value from which on all come to rest; their count if the last does not."""
        return len(at_rest) - int(np.argmin(np.append(at_rest[::-1], False)))

    def refine(self, index: int, present: float) -> _Candidates:
        """Return values between the last that oscillates and the one selected, both included."""
        before = self.values[index - 1] if index else present or self.values[0] / 2
        values = np.geomspace(before, self.values[index], FINE + 2)[1:]
        return self._replace(values=values).round()

    def round(self) -> _Candidates:
        """Return the values in three digits, rounded away from the present one."""
        values = [round_safely(value, "above" if self.increasing else "below", 3) for value in self.values.tolist()]
        if self.parameter == "resolution" and is_rotary():
            values = [2.0 * math.pi / round_safely(_count_steps(value), "above", 3) for value in self.values.tolist()]
        return self._replace(values=np.array(values))


def _list_candidates(experiment: _Experiment, cause: Cause) -> list[_Candidates]:
    """Return the values of every parameter that may stop the oscillation."""
    scene, hardware = experiment.scene, experiment.hardware
    K, B, Q = float(scene.wall.stiffness), float(scene.wall.virtual_damping), hardware.resolution
    factors = np.geomspace(1.0, SPAN, COARSE + 1)[1:]
    found = []
    # Without friction a limit cycle scales with the steps of the encoder, and remains.
    if cause == "quantization" and hardware.static > 0:
        found.append(_Candidates("resolution", Q / factors, False))
    if not isinstance(scene.device, LinearDevice):
        least = hardware.coulomb or (K * Q if cause == "quantization" else hardware.max_force) / SPAN
        found.append(_Candidates("coulomb", least * factors, True))
    # Without friction an external force of half a step keeps the reading changing at any K and B.
    if cause == "quantization" and not hardware.static:
        return [each.round() for each in found]
    if K > 0:
        found.append(_Candidates("stiffness", K / factors, False))
    if B > 0:
        found += [_Candidates("virtual_damping", B / factors, False), _Candidates("virtual_damping", B * factors, True)]
    return [each.round() for each in found if np.all(np.isfinite(each.values) & (each.values > 0))]


def _search(experiment: _Experiment, cause: Cause) -> list[Remedy]:
    """Return the mildest changes of each parameter after which every simulated motion comes to rest."""
    hardware = experiment.hardware
    periods = min(experiment.periods, MOST_SEARCHED)
    experiment = experiment._replace(periods=periods, decay=experiment.decay * periods / experiment.periods)
    if cause == "saturation":
        experiment = experiment._replace(hardware=hardware._replace(resolution=0.0))
    chosen = []
    candidates = _list_candidates(experiment, cause)
    for each, at_rest in zip(candidates, _try(experiment, candidates), strict=True):
        index = each.select(at_rest)
        if index < len(at_rest):
            chosen.append((each, each.refine(index, experiment.present[each.parameter])))
    found = []
    for (coarse, fine), at_rest in zip(chosen, _try(experiment, [fine for _, fine in chosen]), strict=True):
        index = fine.select(at_rest)
        if index < len(at_rest):
            value, last = float(fine.values[index]), float(coarse.values[-1])
            open_end = math.inf if coarse.parameter == "coulomb" else last
            found.append(Remedy(coarse.parameter, *((value, open_end) if coarse.increasing else (0.0, value))))
    return found


def _try(experiment: _Experiment, candidates: list[_Candidates]) -> list[np.ndarray]:
    """Return for each of several lists of candidates which of them come to rest."""
    if not candidates:
        return []
    hardware, sizes = experiment.hardware, [len(each.values) for each in candidates]
    names = {"coulomb", "static", *(each.parameter for each in candidates)}
    table = {name: np.full(sum(sizes), experiment.present[name]) for name in names}
    ends = np.cumsum(sizes)
    for each, end in zip(candidates, ends, strict=True):
        table[each.parameter][end - len(each.values) : end] = each.values
    # Static friction grows with the friction while slipping.
    grown = hardware.static / hardware.coulomb if hardware.coulomb else 1.0
    table["static"] = np.maximum(table["static"], grown * table["coulomb"])
    return np.split(experiment.measure(**table).amplitude == 0, ends[:-1])
