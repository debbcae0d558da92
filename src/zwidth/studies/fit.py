"""The fit study: a device's mass, damping and delay from logs, from walls that began to buzz, or from both."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, PrivateAttr, WithJsonSchema, WrapValidator
from pydantic_core import CoreSchema

from zwidth import figures
from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict, members, problem
from zwidth.config.parts import VelocityField, locate_refusal, split_refusal
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Fraction, Quantity, describe_entry, quantity_of
from zwidth.figures.table import stack
from zwidth.fitting.buzz import BuzzPoint, fit_buzz
from zwidth.fitting.columns import LoggedMotion, fit_motions, read_log, read_step
from zwidth.fitting.device_fit import DeviceFit
from zwidth.fitting.evidence import gather_evidence
from zwidth.fitting.words import detail_fit, summarize_fit, unit_of, write_scene
from zwidth.parts.velocity import BackwardDifference
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, header, plain, with_unit
from zwidth.words.quantities import OF_LOGS, POSITIVE
from zwidth.words.status import Status
from zwidth.words.unit_system import LINEAR, UnitSystem

# 95 % of chi-squared with three degrees of freedom, and of a normal distribution within so many standard deviations.
_CHANCE, _NORMAL = 7.815, 1.96


def _read_resolution(raw: Any) -> Any:
    try:
        read_step(raw)
    except InputError as error:
        raise locate_refusal(error)[1] from None
    return raw


Step = Annotated[float | str, BeforeValidator(_read_resolution), WithJsonSchema(describe_entry("m", "rad", "deg"))]


class LogSection(Strict, what="a log"):
    """One log: a file of columns and which of them is what."""

    csv: str
    """Name of the file, relative to the configuration: a text of columns, .npz, .npy or .mat."""

    time: str | None = Field(default=None, description=OF_LOGS["time"])
    position: str | None = Field(default=None, description=OF_LOGS["position"])
    force: str | None = Field(default=None, description=OF_LOGS["force"])
    resolution: Step | None = Field(default=None, description=OF_LOGS["resolution"])
    motor_constant: str | None = Field(default=None, description=OF_LOGS["motor_constant"])

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return "a log is a CSV file", "add 'csv: log.csv'"

    def read(self, period: float | None) -> LoggedMotion:
        columns = {name: getattr(self, name) for name in ("time", "position", "force")}
        options = {"resolution": self.resolution, "motor_constant": self.motor_constant}
        return read_log(find_file(self.csv), columns, period=period, **options)


def _read_logs(raw: Any, handler: Any) -> Any:
    if isinstance(raw, str):
        raise problem(f"got {describe(raw)}", "a log is a CSV file and its columns", "write {csv: NAME.csv}")
    if isinstance(raw, dict):
        return (LogSection.model_validate(raw),)
    return (raw,) if isinstance(raw, LogSection) else members("logs")(raw, handler)


class _OneOrSeveral:
    """Lets an editor's check take one entry for a list of it."""

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        several = handler(schema)
        return {"anyOf": [several["items"], several]}


class BuzzSection(Strict, what="a wall that buzzed"):
    """A wall at the onset of buzzing."""

    stiffness: Annotated[float, Quantity("N/m", POSITIVE)]
    """K in N/m or with a unit, raised at this damping until the wall buzzed."""

    virtual_damping: Annotated[float, quantity_of("virtual_damping")] = 0.0

    frequency: Annotated[float, Quantity("Hz", POSITIVE)]
    """Of the buzz, in Hz or with a unit."""


class _Fitted(NamedTuple):
    """One of the fits of a study."""

    name: str
    source: str
    fit: DeviceFit
    points: tuple[BuzzPoint, ...] = ()


@register
class FitStudy(ComputedStudy):
    """Mass, damping and delay of a device from records of it, and the walls that follow."""

    method = "Least squares with exact derivatives; the band of the boundary by 200 devices drawn from the covariance."
    from_scene = ()
    remedy_if_too_large = "shorten the logs"
    # Time, force, position, model, residual and number of the log.
    point_bytes = 48

    kind: Literal["fit"]

    log: Annotated[tuple[LogSection, ...], WrapValidator(_read_logs), _OneOrSeveral] | None = None
    """A log of free motion under a commanded force, or a list of logs of one device; give this, buzz, or both."""

    buzz: Annotated[tuple[BuzzSection, ...], WrapValidator(members("walls"))] | None = None
    """Walls at the onset of buzzing, two at least, of different dampings."""

    period: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """Sampling period T in s or with a unit; of buzzing walls alone, or of logs in place of their times."""

    noise: Fraction | None = None
    """Relative noise of stiffness and frequency of buzzing walls. Default: estimated."""

    max_delay: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """Longest delay to search for in logs, in s or with a unit. Default: 20 periods."""

    resample: bool = False
    """Whether times off by up to a quarter of a period are taken for those of a clock that wavers, samples as even."""

    velocity: VelocityField | None = None
    """Velocity estimate of the loop. Default: the difference of two samples."""

    _motions: tuple[LoggedMotion, ...] = PrivateAttr(default=())

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        if "log" not in raw and "buzz" not in raw:
            allowed = "a device is found from logs or from walls that buzzed"
            yield (), problem("log or buzz is missing", allowed, "add 'log: {csv: log.csv}'")
        elif "log" not in raw and "period" not in raw:
            yield ("period",), problem("missing", "walls that buzzed need the sampling period", "add 'period: 1 ms'")
        strange = {"noise": "buzz", "max_delay": "log", "resample": "log"}
        for name, owner in strange.items():
            if name in raw and owner not in raw:
                what = f"got {name} without {owner}"
                yield (name,), problem(what, f"it belongs to {owner}", "remove it", on_key=True)

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        motions: list[LoggedMotion] = []
        for k, section in enumerate(self.log or ()):
            try:
                motions.append(section.read(self.period if section.time is None else None))
            except InputError as error:
                # File names and headers may hold anything.
                text = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in str(error))
                path, what = locate_refusal(InputError(text))
                known = len(path) == 1 and path[0] in LogSection.model_fields
                # A single log is written without a list around it.
                place = ("log", *((k,) if len(self.log or ()) > 1 else ()))
                yield (*place, *(path if known else ("csv",))), (what if known else split_refusal(text))
        self._motions = tuple(motions)
        if any(motion.rotary for motion in motions) and self.buzz:
            what = "got walls in N/m beside a log of an angle"
            yield ("buzz",), problem(what, "both are of one axis", "fit them in two studies", on_key=True)
        for k, motion in enumerate(motions):
            if motion.rotary != motions[0].rotary or motion.resolution != motions[0].resolution:
                what = "got another axis, or another resolution, than of the first log"
                yield ("log", k), problem(what, "all logs are of one device", "fit it in a study of its own")
        for k, wall in enumerate(self.buzz or ()):
            if self.period is not None and wall.frequency * self.period >= 0.5:
                half = with_unit(0.5 / self.period, "Hz")
                what = f"got {with_unit(wall.frequency, 'Hz')}"
                allowed = f"it must lie below half the sampling rate, {half}"
                yield ("buzz", k, "frequency"), problem(what, allowed, "check the frequency, or the period")
        if self.buzz and len({wall.virtual_damping for wall in self.buzz}) < 2:
            what, remedy = "got walls of one damping alone", "add a wall of another virtual_damping"
            yield ("buzz",), problem(what, "m, b and t_d need two", remedy, on_key=True)

    @property
    def extent(self) -> str:
        parts = [f"{len(self.log)} log{'' if len(self.log) == 1 else 's'}"] if self.log else []
        return " and ".join(parts + ([f"{len(self.buzz)} walls that buzzed"] if self.buzz else []))

    @property
    def points(self) -> int:
        return sum(motion.position.size for motion in self._motions) + len(self.buzz or ())

    @property
    def unit_system(self) -> UnitSystem:
        """The linear system: the names of the columns already have the units of the fitted device."""
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
            answers += [f"fitted to {each.source}", *rows]
            notes += [f"{each.source}: {label}: {text}" for label, text in detail_fit(each.fit, each.source)[1:]]
        answers += [_compare(fits[0].fit, fits[1].fit)] if len(fits) > 1 else []
        step = next((each.fit.resolution for each in fits if each.fit.motions), 0.0)
        draw = partial(figures.draw_device_fit, **evidence, step=step)
        return Outcome(
            table=stack([_tabulate(each.fit, each.source) for each in fits]),
            figures={"": draw},
            documents=documents,
            answer=tuple(answers),
            notes=tuple(notes),
        )

    def _fit(self) -> list[_Fitted]:
        velocity, fits = BackwardDifference() if self.velocity is None else self.velocity.known, []
        period = self.period
        if self.log:
            options = {"max_delay": self.max_delay, "resample": self.resample}
            found = fit_motions(self._motions, period=period, velocity=velocity, **options)
            period = found.period
            fits.append(_Fitted("log", " and ".join(Path(section.csv).name for section in self.log), found))
        if self.buzz:
            walls = tuple(BuzzPoint(each.stiffness, each.virtual_damping, each.frequency) for each in self.buzz)
            found = fit_buzz(walls, period=period, velocity=velocity, noise=self.noise)
            fits.append(_Fitted("buzz", f"{len(walls)} buzzing walls", found, walls))
        return fits


def _tabulate(fit: DeviceFit, source: str) -> dict[str, Any]:
    """One row: every number with its standard error and its 95 % interval."""
    row: dict[str, Any] = {"fitted_to": source, "status": Status(fit.status).name}
    errors = fit.errors | {"stiffness_max": fit.stiffness_error}
    of_log = [name for name in ("friction", "offset") if name in errors]
    for name in (*fit.numbers[:3], "stiffness_max", *fit.numbers[3:], *of_log):
        ends = fit.intervals[name]
        numbers = {"": fit.value_of(name), "_error": errors[name], "_low": ends.low, "_high": ends.high}
        row |= {header(name + end, unit_of(name, fit.unit_system)): value for end, value in numbers.items()}
    return row | {header(name, unit_of(name, fit.unit_system)): getattr(fit, name) for name in ("offset", "resolution")}


def _compare(one: DeviceFit, other: DeviceFit) -> str:
    """Whether two fits of one device agree, by how far apart they are in their common covariance."""
    values = [np.array([fit.mass, fit.damping, fit.delay]) for fit in (one, other)]
    away = values[0] - values[1]
    spread = sum((fit.reach / _NORMAL) ** 2 * fit.covariance[:3, :3] for fit in (one, other))
    # Exact records would leave nothing to divide by.
    floor = (1e-9 * np.maximum(np.abs(values[0]), np.abs(values[1]))) ** 2 + 1e-300
    far = float(away @ np.linalg.solve(spread + np.diag(floor), away))
    verdict = "log and buzzing walls agree" if far <= _CHANCE else "log and buzzing walls do NOT agree"
    apart = f"squared, they are {plain(far, 3)} apart in units of their errors"
    return f"{verdict}: {apart}; 95 % of equal devices stay below {_CHANCE}"
