"""``zwidth report``: a run as one HTML file."""

from __future__ import annotations

import json
from pathlib import Path

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import json_option


@cli.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="The file.  [default: DIR/report.html]")
@json_option
def report(folder: Path, out: Path | None, as_json: bool) -> None:
    """Write the run in DIR as one HTML file: figures, slices of its maps, methods, versions, configuration.

    The file needs no server and no network.
    """
    from zwidth.pages.report.page import write_report

    file = write_report(folder, out)
    click.echo(json.dumps({"file": str(file), "bytes": file.stat().st_size}) if as_json else f"wrote {file}")
