"""What a study hands to the runner: tables, arrays, figures and texts, each to be written under the study's name."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.figure import Figure

from zwidth.figures import save

Table: TypeAlias = dict[str, np.ndarray]


@dataclass(frozen=True)
class Outcome:
    """The result of one study.

    Attributes:
        table: columns of the study's CSV file, all of one length; empty for none.
        arrays: arrays of the study's npz file; empty for none.
        figures: what draws each figure, by what its file name adds to the study's name ("" for nothing).
        documents: texts by file name.
        notes: what a reader of the results must know, such as points without an answer.
    """

    table: Table = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    documents: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def write(self, folder: Path, name: str) -> Iterator[str]:
        """Write everything, data before figures, and yield the name of each file when it is there."""
        for file, text in self.documents.items():
            (folder / file).write_text(text, encoding="utf-8")
            yield file
        if self.table:
            (folder / f"{name}.csv").write_text(csv_text(self.table), encoding="utf-8")
            yield f"{name}.csv"
        if self.arrays:
            np.savez_compressed(folder / f"{name}.npz", **self.arrays)  # pyright: ignore[reportArgumentType]
            yield f"{name}.npz"
        for addition, draw in self.figures.items():
            for file in save(draw(), folder / f"{name}{addition}"):
                yield file.name


def stack(parts: Iterable[Mapping[str, object]]) -> Table:
    """Put curves below each other: a number or text is repeated along its curve, a column that lacks is NaN."""
    blocks = []
    for part in parts:
        arrays = [np.asarray(value) for value in part.values()]
        rows = max(array.size for array in arrays)
        blocks.append({name: np.broadcast_to(array, rows) for name, array in zip(part, arrays, strict=True)})
    names = list(dict.fromkeys(name for block in blocks for name in block))
    table = {}
    for name in names:
        like = next(block[name] for block in blocks if name in block)
        absent = "" if like.dtype.kind == "U" else np.nan
        columns = [block.get(name, np.full(next(iter(block.values())).size, absent)) for block in blocks]
        table[name] = np.concatenate(columns)
    return table


def csv_text(table: Table) -> str:
    """A table as CSV; numbers are written with all digits that tell them apart."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))
    return buffer.getvalue()
