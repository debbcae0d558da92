"""Base classes of studies that one call computes completely (all kinds but sweeps), and their results.

`ComputedStudy.compute` returns an `Outcome`: a table, arrays, figures, documents and lines for the terminal. Sweeps
are computed in chunks by `zwidth.sweep` instead. Tables have column names with linear units, such as
``stiffness_N_per_m``; they are converted to rotary units when the tables are written.

Symbols: alpha, beta, delta and d are normalized stiffness, virtual damping, physical damping and delay. K and B are
stiffness and virtual damping in SI units.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import WrapValidator

from zwidth import plotting
from zwidth.analysis.assessment import name_kind
from zwidth.analysis.optimization import StiffestWall
from zwidth.analysis.scene import Scene
from zwidth.config.fields import LocatedProblem, problem, require_entries
from zwidth.config.scenes import AnyDevice, AnyScene, PhysicalDevice, PhysicalScene, WallField
from zwidth.config.study import Study
from zwidth.config.values import Axis, DelayAxis, DeltaAxis
from zwidth.plotting.table import SI_COLUMNS
from zwidth.units.formatting import convert_header, round_conservatively, to_cell, with_unit
from zwidth.units.unit_system import LINEAR, UnitSystem

Item = TypeVar("Item")

# Callback that reports the progress of long studies; its arguments are the numbers of finished parts and of all parts.
LISTENER: ContextVar[Callable[[int, int], None]] = ContextVar("LISTENER", default=lambda done, total: None)


def track_progress(parts: Sequence[Item]) -> Iterator[Item]:
    """Yield the parts of a study one by one, and report the number of finished parts to the callback ``LISTENER``."""
    for done, part in enumerate(parts):
        LISTENER.get()(done, len(parts))
        yield part


@dataclass(frozen=True)
class Outcome:
    """Results of one study: data, functions that draw figures, and lines for the terminal."""

    table: dict[str, np.ndarray] = field(default_factory=dict)  # columns of the study's CSV file, all of one length
    arrays: dict[str, np.ndarray] = field(default_factory=dict)  # arrays of the study's npz file
    # Functions that draw a figure and return its Axes. The keys are the suffixes that the names of the figures' files
    # have after the name of the study.
    figures: Mapping[str, Callable[[], Any]] = field(default_factory=dict)
    documents: dict[str, str] = field(default_factory=dict)  # contents of text files, by the name of the file
    answer: tuple[str, ...] = ()  # main results, in one or two lines for a terminal
    notes: tuple[str, ...] = ()  # restrictions of the results, such as points without a result

    def write(
        self, folder: Path, name: str, system: UnitSystem = LINEAR, formats: Sequence[str] = ("png", "svg")
    ) -> None:
        """Write all files of the study, data before figures.

        Args:
            folder: existing folder for the files.
            name: name of the study, with which the names of the files begin.
            system: unit system of the columns; linear units in their names are converted to it.
            formats: file formats of the figures.
        """
        for file, text in self.documents.items():
            (folder / file).write_text(text, encoding="utf-8")
        if self.table:
            (folder / f"{name}.csv").write_text(csv_text(self.table, system), encoding="utf-8")
        if self.arrays:
            arrays = {_name_column(key, system): array for key, array in self.arrays.items()}
            np.savez_compressed(folder / f"{name}.npz", **arrays)  # pyright: ignore[reportArgumentType]
        for addition, draw in self.figures.items():
            plotting.save(draw(), folder / f"{name}{addition}", formats)


class ComputedStudy(Study):
    """Base of the kinds of studies that one call of `compute` computes completely.

    A subclass is the model of the study and computes its results. It defines a field ``kind`` with one literal, the
    fields of its configuration, `sizes` (unless those of its axes are sufficient) and `compute`, and is registered
    with the decorator `zwidth.studies.register`.
    """

    # True if `compute` uses the scene itself, and not only the values that `fill` copies from the scene into the study.
    reads_scene: ClassVar[bool] = False

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """Compute all results; figures are drawn later, by calls of the functions in `Outcome.figures`.

        Args:
            scene: scene of the file; None if the file has none.
            alone: True if the file has no other study of this kind, which allows shorter file names.
        """
        raise NotImplementedError


class CurvesStudy(ComputedStudy):
    """Base of the studies whose results are curves for each delta and d."""

    point_bytes = 32  # bytes of alpha, beta, frequency and two codes

    delta: DeltaAxis
    d: DelayAxis


def add_device_numbers(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the mapping of a study, extended by delta and d of its device unless these keys are given.

    If the device is invalid, add delta = 0 and d = 0, because the later validation of the key ``device`` reports its
    errors.
    """
    if "device" not in raw:
        return raw
    try:
        device = PhysicalDevice.model_validate(raw["device"])
    except ValueError:
        return {"delta": 0.0, "d": 0.0, **raw}
    return {"delta": device.delta, "d": device.d, **raw}


class WallsStudy(ComputedStudy):
    """Base of the studies of walls that are given explicitly or as a fraction of the maximum stiffness."""

    walls: Annotated[tuple[WallField, ...], WrapValidator(require_entries("walls"))] | None = None
    """Walls: any number for one device; for several devices, one for all or one per device. Default: that of the
    scene."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        filled = super().fill(raw, scene)
        if scene.wall is not None and not {"device", "devices", *_WALL_KEYS} & set(raw):
            filled["walls"] = [scene.wall]
        return filled

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        given = [key for key in raw if key in _WALL_KEYS]
        if len(given) == 2:
            allowed = "walls are given explicitly or as fractions of the maximum stiffness"
            message = "stiffness_fraction and walls are both given"
            yield (given[1],), problem(message, allowed, "remove one", on_key=True)
        elif not given:
            message, needed = "stiffness_fraction or walls is missing", "the study needs a wall"
            yield (), problem(message, needed, "add 'stiffness_fraction: 0.75'")


_WALL_KEYS = ("stiffness_fraction", "walls")


def add_si_columns(
    table: dict[str, np.ndarray], delta: Axis, d: Axis, owner: AnyScene | AnyDevice | None
) -> dict[str, np.ndarray]:
    """Return a table of walls, to which columns in SI units are added if delta and d are those of a rigid device.

    Args:
        table: columns, with alpha and beta of the walls among them.
        delta: values of delta of the study.
        d: values of d of the study.
        owner: scene or device. If it is normalized, has parts, or has another delta or d than the axes, or the axes
            have several values, the table is returned unchanged.
    """
    scene = _find_scene(delta, d, owner)
    if scene is None:
        return table
    stiffness, damping = scene.units
    return {**table, SI_COLUMNS[0]: table["alpha"] * stiffness, SI_COLUMNS[1]: table["beta"] * damping}


def find_device_share(delta: Axis, d: Axis, owner: AnyScene | AnyDevice | None) -> float:
    """Return the fraction of delta that belongs to the device and not to an operator with a rigid grasp.

    Passivity for any operator relies only on the damping of the device. The fraction is 1 under the conditions in
    which `add_si_columns` leaves tables unchanged.
    """
    scene = _find_scene(delta, d, owner)
    return float(scene.device_delta / scene.delta) if scene is not None and scene.delta else 1.0


def _find_scene(delta: Axis, d: Axis, owner: AnyScene | AnyDevice | None) -> Scene | None:
    """Return the scene of a rigid device in SI units if the axes contain only its delta and d, otherwise None."""
    if not isinstance(owner, PhysicalScene | PhysicalDevice) or owner.nonrigid_parts:
        return None
    alone = [axis.values().tolist() for axis in (delta, d)] == [[owner.delta], [owner.d]]
    return owner.to_scene() if alone else None


def summarize_stiffest(wall: StiffestWall) -> dict[str, Any]:
    """Return K, B, frequency and kind of a stiffest wall as a dict, keyed by the column names of a table."""
    columns = dict(zip(SI_COLUMNS, map(float, wall[:2]), strict=True))
    return {**columns, "frequency_Hz": float(wall.frequency), "kind": name_kind(wall)}


def spell_stiffest(row: Mapping[str, Any], system: UnitSystem) -> str:
    """Return a text with K_max, rounded down, and its B, with units, from a row made by `summarize_stiffest`."""
    stiffness, damping = (row[name] for name in SI_COLUMNS)
    K, B = with_unit(round_conservatively(stiffness, "below"), system["N/m"]), with_unit(damping, system["N s/m"])
    return f"K_max = {K} at B = {B}"


def _name_column(name: str, system: UnitSystem) -> str:
    """Convert the linear unit at the end of a column name to its rotary counterpart if the system is rotary."""
    return convert_header(name, system) if system.rotary else name


def csv_text(table: dict[str, np.ndarray], system: UnitSystem = LINEAR) -> str:
    """Return a table as CSV text, with all digits; cells that spreadsheets would evaluate as formulas are escaped."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([_name_column(name, system) for name in table])
    writer.writerows(zip(*(map(to_cell, column.tolist()) for column in table.values()), strict=True))
    return buffer.getvalue()
