"""What a fit says of a device: estimates, how far they may be off, and the stiffest wall that follows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.fitting.fit_records import ErrorBar, FittedMotion, FurtherExperiment, RivalDevice
from zwidth.fitting.scenes import name_numbers, scene_of
from zwidth.parts.actuator import Actuator
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.mode import Mode
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import Velocity
from zwidth.scenes.scene import Scene
from zwidth.words.formatting import to_json
from zwidth.words.showing import shown
from zwidth.words.status import Status

if TYPE_CHECKING:
    from zwidth.fitting.hidden import HiddenLag, HiddenResonances
    from zwidth.fitting.safe_wall import SafeWall

NAMES = ("mass", "damping", "delay")
# Of the upper ends of intervals of 95 %.
_UPPER = 0.975
# Standard errors within which everything lies.
_FAR = 1e3
# Of standard errors, for differences.
_STEP = 0.1
# A standard error beyond this share leaves a value open.
VAGUE = 0.5
# Standard errors below 0 that nobody takes for a delay of 0 anymore; half of a true 0's errors go below.
BEYOND = 3.0
# Of the usual safe wall.
_RELIABILITY = 0.99
MASS_OPEN = "the mass is hardly determined: its standard error is more than half of it"


@shown(
    ("mass", "damping", "delay", "stiffness_max", "stiffness_error", "friction", "status", "doubts"),
    missing=dict.fromkeys(("stiffness_max", "stiffness_error"), "see status and doubts"),
    mass="kg",
    damping="N s/m",
    delay="s",
    stiffness_max="N/m",
    stiffness_error="N/m",
    friction="N",
)
@dataclass(frozen=True)
class DeviceFit:
    """A device found from records of it.

    Attributes:
        mass, damping, delay: estimates in kg, N s/m, s.
        actuator, modes: the amplifier's lag and the resonances that the records ask for, a `zwidth.Actuator` or None
            and `zwidth.Mode`; the sensor of a positive modal mass is at the motor, of a negative one beyond a node.
        errors: standard errors of the three, by name, of "cutoff" where that was unknown, and of the parts by their
            paths, as "actuator.time_constant" and "modes.0.frequency".
        covariance: of ``numbers``, in that order, SI units.
        stiffness_max: K_max in N/m of the estimated device, `zwidth.Scene.max_stiffness`; NaN where the status is not
            OK, unless it is UNDECIDED and the rivals have the same within the error.
        stiffness_error: its standard error, by K_max's gradient.
        noise: relative (K and f) of buzzing walls, of the position in m of a log; given, or estimated from residuals.
        residuals: measured less fitted, of buzzing walls an array (n, 2) in units of the noise of K and f, of a log in
            m, NaN where samples are left out.
        doubts: what is odd about the records or about the estimate, a sentence each; then there is no safe wall.
        status: of `zwidth.Status`: UNDECIDED where another device fits as well, or where a log shows more than the
            model has.
        rivals: those devices, a `zwidth.RivalDevice` each.
        next: the further experiment that narrows K_max most, or tells the device from a rival of another kind; None of
            a log.
        offset: constant force in N beside the commanded one, of a log; its error in ``errors``.
        friction: Coulomb friction in N, of a log; its error in ``errors``, NaN where the log leaves it open.
        resolution: step of the encoder in m that a log was fitted with; 0 of buzzing walls, and where there is none.
        motions: of a log, each with its fit, a `zwidth.FittedMotion`.
        period, velocity: of the loop; the velocity with the cut-off found where that was unknown.
        response: of a log, a `zwidth.MeasuredDevice`: the response of the estimated device, with the radius by which a
            resonance of a damping ratio of 0.005 or more may move it and not show in the log. None of buzzing walls, of
            a log without noise, and under a doubt of what the fit leaves.
        lag: of a log, ``(time_constant, delay, stiffness_max)`` of the longest lag of an amplifier that it does not
            tell from a delay, in s and N/m; the interval of K_max reaches there. None as ``response``, and where none
            is so.
        hidden: of a log, ``(odds, stiffness_max)``: how likely the device has a resonance more than the log asks for
            against none, and K_max with such ones over that without, all equally likely; the interval of K_max is that
            of all these devices. None as ``response``.
        damping_tried, stiffness_tried: of walls that buzzed, the largest B among them, in N s/m, and the K in N/m that
            buzzed there; None of a log.
        freedom: degrees of freedom that the noise was estimated with; None where it is known.
    """

    mass: float
    damping: float
    delay: float
    errors: dict[str, float]
    covariance: np.ndarray
    stiffness_max: float
    stiffness_error: float
    noise: float | tuple[float, float]
    residuals: np.ndarray
    doubts: tuple[str, ...]
    status: int
    next: FurtherExperiment | None
    offset: float
    friction: float
    resolution: float
    motions: tuple[FittedMotion, ...]
    period: float
    velocity: Velocity
    freedom: int | None = None
    rivals: tuple[RivalDevice, ...] = ()
    response: MeasuredDevice | None = None
    actuator: Actuator | None = None
    modes: tuple[Mode, ...] = ()
    lag: HiddenLag | None = None
    hidden: HiddenResonances | None = None
    damping_tried: float | None = None
    stiffness_tried: float | None = None

    @property
    def numbers(self) -> tuple[str, ...]:
        """Paths of what was fitted, in the order of the covariance: mass, damping, delay, and what more there is."""
        return name_numbers(self.scene, "cutoff" in self.errors)

    @property
    def is_doubted(self) -> bool:
        """Whether there is a doubt or a status: then no safe wall and no wall to set is given.

        What a record shows beyond the model moved K_max up to 2.8 times, and most often where something was doubted.
        """
        return self.status != Status.OK or bool(self.doubts)

    @property
    def reach(self) -> float:
        """How many standard errors the intervals reach."""
        return reach_of(self.freedom)

    @property
    def cutoff(self) -> float | None:
        """Of the velocity estimate, in Hz; None where it has none."""
        return getattr(self.velocity, "cutoff", None)

    @cached_property
    def scene(self) -> Scene:
        """The estimated device with its timing and velocity estimate."""
        scene = scene_of((self.mass, self.damping, self.delay), self.period, self.velocity)
        return replace(scene, device=replace(scene.device, actuator=self.actuator, modes=self.modes))

    @cached_property
    def responding(self) -> Scene | None:
        """The same loop with the response in place of the device: what holds for every resonance within its radius.

        Of a device with an amplifier or resonances, the radius has what their numbers may be, too.
        """
        return self.respond(_RELIABILITY, True)

    def respond(self, reliability: float, hidden: bool) -> Scene | None:
        """The loop of the response; within its radius are so many devices that the log allows, and what it may hide.

        None without a response, and where the numbers are too open for a radius.
        """
        from scipy.special import fdtri

        known = self.response
        if known is None:
            return None
        radius = known.deviation if hidden else 0.0 * known.deviation
        if self.is_structured:
            changes = self.differ(lambda scene: scene.frequency_response(1.0, 0.0, known.frequency))
            # The longer axis of the ellipse in which the response lies with the numbers.
            square, across = np.sum(np.abs(changes) ** 2, 0), np.abs(np.sum(changes**2, 0))
            count = len(self.numbers)
            reach = count * fdtri(count, self.freedom, reliability)
            radius = radius + np.sqrt(0.5 * (square + across) * reach)
        if not np.all(np.isfinite(radius)):
            return None
        device = MeasuredDevice(known.frequency, known.response, radius)
        return Scene(device, Timing(self.period), velocity=self.velocity)

    @property
    def is_structured(self) -> bool:
        """Whether it is more than a rigid mass: by an amplifier, or by resonances."""
        return self.actuator is not None or bool(self.modes)

    @cached_property
    def virtual_damping(self) -> float:
        """B in N s/m of the stiffest stable wall; NaN where ``stiffness_max`` is."""
        return float(self.scene.max_stiffness().virtual_damping) if self.stiffness_max > 0 else np.nan

    @cached_property
    def virtual_damping_error(self) -> float:
        """Standard error of that B, by differences along the axes of the covariance."""
        if not np.isfinite(self.virtual_damping + self.covariance.sum()):
            return np.nan
        return float(np.sqrt(np.sum(self.differ(lambda scene: scene.max_stiffness().virtual_damping) ** 2)))

    def differ(self, ask: Callable[[Scene], Any]) -> np.ndarray:
        """By how much an answer changes along each axis of the covariance, one standard deviation far: a row each."""
        values, errors = self.estimates, np.sqrt(np.diag(self.covariance))
        scales = np.where(errors > 0, errors, 1.0)
        sizes, axes = np.linalg.eigh(self.covariance / np.outer(scales, scales))
        middle, rows = ask(self.scene), []
        for size, axis in zip(sizes, axes.T, strict=True):
            step = _STEP * np.sqrt(max(size, 0.0)) * axis * scales
            # Where damping or delay would be negative, to one side.
            sides = [side for side in (-1.0, 1.0) if np.all((values + side * step) * np.where(values < 0, -1, 1) >= 0)]
            ends = [ask(self.vary(values + side * step)) for side in sides]
            if len(sides) == 1:
                sides, ends = [0.0, *sides], [middle, *ends]
            change = (ends[-1] - ends[0]) / (_STEP * (sides[-1] - sides[0])) if sides else np.nan * middle
            rows.append(change)
        return np.array(rows)

    def value_of(self, name: str) -> float:
        """What ``errors`` names: an attribute of the fit, or a parameter of a part by its path."""
        return float(self.scene.parameters()[name] if "." in name else getattr(self, name))

    @cached_property
    def estimates(self) -> np.ndarray:
        """The values of ``numbers``."""
        own = self.scene.parameters()
        return np.array([own[name] for name in self.numbers])

    def vary(self, values: Iterable[float]) -> Scene:
        """The scene with other values of ``numbers``."""
        return self.scene.replace(**dict(zip(self.numbers, map(float, values), strict=True)))

    @property
    def intervals(self) -> dict[str, ErrorBar]:
        """95 % intervals by name: of what ``errors`` has, and of "stiffness_max", with ``hidden`` and up to ``lag``.

        Where K_max has more damping than the walls that buzzed, it reaches down to what buzzed at the most of them.
        """
        errors = self.errors | {"stiffness_max": self.stiffness_error}
        reaches = {name: (self.value_of(name), self.reach * error) for name, error in errors.items()}
        # A NaN stays one; a constant force and the mass of a mode may be negative.
        bars = {
            name: ErrorBar(float(value - far if _may_be_negative(name) else np.maximum(0.0, value - far)), value + far)
            for name, (value, far) in reaches.items()
        }
        if self.hidden is not None and self.stiffness_error > 0:
            bar = self._average(*self.hidden)
            # What is printed beside the interval lies in it, also where most devices have another K_max.
            bars["stiffness_max"] = ErrorBar(min(bar.low, self.stiffness_max), max(bar.high, self.stiffness_max))
        if self.damping_tried is not None and self.virtual_damping > self.damping_tried:
            # Beyond the dampings tried K_max is what the model says; it is at least what buzzed there.
            bar, tried = bars["stiffness_max"], self.bear_tried(_UPPER)
            bars["stiffness_max"] = ErrorBar(min(bar.low, tried), bar.high)
        if self.lag is not None:
            bar, more = bars["stiffness_max"], self.lag.stiffness_max - self.stiffness_max
            bars["stiffness_max"] = ErrorBar(bar.low, bar.high + max(more, 0.0))
        return bars

    def bear_tried(self, confidence: float) -> float:
        """What the K that buzzed at the largest damping tried is at least, by its noise."""
        noise = self.noise[0] if isinstance(self.noise, tuple) else 0.0
        return max(0.0, (self.stiffness_tried or 0.0) * (1.0 - reach_of(self.freedom, confidence) * noise))

    def _average(self, odds: float, ratios: np.ndarray) -> ErrorBar:
        """The interval of K_max over the device without a hidden resonance and those with one."""
        from scipy.optimize import brentq
        from scipy.special import stdtr

        middles = self.stiffness_max * np.append(ratios, 1.0)
        weights = np.append(np.full(ratios.size, odds / ratios.size), 1.0) / (1.0 + odds)
        far = middles.max() + _FAR * self.stiffness_error

        def exceed(stiffness: float, share: float) -> float:
            return float(weights @ stdtr(self.freedom, (stiffness - middles) / self.stiffness_error)) - share

        low, high = (
            float(brentq(exceed, -far, far, args=(0.5 + side * (_UPPER - 0.5),)))  # pyright: ignore[reportArgumentType]  (a number unless asked)
            for side in (-1.0, 1.0)
        )
        return ErrorBar(max(0.0, low), high)

    def safe_wall(
        self, reliability: float = 0.99, *, samples: int | None = None, seed: int = 0, rigid: bool = False
    ) -> SafeWall:
        """Find the stiffest wall that nearly all devices bear that the records allow.

        Devices are drawn around the estimate; K is the largest for which there is one B that this share of them bears,
        at K and at every softer wall of that B, for a person raises K from below. Of a log, the wall bears every
        resonance too that may be in the device and not show in the log. Of walls that buzzed, B is at most the largest
        that was tried: beyond, a resonance that none of them shows may shake any wall.

        Args:
            reliability: the share, between 0.5 and 1.
            samples: how many devices are drawn, 100 to 100,000; left out, 8,000, 1,000 with a velocity filter, or 400
                with an amplifier or resonances.
            seed: of the draws; equal seeds give equal walls.
            rigid: whether the device is known to be a rigid mass. Many have resonances of 50 to 300 Hz; a wall that one
                makes unstable may be far softer than the stiffest one of the mass.

        Returns:
            SafeWall: ``stiffness`` K in N/m and ``virtual_damping`` B in N s/m; ``share``, of the drawn devices that
            bear it, counted by their poles' verdicts; ``status``, with NaN where it is not OK: that of the fit, or
            UNDECIDED under a doubt, where the verdicts do not confirm the wall, or where hardly a drawn device is
            possible; ``resonance``, the frequency in Hz of the hidden one that bounds it, NaN where none does. K is 0,
            and B with it, where no wall is borne by so many.

        Raises:
            InputError: a share, a number of samples or a seed that there cannot be.

        Numerics:
            ln m, b, t_d (and 1/cutoff) normal with the fit's covariance, or Student's t where the noise was estimated;
            draws of negative ones are drawn again. A rigid device: rows and columns in closed form, K to 0.1 %, in
            about 0.1 s; of 20,000 other devices of 69 fits each, 98.5 to 99.2 % bore it, and of 2 % more stiffness at
            most 91.4 % at any B. With a filter, and of walls with an amplifier or a resonance: boundaries on a grid of
            frequencies, judged by eigenvalues, in some seconds. Hidden resonances, one at a time with damping ratios
            from 0.005 on, by ``response`` and its radius: what the residuals show of each and four standard errors, as
            `zwidth.MeasuredDevice` decides.

        References:
            Hulin, Preusche, Hirzinger 2006, section V (the stable set). Kotz, Nadarajah 2004 (the t distribution).

        Example:
            >>> import zwidth
            >>> heard = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
            >>> fit = zwidth.fit_buzz(heard, period="1 ms", noise=0.02)
            >>> wall = fit.safe_wall()
            >>> print(f"{wall.stiffness / 1e3:.1f} of {fit.stiffness_max / 1e3:.1f} kN/m")
            18.8 of 19.9 kN/m
        """
        from zwidth.fitting.safe_wall import find_safe_wall

        asked = (reliability, samples, seed, rigid)
        return self._usual_safe_wall if asked == (0.99, None, 0, False) else find_safe_wall(self, *asked)

    @cached_property
    def _usual_safe_wall(self) -> SafeWall:
        from zwidth.fitting.safe_wall import find_safe_wall

        return find_safe_wall(self, 0.99, None, 0, False)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON; None for what is NaN."""
        numbers = {
            **{name.removeprefix("velocity."): value for name, value in zip(self.numbers, self.estimates, strict=True)},
            "stiffness_max": self.stiffness_max,
            "virtual_damping": self.virtual_damping,
            "errors": self.errors
            | {"stiffness_max": self.stiffness_error, "virtual_damping": self.virtual_damping_error},
            "intervals": {name: list(bar) for name, bar in self.intervals.items()},
            "covariance": self.covariance.tolist(),
            "noise": list(self.noise) if isinstance(self.noise, tuple) else self.noise,
            "offset": self.offset,
            "friction": self.friction,
            "resolution": self.resolution,
            "period": self.period,
            "doubts": list(self.doubts),
            "status": int(self.status),
            "rivals": [rival._asdict() for rival in self.rivals],
            "next": None if self.next is None else self.next._asdict(),
            "safe_wall": self.safe_wall()._asdict(),
            "lag": None if self.lag is None else self.lag._asdict(),
        }
        return to_json(numbers)


def _may_be_negative(name: str) -> bool:
    return name == "offset" or (name.startswith("modes") and name.endswith("mass"))


def reach_of(freedom: int | None, upper: float = _UPPER) -> float:
    """Standard errors to a side: of a known noise, or of one estimated with so many degrees of freedom."""
    from scipy.special import ndtri, stdtrit

    return float(ndtri(upper) if freedom is None else stdtrit(freedom, upper))
