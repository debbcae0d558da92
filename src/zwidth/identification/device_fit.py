"""Result of a fit: the estimated device with confidence intervals, its maximum stiffness K_max, and safe walls.

K and B are the stiffness and damping of a wall. All confidence intervals have the level 95 %. The interval of K_max is
computed for ln K_max, to first order in the errors of the parameters. For a log, it also includes the effects of
undetected resonances, by Bayesian model averaging, and of an undetected actuator lag
(`zwidth.identification.unmodeled_dynamics`, docs/theory/hidden.md).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.recommendation import Recommendation
from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.device_estimate import RELIABILITY, UPPER, DeviceEstimate, differentiate_stiffness_max
from zwidth.identification.safe_scene import limit_walls, round_scene
from zwidth.identification.safe_wall import SafeWall, find_safe_wall
from zwidth.identification.unmodeled_dynamics import HiddenResonances
from zwidth.identification.unmodeled_lag import HiddenLag
from zwidth.units.display import compact_repr
from zwidth.units.formatting import to_json, with_unit

_FAR = 1e3  # half-width of the initial bracket in the root search for a quantile of ln K_max, in standard errors
VAGUE = 0.5  # relative standard error of a parameter above which a warning is issued
# The fitted delay is restricted to nonnegative values. A warning is issued if its unrestricted estimate is this many
# standard errors below 0, because noise does not explain such an estimate.
BEYOND = 3.0

# Usual range of sampling periods in s. A period outside this range causes a warning, because its unit may be wrong.
_SHORTEST_PERIOD = 5e-6
_LONGEST_PERIOD = 0.02
# Remedy printed with a warning that the log cannot distinguish two structures of the device, such as a lag and a
# resonance.
SEE_MORE = "record a force of zwidth.excite, use a larger force, or a finer encoder"
MASS_OPEN = "the mass is hardly determined: its standard error is more than half of its value"


class ErrorBar(NamedTuple):
    """A 95 % confidence interval of a parameter or of K_max."""

    low: float
    high: float


class NextMeasurement(NamedTuple):
    """The proposed next measurement: raise K at the given B until the wall becomes unstable."""

    virtual_damping: float  # B at which to raise K, N s/m
    stiffness: float  # expected K at the onset of instability, N/m
    frequency: float  # expected frequency of the oscillation, Hz
    stiffness_error: float  # expected standard error of K_max after this measurement, N/m; NaN if K_max is NaN


class FittedMotion(NamedTuple):
    """A log together with the positions of the fitted model, as arrays with one entry per sample."""

    time: np.ndarray  # time of each sample, s
    force: np.ndarray  # commanded force, N
    position: np.ndarray  # measured position, m
    # Modeled position in m. It is NaN at the start and after gaps, because the forces that act there were not logged,
    # and beyond the first 200,000 samples, because later samples are not fitted.
    modeled: np.ndarray


class AlternativeDevice(NamedTuple):
    """Another device that fits equally well: its mass in kg, damping in N s/m, delay in s, and K_max in N/m."""

    mass: float
    damping: float
    delay: float
    stiffness_max: float


@compact_repr(
    ("mass", "damping", "delay", "stiffness_max", "stiffness_error", "friction", "status", "warnings"),
    missing=dict.fromkeys(("stiffness_max", "stiffness_error"), "see status and warnings"),
    mass="kg",
    damping="N s/m",
    delay="s",
    stiffness_max="N/m",
    stiffness_error="N/m",
    friction="N",
)
@dataclass(frozen=True, kw_only=True)
class DeviceFit(DeviceEstimate):
    """The result of a fit of a device to measurements: a log, or walls at the onset of instability.

    For a rotary device the units are rad, N m and kg m² in place of m, N and kg.

    Attributes:
        mass, damping, delay: estimates in kg, N s/m, s.
        actuator, modes: the actuator lag and the resonances that the measurements require: a `zwidth.Actuator` or None,
            and `zwidth.Mode`. A negative modal mass means that actuator and sensor are on opposite sides of a node.
        errors: standard errors by name: of mass, damping and delay, and of the other parameters by their paths, such
            as "actuator.time_constant" and "modes.0.frequency".
        parameter_names: paths of the fitted parameters.
        covariance: covariance of the parameters in the order of ``parameter_names``, in SI units.
        stiffness_max: K_max in N/m of the estimated device, `zwidth.Scene.max_stiffness`; NaN if the status is not OK,
            except for UNDECIDED if the alternatives have the same K_max within its error.
        stiffness_error: standard error of K_max, from its gradient in the parameters.
        noise: standard deviation of the noise, given or estimated from the residuals: for walls those of K and of the
            frequency f, relative; for a log that of the position in m.
        residuals: measured minus fitted values: for walls an array (n, 2) in units of the noise of K and f; for a log
            in m, NaN for samples that are not fitted.
        warnings: sentences about questionable measurements or estimates. With a warning there is no safe wall.
        notes: interpretations of the columns of a log and repairs of its rows, one clause each.
        status: code of `zwidth.Status`; UNDECIDED if another device fits equally well, or if the residuals of a log are
            not white noise.
        alternatives: other devices that fit equally well, each a `zwidth.AlternativeDevice`.
        next: for walls, the further measurement that reduces the error of K_max most; otherwise None.
        offset, friction: for a log, constant force in addition to the commanded one, and Coulomb friction, in N. Their
            errors, in ``force_errors`` and ``errors``, are NaN if the log does not distinguish the two forces.
        resolution: encoder step in m with which a log was fitted; 0 without an encoder step, and for walls.
        motions: for a log, the measured and fitted positions, `zwidth.FittedMotion`.
        scene: `zwidth.Scene` of the fitted device, with the safe limit of its walls. Its parameters are rounded to a
            thousandth of their standard errors, as `zwidth fit --yaml` writes them.
        nominal, period, velocity: the scene before rounding and without the safe limit, its sampling period in s and
            its velocity estimate.
        response: for a log, the frequency response of the estimated device, a `zwidth.MeasuredDevice`. Its deviation
            covers every resonance with a damping ratio of at least 0.005 that may be undetected in the log. None for
            walls, for a log without noise, and if the residuals cause a warning.
        lag: for a log, ``(time_constant, delay, stiffness_max)`` in s and N/m for the longest actuator lag that the log
            does not distinguish from a delay. The interval of K_max extends to the K_max with this lag. None if
            ``response`` is None, or if the log excludes every lag.
        hidden: for a log, ``(odds, stiffness_max)``: the posterior odds of one undetected resonance against none, and
            equally likely values of K_max with such a resonance, relative to K_max without. The interval of K_max
            averages over these values. None if ``response`` is None.
        measured_damping, measured_stiffness: for walls, the largest measured B in N s/m, and the K in N/m measured
            there; None for a log.
        degrees_of_freedom: degrees of freedom with which the noise was estimated; None if the noise is given.
    """

    residuals: np.ndarray
    warnings: tuple[str, ...]
    status: int
    next: NextMeasurement | None = None
    offset: float = 0.0
    friction: float = 0.0
    resolution: float = 0.0
    motions: tuple[FittedMotion, ...] = ()
    alternatives: tuple[AlternativeDevice, ...] = ()
    lag: HiddenLag | None = None
    hidden: HiddenResonances | None = None
    force_errors: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @cached_property
    def errors(self) -> dict[str, float]:
        """The standard errors of the fitted parameters and forces as a dictionary, by name or path."""
        errors = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.parameter_names, errors, strict=True)) | self.force_errors

    @cached_property
    def _stiffest(self) -> tuple[float, float]:
        """K_max and its standard error; both NaN if an equally well fitting device has a clearly different K_max."""
        value, gradient = differentiate_stiffness_max(self.nominal)
        error = float(np.sqrt(gradient @ self.covariance @ gradient))
        agreed = bool(self.alternatives) and all(abs(each.stiffness_max - value) <= error for each in self.alternatives)
        is_determined = self.status == Status.OK or (self.status == Status.UNDECIDED and agreed)
        return (value, error) if is_determined else (np.nan, np.nan)

    @property
    def stiffness_max(self) -> float:
        """K_max of the estimated device, in N/m; NaN if the measurements do not determine it."""
        return self._stiffest[0]

    @property
    def stiffness_error(self) -> float:
        """The standard error of K_max, in N/m."""
        return self._stiffest[1]

    @property
    def is_unreliable(self) -> bool:
        """True if the fit has a warning or its status is not OK; then no wall is recommended.

        In simulations, dynamics that the model lacks changed K_max by a factor of up to 2.8, mostly in fits with
        warnings.
        """
        return self.status != Status.OK or bool(self.warnings)

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
        """B in N s/m of the stiffest stable wall; NaN if ``stiffness_max`` is NaN."""
        return float(self.nominal.max_stiffness().virtual_damping) if self.stiffness_max > 0 else np.nan

    @cached_property
    def virtual_damping_error(self) -> float:
        """The standard error of ``virtual_damping`` in N s/m, propagated from the parameters by finite differences."""
        if not np.isfinite(self.virtual_damping + self.covariance.sum()):
            return np.nan
        return float(np.sqrt(np.sum(self.propagate_errors(lambda scene: scene.max_stiffness().virtual_damping) ** 2)))

    def value_of(self, name: str) -> float:
        """Return the fitted value whose standard error is ``errors[name]``: an attribute or a device parameter."""
        return float(self.nominal.parameters()[name] if "." in name else getattr(self, name))

    @cached_property
    def intervals(self) -> dict[str, ErrorBar]:
        """The 95 % confidence intervals by name: of all values in ``errors`` and of "stiffness_max".

        The interval of K_max includes the effects of ``hidden`` and ``lag``. If the B at K_max exceeds all measured B,
        the interval also includes the K measured at the largest B.
        """
        widths = {name: (self.value_of(name), self.coverage_factor * error) for name, error in self.errors.items()}
        # Cut off the intervals at 0, except those of constant forces and modal masses, because only these may be
        # negative.
        signed = [name for name in widths if name == "offset" or (name.startswith("modes") and name.endswith("mass"))]
        # Use np.maximum instead of max, because it returns NaN if the width is NaN.
        bars = {
            name: ErrorBar(float(value - width if name in signed else np.maximum(0.0, value - width)), value + width)
            for name, (value, width) in widths.items()
        }
        stiffness = self.stiffness_max
        with np.errstate(all="ignore"):
            # Compute the interval of ln K_max, because K_max is a strongly nonlinear function of the delay near 0.
            error = np.divide(self.stiffness_error, stiffness)
            ends = np.array([-self.coverage_factor, self.coverage_factor]) * error
            if self.hidden is not None and error > 0:
                ends = self._average_models(error, *self.hidden)
            # Extend the interval to the estimate itself, which lies outside if most devices with an undetected
            # resonance have another K_max.
            low, high = (stiffness * np.exp([min(ends[0], 0.0), max(ends[1], 0.0)])).tolist()
        if self.measured_damping is not None and self.virtual_damping > self.measured_damping:
            # K_max is extrapolated to a B beyond the measured ones. The only certain statement is that it is at least
            # the measured K, so extend the interval down to the lower confidence limit of this K.
            low = min(low, self.bound_measured_stiffness(UPPER))
        if self.lag is not None:
            high += max(self.lag.stiffness_max - stiffness, 0.0)
        return bars | {"stiffness_max": ErrorBar(low, high)}

    def _average_models(self, error: float, odds: float, ratios: np.ndarray) -> list[float]:
        """Compute the 95 % interval of ln(K_max/estimate) by Bayesian averaging of models with and without a resonance.

        The distribution is a mixture of t distributions, one for each sampled resonance and one without a resonance.

        Args:
            error: standard error of ln K_max, equal for all models.
            odds: posterior odds of an undetected resonance.
            ratios: K_max with a resonance, relative to K_max without.
        """
        from scipy.optimize import brentq
        from scipy.special import stdtr

        middles = np.log(np.append(ratios, 1.0))
        weights = np.append(np.full(ratios.size, odds / ratios.size), 1.0) / (1.0 + odds)
        far = np.abs(middles).max() + _FAR * error

        def exceed(value: float, probability: float) -> float:
            return float(weights @ stdtr(self.degrees_of_freedom, (value - middles) / error)) - probability

        return [
            float(brentq(exceed, -far, far, args=(0.5 + side * (UPPER - 0.5),)))  # pyright: ignore[reportArgumentType]  (a number by default)
            for side in (-1.0, 1.0)
        ]

    def safe_wall(self, reliability: float = RELIABILITY, *, rigid: bool = False) -> SafeWall:
        """Find the stiffest wall that is stable on nearly all devices that agree with the records.

        Random devices are drawn from the distribution of the estimate. On the required proportion of them the wall is
        stable, and so are all softer walls with the same B, because users raise K from below. For a log, the wall is
        also stable with every single resonance that may be undetected. For a fit to walls at the onset of instability,
        B is at most the largest measured B, because undetected resonances may destabilize any wall with a larger B.

        Args:
            reliability: required proportion of devices, at least 0.5 and below 1.
            rigid: assume that the device has no undetected resonances. Many devices have resonances of 50 to 300 Hz,
                which can make walls unstable that are far softer than K_max of the rigid mass.

        Returns:
            SafeWall: ``stiffness`` K in N/m and ``virtual_damping`` B in N s/m, both 0 if no wall is stable on enough
            devices; ``share``, the proportion of the random devices on which the wall is stable according to the poles;
            ``status``: that of the fit, or UNDECIDED if the fit has warnings, if the poles do not confirm the wall, or
            if almost all random devices have negative parameters; all numbers are NaN unless the status is OK;
            ``resonance``, the frequency in Hz of the undetected resonance that limits the wall, NaN if none does.

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
            >>> walls = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
            >>> fit = zwidth.fit_buzz(walls, period="1 ms", noise=0.02)
            >>> wall = fit.safe_wall()
            >>> print(f"{wall.stiffness / 1e3:.1f} of {fit.stiffness_max / 1e3:.1f} kN/m")
            18.8 of 19.9 kN/m
        """
        if isinstance(reliability, bool | str) or not 0.5 <= reliability < 1:
            raise InputError(f"reliability: got {reliability!r}; give a share of at least 0.5 and below 1, as 0.99")
        options = reliability, rigid
        if options not in self._safe_walls:
            status = self.status if self.status != Status.OK else int(Status.UNDECIDED)
            none = SafeWall(np.nan, np.nan, np.nan, status)
            self._safe_walls[options] = none if self.is_unreliable else find_safe_wall(self, *options)
        return self._safe_walls[options]

    @cached_property
    def _safe_walls(self) -> dict[tuple[float, bool], SafeWall]:
        """Cache of the safe walls already computed, with the arguments of ``safe_wall`` as keys."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary of plain numbers and texts for JSON, with None in place of NaN."""
        numbers = {
            **dict(zip(self.parameter_names, self.estimates.tolist(), strict=True)),
            "stiffness_max": self.stiffness_max,
            "virtual_damping": self.virtual_damping,
            "errors": self.errors
            | {"stiffness_max": self.stiffness_error, "virtual_damping": self.virtual_damping_error},
            "intervals": self.intervals,
            "covariance": self.covariance.tolist(),
            "noise": self.noise,
            **{
                name: getattr(self, name)
                for name in ("offset", "friction", "resolution", "period", "warnings", "notes")
            },
            "status": int(self.status),
            "alternatives": [each._asdict() for each in self.alternatives],
            "next": None if self.next is None else self.next._asdict(),
            "safe_wall": self.safe_wall()._asdict(),
            "safe_limit": asdict(self.scene.safe_limit) if self.scene.safe_limit else None,
            "recommended": self._spell_recommended(),
            "lag": None if self.lag is None else self.lag._asdict(),
        }
        return to_json(numbers)

    def _spell_recommended(self) -> dict[str, Any]:
        """Return the recommended wall as a dictionary of plain numbers and texts for JSON."""
        recommended = self.recommended
        margins = ("gain_margin", "phase_margin", "delay_margin")
        return {
            **{name: getattr(recommended, name) for name in ("stiffness", "virtual_damping", "limited_by", "reason")},
            **{name: getattr(recommended.verdict, name, None) for name in margins},
            "status": int(recommended.status),
            "cautions": list(recommended.cautions),
        }


def check_period_unit(period: float) -> list[str]:
    """Return a list with a warning if the sampling period probably has a wrong unit; otherwise an empty list."""
    if _SHORTEST_PERIOD <= period <= _LONGEST_PERIOD:
        return []
    unit = "in ms or us" if period > _LONGEST_PERIOD else "in s"
    return [f"a sampling period of {with_unit(period, 's')} is unusual; the time may be {unit}: check its unit"]
