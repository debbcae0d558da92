"""`zwidth bench`: what each method costs on this machine, and how wrong it can be."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import json_option


@cli.command()
@click.option("--quick", is_flag=True, help="Few delays and small maps: less than a minute instead of some.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("runs/bench"),
    show_default=True,
    help="Folder of bench.json, bench.md, summary.txt and the picture pareto.png.",
)
@click.option("--overwrite", is_flag=True, help="Replace the results of an earlier run in that folder.")
@json_option
def bench(quick: bool, out: Path, overwrite: bool, as_json: bool) -> None:
    """Measure speed against error of every method, beside NumPy, JAX and python-control.

    It needs a checkout of the project, whose benchmarks/methods it runs, and for the errors the extra "test".
    """
    from zwidth.words.errors import ResourceError

    # Beside the package's sources; nothing of it is installed with a wheel.
    folder = Path(__file__).parents[3] / "benchmarks"
    if not (folder / "methods").is_dir():
        raise ResourceError(
            "bench: needs a checkout of the project, with its folder benchmarks/; there: scripts/setup test, then "
            ".venv/bin/zwidth bench"
        )
    sys.path.insert(0, str(folder))
    from methods.report import run

    run(quick, out, overwrite, as_json)
