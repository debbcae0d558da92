"""`zwidth bench`: what each method costs on this machine, and how wrong it can be."""

from __future__ import annotations

import json
from pathlib import Path

import click

from zwidth.cli.options import json_option


@click.command()
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

    Errors are measured against ball arithmetic: python-flint must be installed (extra "certified").
    """
    from zwidth.words.errors import InputError, ResourceError

    # A file in the place of the folder would otherwise be found after minutes of work.
    if any(part.is_file() for part in (out, *out.parents)):
        raise InputError(f"--out: got {str(out)!r}, which is not a folder; choose another with --out DIR")
    if (out / "bench.json").exists() and not overwrite:
        raise InputError(f"--out: {out} holds results already; give --overwrite or choose another folder")

    from zwidth.bench import report, suite

    if not suite.can_measure():
        raise ResourceError("bench: python-flint is not installed; install the extra: pip install 'zwidth[certified]'")
    rows = suite.measure(suite.QUICK if quick else suite.FULL, lambda text: click.echo(f"  {text}", err=True))
    written = report.write(rows, out)
    if as_json:
        click.echo(json.dumps(report.document(rows), indent=1, allow_nan=False))
        return
    click.echo(report.summary(rows))
    click.echo("\n".join(f"wrote {path}" for path in written))
