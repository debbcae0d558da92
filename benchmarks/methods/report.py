"""`zwidth bench` and its results as JSON, Markdown and a figure."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click

from methods import pareto, suite
from methods.suite import Row
from zwidth.core.errors import InputError, ResourceError
from zwidth.plotting import style

_TITLES = {
    "stable": "Stable or not",
    "spectral_radius": "Spectral radius",
    "passive": "Passive or not",
    "alpha_max": "The stiffest stable wall",
}
REFERENCE = "np.linalg.eigvals"


def environment() -> dict[str, Any]:
    """Return the versions and the hardware that the results depend on."""
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
    """Return all measurements as a dictionary for JSON."""
    return {"environment": environment(), "rows": [asdict(row) for row in rows]}


def markdown(rows: Sequence[Row]) -> str:
    """Return Markdown tables; speeds are relative to batched NumPy eigenvalues of the same run."""
    here = environment()
    lines = [
        f"All results were measured in one run on {here['cores']} cores ({here['processor']}) with JAX {here['jax']}",
        f"and NumPy {here['numpy']}.",
        "",
        "| column | content |",
        "|---|---|",
        "| layout | map: a grid of alpha and beta; scattered: each point has its own device; one: a single point |",
        "| times faster | points per second, divided by those of batched `np.linalg.eigvals` at the same delay |",
        "| method jit P | the default method inside `jit` in the precision P, for JAX arrays |",
        "| first call | additional time of the first call, mainly for compilation |",
        "| worst error | defined below; `none of N`: no error among N tested points |",
        "",
        "The error of a stability label is measured on walls at relative distances of 1e-15 to 1e-3 from the boundary.",
        "The labels are compared with ball arithmetic, and the worst error is the largest relative distance in alpha",
        "of a wall with a wrong label. The worst error of all other results is the largest relative error, compared",
        "with results of at least 40 digits. For passivity, it is the error of the required damping.",
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
            faster = _faster(row, reference)
            lines.append(
                f"| {row.d:,.10g} | {name} | {row.layout} | {row.points:,} | {_rate(row.rate)} | {faster} "
                f"| {row.first_seconds:.2g} s | {_error(row)} |"
            )
        lines.append("")
    return "\n".join(lines)


# Quantities of a map, from the cheapest to the most expensive, with the method of each.
_QUESTIONS = {
    "stable or not": ("stable", "crossover", "map"),
    "stable or not, each label certified": ("stable", "certified", "map"),
    "passive or not": ("passive", "worst frequency", "map"),
    "spectral radius, certified to 1e-9": ("spectral_radius", "map to 1e-09", "map"),
    "spectral radius, certified to 1e-12": ("spectral_radius", "map to 1e-12", "map"),
    "all poles": ("spectral_radius", "aberth", "map"),
    "all poles, by eigenvalues": ("spectral_radius", "companion", "map"),
    "stiffest wall, one per device": ("alpha_max", "newton", "scattered"),
}


def _questions(rows: Sequence[Row]) -> list[str]:
    """Return a table of the time per million points of each quantity."""
    delays = sorted({row.d for row in rows})
    lines = ["### What each question costs", "", "Run time in seconds per million points, without compilation.", ""]
    lines += [f"| question | {' | '.join(f'd = {d:,.10g}' for d in delays)} |", "|---|" + "--:|" * len(delays)]
    for question, key in _QUESTIONS.items():
        cells = []
        for d in delays:
            rates = [row.rate for row in rows if (row.quantity, row.method, row.layout) == key and row.d == d]
            cells.append(f"{1e6 / rates[0]:.2g}" if rates else "")
        lines.append(f"| {question} | {' | '.join(cells)} |")
    return [*lines, ""]


def summary(rows: Sequence[Row]) -> str:
    """Return a short summary in plain text: each method at one delay."""
    references = {row.d: row.rate for row in rows if row.method == REFERENCE}
    d = 4.0 if 4.0 in references else min(references)
    lines = [f"{'at d = ' + format(d, 'g'):28}{'layout':>11}{'points/s':>12}{'times faster':>14}{'worst error':>14}"]
    seen = set()
    for row in rows:
        key = (row.quantity, row.method, row.layout)
        if row.d != d or key in seen:
            continue
        seen.add(key)
        name = f"{row.quantity} {row.method}" if not row.baseline else row.method
        faster = _faster(row, references)
        lines.append(f"{name:28}{row.layout:>11}{_rate(row.rate):>12}{faster:>14}{_error(row):>14}")
    return "\n".join(lines) + "\n"


def _faster(row: Row, references: dict[float, float]) -> str:
    """Return the speed relative to batched NumPy, except for single calls, which are not comparable."""
    return f"{row.rate / references[row.d]:,.3g}" if row.d in references and row.layout != "one" else ""


def _rate(rate: float) -> str:
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if rate >= size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g}"


def _error(row: Row) -> str:
    return f"{row.error:.1e}" if row.error else f"none of {row.checked:,}"


def write(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write ``bench.json``, ``bench.md``, ``summary.txt`` and ``pareto.png`` to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "bench.json": json.dumps(document(rows), indent=1, allow_nan=False) + "\n",
        "bench.md": markdown(rows),
        "summary.txt": summary(rows),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    shown = [row for row in rows if row.layout != "one"]
    marks = [pareto.Mark(row.quantity, row.method, row.layout, row.d, row.rate, row.error) for row in shown]
    return [*(folder / name for name in texts), *style.save(pareto.draw_pareto(marks), folder / "pareto")]


def run(quick: bool, out: Path, overwrite: bool, as_json: bool) -> None:
    """Measure, write and print the results of `zwidth bench`."""
    # Otherwise a file in place of the folder would raise only after minutes of measurements.
    if any(part.is_file() for part in (out, *out.parents)):
        raise InputError(f"--out: got {str(out)!r}, which is not a folder; choose another with --out DIR")
    if (out / "bench.json").exists() and not overwrite:
        raise InputError(f"--out: {out} holds results already; give --overwrite or choose another folder")
    if not suite.can_measure():
        raise ResourceError("bench: python-flint or mpmath is not installed; install both: scripts/setup test")
    rows = suite.measure(suite.QUICK if quick else suite.FULL, lambda text: click.echo(f"  {text}", err=True))
    written = write(rows, out)
    if as_json:
        click.echo(json.dumps(document(rows), indent=1, allow_nan=False))
        return
    click.echo(summary(rows))
    click.echo("\n".join(f"wrote {path}" for path in written))
