"""Pages for a browser: ``zwidth explore`` and ``zwidth report``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import json_option


@cli.command()
@click.argument("path", metavar="[CONFIG|DIR]", required=False, type=click.Path(exists=True, path_type=Path))
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on this machine.  [default: any free one]")
@click.option("--no-browser", is_flag=True, help="Print the address and open no browser.")
def explore(path: Path | None, port: int, no_browser: bool) -> None:
    """Open a page with sliders for device, timing and wall, on which the stable walls follow.

    It starts from the scene of a CONFIG file, or of the run in DIR. The server is for this machine alone and asks for
    the token in its address. Ctrl-C ends it.
    """
    import threading
    import webbrowser

    from zwidth.words.errors import InputError

    try:
        from zwidth.pages.explorer.server import Explorer
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("bokeh", "tornado"):
            raise
        raise InputError("explore: bokeh is not installed; pip install 'zwidth[explore]'") from error
    from zwidth.pages.explorer.controls import read_controls

    explorer = Explorer(read_controls(path), port)
    click.echo(f"{explorer.address}  (Ctrl-C ends it)")
    if not no_browser:
        # A browser in the terminal would keep the server waiting for its own page.
        threading.Thread(target=webbrowser.open, args=(explorer.address,), daemon=True).start()
    explorer.run()
    click.echo("stopped")


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
