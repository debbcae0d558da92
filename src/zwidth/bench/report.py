"""The results as JSON, Markdown and a picture, and the table that `zwidth.accuracy` reads."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from zwidth.bench.suite import FILTER, NO_BETA, NO_DELTA, Row

_FIELDS = ("quantity", "method", "dtype", "layout", "d", "first_seconds", "rate", "error")
_TITLES = {
    "stable": "Stable or not",
    "spectral_radius": "Spectral radius",
    "alpha_max": "The stiffest stable wall",
}
REFERENCE = "np.linalg.eigvals"
# Measured to show what a part of a method costs; nothing to choose.
_PARTS = (FILTER, NO_BETA, NO_DELTA)


def environment() -> dict[str, Any]:
    """What the numbers depend on beside the code."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        **{name: version(name) for name in ("zwidth", "jax", "numpy")},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def document(rows: Sequence[Row]) -> dict[str, Any]:
    """Everything that was measured."""
    return {"environment": environment(), "rows": [row.as_dict() for row in rows]}


def costs(rows: Sequence[Row]) -> dict[str, Any]:
    """The table of `zwidth.accuracy`: of several sizes of one map the largest counts."""
    kept: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        if row.baseline or row.method in _PARTS or row.quantity == "alpha_max":
            continue
        key = (row.quantity, row.method, row.dtype, row.layout, row.d)
        if key not in kept:
            kept[key] = row
    entries = [{name: getattr(row, name) for name in _FIELDS} for row in kept.values()]
    rounded = [
        {name: float(f"{value:.3g}") if isinstance(value, float) else value for name, value in entry.items()}
        for entry in entries
    ]
    return {"environment": environment(), "costs": rounded}


def markdown(rows: Sequence[Row]) -> str:
    """Tables for people: speeds as multiples of batched NumPy eigenvalues in the same run."""
    here = environment()
    lines = [
        f"Measured in one run on {here['cores']} cores ({here['processor']}) with JAX {here['jax']} and NumPy",
        f"{here['numpy']}. Times faster: points a second over those of batched `np.linalg.eigvals` at the same delay.",
        "First call: what it takes longer, compilation above all. Errors are those against ball arithmetic, on walls",
        "1e-15 to 1e-3 from the boundary: of a label, the largest relative distance in alpha from the boundary at",
        "which one was wrong; of a number, the largest relative one.",
        "",
    ]
    lines += _questions(rows)
    reference = {row.d: row.rate for row in rows if row.method == REFERENCE}
    for quantity, title in _TITLES.items():
        lines += [
            f"### {title}",
            "",
            "| d | method | layout | points | points/s | times faster | first call | worst error |",
        ]
        lines += ["|--:|---|---|--:|--:|--:|--:|--:|"]
        for row in rows:
            if row.quantity != quantity:
                continue
            name = f"**{row.method}**" if not row.baseline else row.method
            kind = f"{name} {row.dtype}" if row.dtype != "float64" else name
            faster = f"{row.rate / reference[row.d]:,.3g}" if row.d in reference else ""
            lines.append(
                f"| {row.d:g} | {kind} | {row.layout} | {row.points:,} | {_rate(row.rate)} | {faster} "
                f"| {row.first_seconds:.2g} s | {_error(row)} |"
            )
        lines.append("")
    return "\n".join(lines)


# What may be asked of a map, from the least to the most, and what answers it.
_QUESTIONS = {
    "stable or not": ("stable", "boundary", "map"),
    "stable or not, each label proved": ("stable", "certified", "map"),
    "the largest pole, to 1e-9, proved": ("spectral_radius", "newton", "map"),
    "all poles": ("spectral_radius", "companion", "map"),
    "all poles, beta = 0": ("spectral_radius", NO_BETA, "map"),
    "all poles, delta = 0": ("spectral_radius", NO_DELTA, "map"),
    "the stiffest wall of as many devices": ("alpha_max", "newton", "scattered"),
}


def _questions(rows: Sequence[Row]) -> list[str]:
    """What is saved by asking for no more than is needed: time of a million points."""
    delays = sorted({row.d for row in rows})
    lines = ["### What each question costs", "", "Seconds for a million points, compilation apart.", ""]
    lines += [f"| question | {' | '.join(f'd = {d:g}' for d in delays)} |", "|---|" + "--:|" * len(delays)]
    for question, key in _QUESTIONS.items():
        cells = []
        for d in delays:
            rates = [row.rate for row in rows if (row.quantity, row.method, row.layout) == key and row.d == d]
            cells.append(f"{1e6 / rates[0]:.2g}" if rates else "")
        lines.append(f"| {question} | {' | '.join(cells)} |")
    left = max((row.open for row in rows if row.method == FILTER), default=0.0)
    return [*lines, "", f"Proof: the filter alone leaves at most {100 * left:.2g} % of a map (alpha > 0) to balls.", ""]


def summary(rows: Sequence[Row]) -> str:
    """The few lines that say most: each method at one delay, as plain text."""
    references = {row.d: row.rate for row in rows if row.method == REFERENCE}
    d = 4.0 if 4.0 in references else min(references)
    reference = references[d]
    lines = [f"{'at d = ' + format(d, 'g'):28}{'layout':>11}{'points/s':>12}{'times faster':>14}{'worst error':>14}"]
    seen = set()
    for row in rows:
        key = (row.quantity, row.method, row.dtype, row.layout)
        if row.d != d or key in seen or row.method in _PARTS:
            continue
        seen.add(key)
        name = f"{row.quantity} {row.method}" if not row.baseline else row.method
        name += " f32" if row.dtype == "float32" else ""
        lines.append(
            f"{name:28}{row.layout:>11}{_rate(row.rate):>12}{format(row.rate / reference, ',.3g'):>14}{_error(row):>14}"
        )
    return "\n".join(lines) + "\n"


def _rate(rate: float) -> str:
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if rate >= size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g}"


def _error(row: Row) -> str:
    return f"{row.error:.1e}" if row.error else f"none of {row.checked:,}"


def write(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write ``bench.json``, ``bench.md``, ``summary.txt`` and ``pareto.png`` into a folder."""
    from zwidth.figures import pareto

    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "bench.json": json.dumps(document(rows), indent=1, allow_nan=False) + "\n",
        "bench.md": markdown(rows),
        "summary.txt": summary(rows),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    shown = [row for row in rows if row.method not in _PARTS]
    marks = [pareto.Mark(row.quantity, row.method, row.dtype, row.layout, row.d, row.rate, row.error) for row in shown]
    return [*(folder / name for name in texts), *pareto.draw(marks, folder / "pareto")]
