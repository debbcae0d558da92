"""Study of the environments in which admittance displays are stable.

A display is a robot that moves like a virtual mass M with virtual damping D. The environment, e.g. a hand, is a spring
K and a damper B between the robot and ground. The study computes the largest stable K over grids of M, D and delay, and
the stable values of M for given hands.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import Field, WrapValidator

from zwidth import plotting
from zwidth.analysis.admittance import AdmittanceDisplay
from zwidth.config.devices import Rotary, SystemSection, find_second_period, read_period, read_rotary
from zwidth.config.fields import LocatedProblem, problem
from zwidth.config.parts import ActuatorSection, PartSection, parse_message
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Axis, AxisOf, Quantity, axis_of, quantity_of
from zwidth.core.errors import InputError
from zwidth.core.status import note_failures
from zwidth.model.checks import Span
from zwidth.model.system_forms import parse_system
from zwidth.model.timing import Timing
from zwidth.plotting.table import SI_COLUMNS, stack
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text, track_progress
from zwidth.units.formatting import describe, format_interval, round_conservatively, short, with_unit
from zwidth.units.quantities import NOT_NEGATIVE, POSITIVE


def _read_robot(raw: Any) -> Any:
    """Return the model of the robot, a lag or a linear system, from a mapping or a text."""
    if isinstance(raw, ActuatorSection | SystemSection):
        return raw
    if isinstance(raw, str) and ("/" in raw or raw.startswith("sos:")):
        try:
            raw = parse_system("robot", raw, "s")
        except InputError as error:
            # Remove the prefix "robot: ", because the report already contains the key "robot".
            raise parse_message(str(error).removeprefix("robot: ")) from None
    if not isinstance(raw, dict):
        allowed = "a robot is a lag or a linear system from commanded to actual motion"
        raise problem(f"got {describe(raw)}", allowed, "write {time_constant: 20 ms} or '400 / 1 28 400'")
    is_lag = raw.keys() & ActuatorSection.model_fields.keys() or not raw
    return (ActuatorSection if is_lag else SystemSection).model_validate(raw)


# List ``str`` only for the JSON Schema, because `_read_robot` converts a text to a linear system.
_Robot = Annotated[ActuatorSection | SystemSection | str, WrapValidator(lambda raw, _: _read_robot(raw))]
_Mass = Annotated[Axis, AxisOf(Quantity("kg", POSITIVE))]
_Damping = Annotated[Axis, AxisOf(Quantity("N s/m", NOT_NEGATIVE))]
_Stiffness = Annotated[Axis, AxisOf(Quantity("N/m", POSITIVE))]
_COLUMNS = ("virtual_mass_kg", "virtual_damping_N_s_per_m", "environment_damping_N_s_per_m")


@register
class AdmittanceStudy(ComputedStudy):
    """The largest stable stiffness of the environment of an admittance display, over virtual mass and damping."""

    method = "Roots of a real polynomial in the cosine of the angle (W5), to about 1e-12."
    from_scene = ("period", "delay")

    kind: Literal["admittance"]

    virtual_mass: _Mass
    """Virtual mass M, in kg or with a unit."""

    virtual_damping: _Damping
    """Virtual damping D, in N s/m or with a unit."""

    robot: _Robot
    """Model of the robot from commanded to actual motion: a lag such as {time_constant: 20 ms} or {cutoff: 10 Hz,
    order: 2}, or a linear system ('400 / 1 28 400' in s, or a mapping)."""

    rate: Annotated[float, quantity_of("rate")] | None = Field(default=None, exclude=True)
    period: Annotated[float, quantity_of("period"), WrapValidator(read_period)] = Field(
        default=None, validate_default=True
    )
    delay: Annotated[Axis, axis_of("delay")]
    """Delay from the measurement of a force until the command computed from it acts on the robot: in s, with a unit, or
    in sampling periods."""

    command: Literal["position", "velocity"] = "position"
    """Kind of command that the program sends to the robot."""

    integrator: Literal["semi-implicit", "trapezoidal"] = "semi-implicit"
    """Method that integrates the motion of the virtual mass."""

    environment_damping: _Damping | None = None
    """Damping B of the environment, in N s/m or with a unit. Default: 0."""

    hand_stiffness: _Stiffness | None = None
    """Stiffnesses K of hands or environments, in N/m or with a unit. For each, the study also computes the stable
    virtual masses. Default: none."""

    rotary: Rotary = Field(default_factory=read_rotary)
    """True for rotary displays. One quantity with a rotary unit makes all devices of a file rotary."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        filled = super().fill(raw, scene)
        if isinstance(delay := filled.get("delay"), Span):
            filled["delay"] = Axis("number", (delay.value,), 1, delay.unit == "periods")
        return filled

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        yield from super().find_conflicts(raw)

    @property
    def sizes(self) -> dict[str, int]:
        sizes = {name: getattr(self, name).size for name in ("delay", "virtual_damping", "virtual_mass")}
        return {"environment_damping": self._dampers.size, **sizes}

    @property
    def _dampers(self) -> np.ndarray:
        """Values of the damping B of the environment in N s/m."""
        return np.zeros(1) if self.environment_damping is None else self.environment_damping.values()

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        try:
            # Check all delays of a robot in z, because they must be integers; for other robots, one delay is enough.
            sampled = getattr(self.robot, "sampled", None)
            for delay in self.delay.values()[: None if sampled else 1].tolist():
                loop = self._make_display(delay).loop
                loop.make_system()
                loop.check_damper(max(self._dampers))
        except InputError as error:
            field, _, text = str(error).partition(": ")
            field = field if field in type(self).model_fields else "robot"
            yield (field,), parse_message(text)

    def _make_display(self, delay: float) -> AdmittanceDisplay:
        """Return the display with the first M and D of the study; ``delay`` is in s or periods, as in the study."""
        units, span = self.unit_system, Span(delay, "periods" if self.delay.in_periods else "s")
        # Pass texts with units, because the display derives its kind, linear or rotary, from them.
        mass = f"{float(self.virtual_mass.values()[0])!r} {units['kg']}"
        damping = f"{float(self.virtual_damping.values()[0])!r} {units['N s/m']}"
        timing, robot = Timing(self.period, span), cast(PartSection, self.robot).instance
        return AdmittanceDisplay(mass, damping, robot, timing, self.command, self.integrator)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        M, D, B = self.virtual_mass.values(), self.virtual_damping.values(), self._dampers
        grid = np.meshgrid(B, D, M, indexing="ij")
        parts, hands = [], []
        for delay in track_progress(self.delay.values().tolist()):
            display = self._make_display(delay)
            limits = display.max_environment_stiffness(grid[0], virtual_mass=grid[2], virtual_damping=grid[1])
            columns = dict(zip(_COLUMNS, (grid[2].ravel(), grid[1].ravel(), grid[0].ravel()), strict=True))
            d = float(display.timing.d)
            columns |= {SI_COLUMNS[0]: limits.stiffness.ravel(), "frequency_Hz": limits.frequency.ravel()}
            parts.append({"delay_periods": d, **columns, "status": limits.status.ravel()})
            hands += self._find_masses(display, d)
        table = stack(parts)
        status = table.pop("status").astype(int)
        figures = {"": partial(plotting.draw_environment_limits, table)} if max(M.size, D.size) > 1 else {}
        documents = {f"{self.name}_masses.csv": csv_text(stack(hands), self.unit_system)} if hands else {}
        answer = self._spell_limits(table)
        notes = note_failures(np.bincount(status), "displays")
        return Outcome(
            table, figures=figures, documents=documents, answer=answer + self._spell_masses(hands), notes=notes
        )

    def _find_masses(self, display: AdmittanceDisplay, d: float) -> list[dict[str, float]]:
        """Return the smallest and largest stable M for each D, B and hand; ``d`` is the delay in periods."""
        rows = []
        stiffness = [] if self.hand_stiffness is None else self.hand_stiffness.values().tolist()
        dampings = self.virtual_damping.values().tolist(), self._dampers.tolist()
        for D, B, K in product(*dampings, stiffness):
            mass = replace(display, virtual_damping=D).min_virtual_mass(K, B)
            row = {"delay_periods": d, _COLUMNS[1]: D, _COLUMNS[2]: B, "hand_stiffness_N_per_m": K}
            rows.append(row | {"virtual_mass_min_kg": mass.virtual_mass, "virtual_mass_max_kg": mass.largest})
        return rows

    def _spell_limits(self, table: dict[str, np.ndarray]) -> tuple[str, ...]:
        """Return the printed line with the smallest and the largest K limit of all displays in the table."""
        stiffness = table[SI_COLUMNS[0]]
        if not np.isfinite(stiffness).any():
            return ("no display is stable in any environment",)
        ends = dict.fromkeys((int(np.nanargmin(stiffness)), int(np.nanargmax(stiffness))))
        texts = [self._spell_row(table, k) for k in ends]
        return (f"stable up to {' and '.join(texts)}",)

    def _spell_row(self, table: dict[str, np.ndarray], k: int) -> str:
        """Return a phrase with the K limit in row ``k`` of the table and the parameters of this display."""
        units = self.unit_system
        K = with_unit(round_conservatively(float(table[SI_COLUMNS[0]][k]), "below"), units["N/m"])
        names = zip(
            ("virtual_mass", "virtual_damping", "environment_damping"),
            "MDB",
            _COLUMNS,
            ("kg", "N s/m", "N s/m"),
            strict=True,
        )
        words = [
            f"{letter} = {with_unit(float(table[column][k]), units[unit])}"
            for name, letter, column, unit in names
            if name != "environment_damping" or self.sizes[name] > 1 or table[column][k]
        ]
        words += [f"delay {short(table['delay_periods'][k])} periods"] if self.sizes["delay"] > 1 else []
        return f"K = {K} with {', '.join(words)}"

    def _spell_masses(self, rows: list[dict[str, float]]) -> tuple[str, ...]:
        """Return the printed line with the stable M for the first hand; an empty tuple if the study has no hands."""
        if not rows:
            return ()
        row, units = rows[0], self.unit_system
        low, high = row["virtual_mass_min_kg"], row["virtual_mass_max_kg"]
        stiffness, damping = row["hand_stiffness_N_per_m"], row[_COLUMNS[1]]
        hand = f"a hand of {with_unit(stiffness, units['N/m'])} at D = {with_unit(damping, units['N s/m'])}"
        if np.isnan(low):
            return (f"no M is stable in {hand}",)
        if np.isinf(high):
            return (f"M from {with_unit(round_conservatively(low, 'above'), units['kg'])} in {hand}",)
        return (f"M from {' to '.join(format_interval(low, high, units['kg']))} in {hand}",)
