"""What a fit says of a device: estimates, how far they may be off, and the stiffest wall that follows."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.fitting.device_estimate import RELIABILITY, UPPER, DeviceEstimate, find_stiffest
from zwidth.fitting.hidden import HiddenResonances
from zwidth.fitting.hidden_lag import HiddenLag
from zwidth.fitting.safe_scene import limit_walls, round_scene
from zwidth.fitting.safe_wall import SafeWall, find_safe_wall
from zwidth.scenes.recommendation import Recommendation
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError
from zwidth.words.formatting import to_json, with_unit
from zwidth.words.showing import shown
from zwidth.words.status import Status

# Standard errors within which everything lies.
_FAR = 1e3
# A standard error beyond this share leaves a value open.
VAGUE = 0.5
# Standard errors below 0 that nobody takes for a delay of 0 anymore; half of a true 0's errors go below.
BEYOND = 3.0
# Sampling periods of loops, in s: outside a unit is suspected.
_QUICKEST, _SLOWEST = 5e-6, 0.02
# About a device that may be more than the model.
SEE_MORE = "play a record of zwidth.excite, push harder, or read a finer encoder"
MASS_OPEN = "the mass is hardly determined: its standard error is more than half of it"


class ErrorBar(NamedTuple):
    """An interval that holds the true value with 95 % confidence."""

    low: float
    high: float


class FurtherExperiment(NamedTuple):
    """Raise K at this damping until the wall buzzes: N s/m, the N/m and Hz expected, and K_max's error afterwards.

    That error is NaN where K_max is.
    """

    virtual_damping: float
    stiffness: float
    frequency: float
    error_afterwards: float


class FittedMotion(NamedTuple):
    """One log beside its fit, a number a sample: times in s, forces in N, positions in m.

    ``modelled`` is NaN at the first samples and behind a gap, where past forces are unknown, and behind the first
    200,000.
    """

    time: np.ndarray
    force: np.ndarray
    position: np.ndarray
    modelled: np.ndarray


class RivalDevice(NamedTuple):
    """Another device that fits equally well: parameters in kg, N s/m and s, and its K_max in N/m."""

    mass: float
    damping: float
    delay: float
    stiffness_max: float


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
@dataclass(frozen=True, kw_only=True)
class DeviceFit(DeviceEstimate):
    """A device found from records of it.

    Attributes:
        mass, damping, delay: estimates in kg, N s/m, s.
        actuator, modes: the amplifier's lag and the resonances that the records ask for, a `zwidth.Actuator` or None
            and `zwidth.Mode`; the sensor of a positive modal mass is at the motor, of a negative one beyond a node.
        errors: standard errors of the three, by name, and of the parts by their paths, as "actuator.time_constant" and
            "modes.0.frequency".
        covariance: of ``numbers``, in that order, SI units.
        stiffness_max: K_max in N/m of the estimated device, `zwidth.Scene.max_stiffness`; NaN where the status is not
            OK, unless it is UNDECIDED and the rivals have the same within the error.
        stiffness_error: its standard error, by K_max's gradient.
        noise: relative (K and f) of buzzing walls, of the position in m of a log; given, or estimated from residuals.
        residuals: measured less fitted, of buzzing walls an array (n, 2) in units of the noise of K and f, of a log in
            m, NaN where samples are left out.
        doubts: what is odd about the records or about the estimate, a sentence each; then there is no safe wall.
        notes: interpretations of the columns of a log and repairs of its rows, one clause each.
        status: of `zwidth.Status`: UNDECIDED where another device fits as well, or where a log shows more than the
            model has.
        rivals: those devices, a `zwidth.RivalDevice` each.
        next: the further experiment that reduces the error of K_max most; None for a log.
        offset, friction: constant force beside the commanded one and Coulomb friction, in N, of a log; their errors in
            ``errors_of_log`` and ``errors``, NaN where the log leaves open how much is of which.
        resolution: step of the encoder in m that a log was fitted with; 0 of buzzing walls, and where there is none.
        motions: of a log, each with its fit, a `zwidth.FittedMotion`.
        scene: the fitted loop, a `zwidth.Scene` with the safe limit of its walls. Its parameters are rounded to a
            thousandth of their standard errors, as `zwidth fit --yaml` writes them.
        nominal, period, velocity: the fitted loop before rounding and without the safe limit, its sampling period in s
            and its velocity estimate.
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

    residuals: np.ndarray
    doubts: tuple[str, ...]
    status: int
    next: FurtherExperiment | None = None
    offset: float = 0.0
    friction: float = 0.0
    resolution: float = 0.0
    motions: tuple[FittedMotion, ...] = ()
    rivals: tuple[RivalDevice, ...] = ()
    lag: HiddenLag | None = None
    hidden: HiddenResonances | None = None
    errors_of_log: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @cached_property
    def errors(self) -> dict[str, float]:
        """Standard errors by name."""
        own = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.numbers, own, strict=True)) | self.errors_of_log

    @cached_property
    def _stiffest(self) -> tuple[float, float]:
        """K_max and its standard error; NaN where the device that bears it is another one, or may be."""
        value, gradient = find_stiffest(self.nominal)
        error = float(np.sqrt(gradient @ self.covariance @ gradient))
        agreed = bool(self.rivals) and all(abs(one.stiffness_max - value) <= error for one in self.rivals)
        known = self.status == Status.OK or (self.status == Status.UNDECIDED and agreed)
        return (value, error) if known else (np.nan, np.nan)

    @property
    def stiffness_max(self) -> float:
        """In N/m."""
        return self._stiffest[0]

    @property
    def stiffness_error(self) -> float:
        """In N/m."""
        return self._stiffest[1]

    @property
    def is_doubted(self) -> bool:
        """Whether there is a doubt or a status: then no safe wall and no wall to set is given.

        What a record shows beyond the model moved K_max up to 2.8 times, and most often where something was doubted.
        """
        return self.status != Status.OK or bool(self.doubts)

    @cached_property
    def scene(self) -> Scene:
        """The fitted scene with rounded parameters and the safe limit of its walls."""
        return replace(round_scene(self), safe_limit=limit_walls(self))

    @cached_property
    def recommended(self) -> Recommendation:
        """The recommended wall: ``scene.recommend()`` with the default margins."""
        return self.scene.recommend()

    @cached_property
    def virtual_damping(self) -> float:
        """B in N s/m of the stiffest stable wall; NaN where ``stiffness_max`` is."""
        return float(self.nominal.max_stiffness().virtual_damping) if self.stiffness_max > 0 else np.nan

    @cached_property
    def virtual_damping_error(self) -> float:
        """Standard error of that B, by differences along the axes of the covariance."""
        if not np.isfinite(self.virtual_damping + self.covariance.sum()):
            return np.nan
        return float(np.sqrt(np.sum(self.differ(lambda scene: scene.max_stiffness().virtual_damping) ** 2)))

    def value_of(self, name: str) -> float:
        """What ``errors`` names: an attribute of the fit, or a parameter of a part by its path."""
        return float(self.nominal.parameters()[name] if "." in name else getattr(self, name))

    @cached_property
    def intervals(self) -> dict[str, ErrorBar]:
        """95 % intervals by name: of what ``errors`` has, and of "stiffness_max", with ``hidden`` and up to ``lag``.

        Where K_max has more damping than the walls that buzzed, it reaches down to what buzzed at the most of them.
        """
        reaches = {name: (self.value_of(name), self.reach * error) for name, error in self.errors.items()}
        signed = [name for name in reaches if name == "offset" or (name.startswith("modes") and name.endswith("mass"))]
        # A NaN stays one; a constant force and the mass of a mode may be negative.
        bars = {
            name: ErrorBar(float(value - far if name in signed else np.maximum(0.0, value - far)), value + far)
            for name, (value, far) in reaches.items()
        }
        stiffness = self.stiffness_max
        with np.errstate(all="ignore"):
            # By its logarithm: K_max falls ever less as the delay grows, and near a delay of 0 it is many times more.
            error = np.divide(self.stiffness_error, stiffness)
            ends = np.array([-self.reach, self.reach]) * error
            if self.hidden is not None and error > 0:
                ends = self._average(error, *self.hidden)
            # What is printed beside the interval lies in it, also where most devices have another K_max.
            low, high = (stiffness * np.exp([min(ends[0], 0.0), max(ends[1], 0.0)])).tolist()
        if self.damping_tried is not None and self.virtual_damping > self.damping_tried:
            # Beyond the dampings tried K_max is what the model says; it is at least what buzzed there.
            low = min(low, self.bear_tried(UPPER))
        if self.lag is not None:
            high += max(self.lag.stiffness_max - stiffness, 0.0)
        return bars | {"stiffness_max": ErrorBar(low, high)}

    def _average(self, error: float, odds: float, ratios: np.ndarray) -> list[float]:
        """The interval of ln K_max, from that of the device, with a hidden resonance or none."""
        from scipy.optimize import brentq
        from scipy.special import stdtr

        middles = np.log(np.append(ratios, 1.0))
        weights = np.append(np.full(ratios.size, odds / ratios.size), 1.0) / (1.0 + odds)
        far = np.abs(middles).max() + _FAR * error

        def exceed(away: float, share: float) -> float:
            return float(weights @ stdtr(self.freedom, (away - middles) / error)) - share

        return [
            float(brentq(exceed, -far, far, args=(0.5 + side * (UPPER - 0.5),)))  # pyright: ignore[reportArgumentType]  (a number unless asked)
            for side in (-1.0, 1.0)
        ]

    def safe_wall(self, reliability: float = RELIABILITY, *, rigid: bool = False) -> SafeWall:
        """Find the stiffest wall that is stable on nearly all devices that agree with the records.

        The devices are random, distributed around the estimate. The wall and all softer walls with the same B are
        stable on the required proportion of them, because users raise K from below. For a log, the wall is also stable
        with every single resonance that may be undetected. For walls at the onset of instability, B is at most the
        largest measured one, because undetected resonances may destabilize any wall of larger B.

        Args:
            reliability: required proportion of devices, at least 0.5 and below 1.
            rigid: assume that the device has no undetected resonances. Many devices have resonances of 50 to 300 Hz,
                and a wall that such a resonance makes unstable may be far softer than K_max of the rigid mass.

        Returns:
            SafeWall: ``stiffness`` K in N/m and ``virtual_damping`` B in N s/m, both 0 if no wall is stable on so many
            devices; ``share``, the proportion of the random devices on which the wall is stable by their poles;
            ``status``: that of the fit, or UNDECIDED if the fit has warnings, the poles do not confirm the wall, or
            almost no random device is possible; all numbers are NaN unless it is OK; ``resonance``, the frequency in Hz
            of the undetected resonance that limits the wall, NaN if none does.

        Raises:
            InputError: an invalid reliability.

        Numerics:
            8,000 devices, 1,000 with a velocity filter, or 400 with an actuator lag or resonances. ln m, b and t_d are
            normal with the covariance of the fit, or have Student's t distribution if the noise was estimated; devices
            with negative values are replaced. The random numbers are reproducible. Rigid devices: closed form, K to
            0.1 %, in about 0.1 s; for 69 fits with 20,000 other devices each, the wall was stable on 98.5 to 99.2 % of
            them, and a wall 2 % stiffer on at most 91.4 % for any B. With a velocity filter: boundaries on a grid of
            frequencies, checked by eigenvalues, in a few seconds. Undetected resonances, one at a time with damping
            ratios from 0.005: by the radius of ``response``, from the residuals plus four standard errors, with the
            theory of `zwidth.MeasuredDevice`.

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
        if isinstance(reliability, bool | str) or not 0.5 <= reliability < 1:
            raise InputError(f"reliability: got {reliability!r}; a share from 0.5 to below 1 is needed, as 0.99")
        asked = reliability, rigid
        if asked not in self._safe_walls:
            open_status = self.status if self.status != Status.OK else int(Status.UNDECIDED)
            none = SafeWall(np.nan, np.nan, np.nan, open_status)
            self._safe_walls[asked] = none if self.is_doubted else find_safe_wall(self, *asked)
        return self._safe_walls[asked]

    @cached_property
    def _safe_walls(self) -> dict[tuple[float, bool], SafeWall]:
        """Those that were asked for."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON; None for what is NaN."""
        numbers = {
            **dict(zip(self.numbers, self.estimates.tolist(), strict=True)),
            "stiffness_max": self.stiffness_max,
            "virtual_damping": self.virtual_damping,
            "errors": self.errors
            | {"stiffness_max": self.stiffness_error, "virtual_damping": self.virtual_damping_error},
            "intervals": self.intervals,
            "covariance": self.covariance.tolist(),
            "noise": self.noise,
            **{name: getattr(self, name) for name in ("offset", "friction", "resolution", "period", "doubts", "notes")},
            "status": int(self.status),
            "rivals": [rival._asdict() for rival in self.rivals],
            "next": None if self.next is None else self.next._asdict(),
            "safe_wall": self.safe_wall()._asdict(),
            "safe_limit": asdict(self.scene.safe_limit) if self.scene.safe_limit else None,
            "recommended": self._spell_recommended(),
            "lag": None if self.lag is None else self.lag._asdict(),
        }
        return to_json(numbers)

    def _spell_recommended(self) -> dict[str, Any]:
        """Return the recommended wall as numbers and texts for JSON."""
        recommended = self.recommended
        margins = ("gain_margin", "phase_margin", "delay_margin")
        return {
            **{name: getattr(recommended, name) for name in ("stiffness", "virtual_damping", "limited_by", "reason")},
            **{name: getattr(recommended.verdict, name, None) for name in margins},
            "status": int(recommended.status),
            "cautions": list(recommended.cautions),
        }


def doubt_period(period: float) -> list[str]:
    if _QUICKEST <= period <= _SLOWEST:
        return []
    slip = "in ms or us" if period > _SLOWEST else "in s"
    return [
        f"a sampling period of {with_unit(period, 's')} is far from any loop; the time may be {slip}: check its unit"
    ]
