"""Study "fit": mass, damping and delay of a device from logs of its motion, from walls at the onset, or from both.

The walls are at the onset of instability ("buzz"). Fits to logs and to walls are computed separately
(`zwidth.identification`); if both are given, a chi-squared test compares their parameters. The study writes a table of
the fitted parameters, tables that show the quality of the fits (such as residuals and stability boundaries), and a
scene file for each fit.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, PrivateAttr, WithJsonSchema, WrapValidator
from pydantic_core import CoreSchema

from zwidth import plotting
from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict, problem, require_entries
from zwidth.config.parts import VelocityField, parse_input_error, parse_message
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Fraction, Quantity, describe_entry, quantity_of
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.columns import LoggedMotion, fit_motions, read_log, read_step
from zwidth.identification.device_fit import DeviceFit
from zwidth.identification.diagnostics import gather_evidence
from zwidth.identification.fit_report import detail_fit, summarize_fit, unit_of, write_scene
from zwidth.identification.onset_fit import BuzzPoint, fit_buzz
from zwidth.model.velocity import BackwardDifference
from zwidth.plotting.table import stack
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text
from zwidth.units.formatting import describe, header, plain, with_unit
from zwidth.units.log_columns import OF_LOGS
from zwidth.units.quantities import POSITIVE
from zwidth.units.unit_system import LINEAR, UnitSystem

_CHI_SQUARED_95 = 7.815  # 95 % quantile of chi-squared with three degrees of freedom
_NORMAL_95 = 1.96  # standard deviations; half-width of the 95 % interval of a normal distribution


def _read_resolution(raw: Any) -> Any:
    """Return the encoder step unchanged; raise a problem if it is invalid."""
    try:
        read_step(raw)
    except InputError as error:
        raise parse_input_error(error)[1] from None
    return raw


Step = Annotated[float | str, BeforeValidator(_read_resolution), WithJsonSchema(describe_entry("m", "rad", "deg"))]


class LogSection(Strict, noun="a log"):
    """Log of a motion: a file, and the columns of time, position and force."""

    csv: str
    """Name of the file, relative to the configuration: a text file with columns, .npz, .npy or .mat."""

    time: str | None = Field(default=None, description=OF_LOGS["time"])
    position: str | None = Field(default=None, description=OF_LOGS["position"])
    force: str | None = Field(default=None, description=OF_LOGS["force"])
    resolution: Step | None = Field(default=None, description=OF_LOGS["resolution"])
    motor_constant: str | None = Field(default=None, description=OF_LOGS["motor_constant"])

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        return "a log is a CSV file", "add 'csv: log.csv'"

    def read(self, period: float | None) -> LoggedMotion:
        """Read the file and return the logged motion; ``period`` in s, if given, replaces the times of the log."""
        columns = {name: getattr(self, name) for name in ("time", "position", "force")}
        options = {"resolution": self.resolution, "motor_constant": self.motor_constant}
        return read_log(find_file(self.csv), columns, period=period, **options)


def _read_logs(raw: Any, handler: Any) -> Any:
    """Validate the key ``log``, one log or a list of logs, and return a tuple of `LogSection`."""
    if isinstance(raw, str):
        raise problem(f"got {describe(raw)}", "a log is a CSV file and its columns", "write {csv: NAME.csv}")
    if isinstance(raw, dict):
        return (LogSection.model_validate(raw),)
    return (raw,) if isinstance(raw, LogSection) else require_entries("logs")(raw, handler)


class _OneOrSeveral:
    """Annotation by which the JSON Schema of a list also accepts a single entry without a list."""

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        several = handler(schema)
        return {"anyOf": [several["items"], several]}


class BuzzSection(Strict, noun="a wall at the onset of instability"):
    """A wall at the onset of instability."""

    stiffness: Annotated[float, Quantity("N/m", POSITIVE)]
    """Stiffness K at which the wall became unstable at this virtual damping, in N/m or with a unit."""

    virtual_damping: Annotated[float, quantity_of("virtual_damping")] = 0.0

    frequency: Annotated[float, Quantity("Hz", POSITIVE)]
    """Frequency of the oscillation, in Hz or with a unit."""


class _Fitted(NamedTuple):
    """Fit of a study to its logs or to its walls, with a name and the source of the data."""

    name: str  # "log" or "buzz", part of file names
    source: str  # description of the data
    fit: DeviceFit
    points: tuple[BuzzPoint, ...] = ()  # walls at the onset of instability, if the fit is to walls


@register
class FitStudy(ComputedStudy):
    """The mass, damping and delay of a device, fitted to logs or to walls at the onset of instability."""

    method = "Least squares with exact derivatives; the band of the boundary by 200 devices drawn from the covariance."
    from_scene = ()
    remedy_if_too_large = "shorten the logs"
    point_bytes = 48  # bytes of time, force, position, model, residual and number of the log

    kind: Literal["fit"]

    log: Annotated[tuple[LogSection, ...], WrapValidator(_read_logs), _OneOrSeveral] | None = None
    """Log of free motion under a commanded force, or a list of logs of one device. Default: none; log, buzz or both are
    required."""

    buzz: Annotated[tuple[BuzzSection, ...], WrapValidator(require_entries("walls"))] | None = None
    """Walls at the onset of instability, at least two with different virtual dampings. Default: none."""

    period: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """Sampling period T in s or with a unit; required without a log. Default: from the times of the log."""

    noise: Fraction | None = None
    """Relative standard deviation of stiffness and frequency of the walls in buzz. Default: estimated."""

    max_delay: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """Longest delay in the search, for logs, in s or with a unit. Default: 20 periods."""

    resample: bool = False
    """True to accept timestamp jitter of up to a quarter of a period and assume uniform sampling, for logs."""

    velocity: VelocityField | None = None
    """Velocity estimate of the loop. Default: the difference of two samples."""

    _motions: tuple[LoggedMotion, ...] = PrivateAttr(default=())

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        if "log" not in raw and "buzz" not in raw:
            allowed = "a fit needs logs, or walls at the onset of instability"
            yield (), problem("log or buzz is missing", allowed, "add 'log: {csv: log.csv}'")
        elif "log" not in raw and "period" not in raw:
            yield ("period",), problem("missing", "a fit without a log needs the period", "add 'period: 1 ms'")
        strange = {"noise": "buzz", "max_delay": "log", "resample": "log"}
        for name, owner in strange.items():
            if name in raw and owner not in raw:
                message = f"got {name} without {owner}"
                yield (name,), problem(message, f"it belongs to {owner}", "remove it", on_key=True)

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        motions: list[LoggedMotion] = []
        for k, section in enumerate(self.log or ()):
            try:
                motions.append(section.read(self.period if section.time is None else None))
            except InputError as error:
                # Escape unprintable characters, because the message may contain a file name or header with line breaks.
                text = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in str(error))
                path, message = parse_input_error(InputError(text))
                is_key = len(path) == 1 and path[0] in LogSection.model_fields
                # Omit the index from the path if the study has only one log, because a single log may be written
                # without a list.
                place = ("log", *((k,) if len(self.log or ()) > 1 else ()))
                yield (*place, *(path if is_key else ("csv",))), (message if is_key else parse_message(text))
        self._motions = tuple(motions)
        if any(motion.rotary for motion in motions) and self.buzz:
            message = "got walls in N/m and a log of an angle"
            yield ("buzz",), problem(message, "both must be of one axis", "fit them in two studies", on_key=True)
        for k, motion in enumerate(motions):
            if motion.rotary != motions[0].rotary or motion.resolution != motions[0].resolution:
                message = "got another axis or encoder step than in the first log"
                yield ("log", k), problem(message, "all logs are of one device", "fit this log in a separate study")
        for k, wall in enumerate(self.buzz or ()):
            if self.period is not None and wall.frequency * self.period >= 0.5:
                nyquist = with_unit(0.5 / self.period, "Hz")
                message = f"got {with_unit(wall.frequency, 'Hz')}"
                allowed = f"it must be below the Nyquist frequency, {nyquist}"
                yield ("buzz", k, "frequency"), problem(message, allowed, "check the frequency, or the period")
        if self.buzz and len({wall.virtual_damping for wall in self.buzz}) < 2:
            message, remedy = "got walls of only one virtual_damping", "add a wall with another one"
            yield ("buzz",), problem(message, "m, b and t_d need two", remedy, on_key=True)

    @property
    def extent(self) -> str:
        parts = [f"{len(self.log)} log{'' if len(self.log) == 1 else 's'}"] if self.log else []
        return " and ".join(parts + ([f"{len(self.buzz)} onsets of instability"] if self.buzz else []))

    @property
    def points(self) -> int:
        return sum(motion.position.size for motion in self._motions) + len(self.buzz or ())

    @property
    def unit_system(self) -> UnitSystem:
        """Unit system of linear devices, because the columns already have the units of the device."""
        return LINEAR

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        fits = self._fit()
        gathered = [gather_evidence(each.fit, each.source, each.points) for each in fits]
        below = {name: stack([tables[name] for tables in gathered]) for name in ("boundary", "walls")}
        evidence = {**gathered[0], **below}
        documents = {f"{self.name}_{name}.csv": csv_text(table) for name, table in evidence.items()}
        for each in fits:
            middle = f"_{each.name}" if len(fits) > 1 else ""
            text = "\n".join(write_scene(each.fit, each.source, period_given=self.period is not None))
            documents[f"{self.name}{middle}_scene.yaml"] = text + "\n"
        answers, notes = [], []
        for each in fits:
            rows = [f"{label}: {text}" if label else text for label, text in summarize_fit(each.fit) if text]
            answers += [f"data: {each.source}", *rows]
            notes += [f"{each.source}: {label}: {text}" for label, text in detail_fit(each.fit, each.source)[1:]]
        answers += [_compare(fits[0].fit, fits[1].fit)] if len(fits) > 1 else []
        step = next((each.fit.resolution for each in fits if each.fit.motions), 0.0)
        draw = partial(plotting.draw_device_fit, **evidence, step=step)
        return Outcome(
            table=stack([_tabulate(each.fit, each.source) for each in fits]),
            figures={"": draw},
            documents=documents,
            answer=tuple(answers),
            notes=tuple(notes),
        )

    def _fit(self) -> list[_Fitted]:
        """Fit the device to the logs and, separately, to the walls, if they are given; return all fits."""
        velocity, fits = BackwardDifference() if self.velocity is None else self.velocity.instance, []
        period = self.period
        if self.log:
            options = {"max_delay": self.max_delay, "resample": self.resample}
            fit = fit_motions(self._motions, period=period, velocity=velocity, **options)
            period = fit.period
            fits.append(_Fitted("log", " and ".join(Path(section.csv).name for section in self.log), fit))
        if self.buzz:
            walls = tuple(BuzzPoint(each.stiffness, each.virtual_damping, each.frequency) for each in self.buzz)
            fit = fit_buzz(walls, period=period, velocity=velocity, noise=self.noise)
            fits.append(_Fitted("buzz", f"{len(walls)} onsets of instability", fit, walls))
        return fits


def _tabulate(fit: DeviceFit, source: str) -> dict[str, Any]:
    """Return a row of the table: each parameter of a fit with its standard error and 95 % confidence interval."""
    row: dict[str, Any] = {"fitted_to": source, "status": Status(fit.status).name}
    errors = fit.errors | {"stiffness_max": fit.stiffness_error}
    log_parameters = [name for name in ("friction", "offset") if name in errors]
    for name in (*fit.parameter_names[:3], "stiffness_max", *fit.parameter_names[3:], *log_parameters):
        ends = fit.intervals[name]
        numbers = {"": fit.value_of(name), "_error": errors[name], "_low": ends.low, "_high": ends.high}
        row |= {header(name + end, unit_of(name, fit.unit_system)): value for end, value in numbers.items()}
    return row | {header(name, unit_of(name, fit.unit_system)): getattr(fit, name) for name in ("offset", "resolution")}


def _compare(one: DeviceFit, other: DeviceFit) -> str:
    """Return a line of text that states whether two fits of one device agree, by a chi-squared test.

    The statistic is e' C^-1 e, with the difference e of mass, damping and delay between the fits, and the sum C of
    their covariances.
    """
    values = [np.array([fit.mass, fit.damping, fit.delay]) for fit in (one, other)]
    difference = values[0] - values[1]
    covariance = sum((fit.coverage_factor / _NORMAL_95) ** 2 * fit.covariance[:3, :3] for fit in (one, other))
    # Add a small value to the variances, because they are 0 for data without noise, and the matrix would be singular.
    floor = (1e-9 * np.maximum(np.abs(values[0]), np.abs(values[1]))) ** 2 + 1e-300
    statistic = float(difference @ np.linalg.solve(covariance + np.diag(floor), difference))
    verdict = "log and onsets agree" if statistic <= _CHI_SQUARED_95 else "log and onsets do NOT agree"
    distance = f"chi-squared = {plain(statistic, 3)}"
    return f"{verdict}: {distance} (95 % quantile {_CHI_SQUARED_95})"
