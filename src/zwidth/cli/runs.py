"""Commands on runs: ``zwidth run`` with its progress on stderr, ``verify``, ``export``, ``figures`` and ``bench``.

A run computes the studies of a configuration file and writes their results into one folder. A sweep is a study of up to
10^12 points; it is computed in chunks, each of which is saved in the store DIR/STUDY.zarr, so that a stopped run can be
resumed.
"""

from __future__ import annotations

import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zwidth.app.printing import format_row, print_json, print_lines
from zwidth.cli.commands import EXIT_FAILED, cli
from zwidth.cli.options import PATH, Parsed, folder_argument, json_option, read_pairs
from zwidth.core.errors import ResourceError
from zwidth.units.formatting import plain

if TYPE_CHECKING:
    from zwidth.runs.run import RunResult, StudyEvent
    from zwidth.studies.document import Config
    from zwidth.sweep.engine import Progress

_SECONDS_BETWEEN_LINES = 10.0  # shortest time between two lines of progress, if stderr is not a terminal


def _read_size(text: str) -> int:
    """Return a memory size in bytes from a text such as "512 MiB"."""
    match = re.fullmatch(r"(.*?)\s*(B|KiB|MiB|GiB|)", text.strip())
    assert match is not None, "the pattern matches any text"
    size = float(match[1]) * 1024 ** ("B", "KiB", "MiB", "GiB").index(match[2] or "B")
    if not 2**27 <= size <= 2**40:
        raise ValueError
    return int(size)


def _read_slice(text: str) -> tuple[str, str]:
    """Split a text "NAME=VALUE" into NAME and VALUE, both as texts."""
    name, _, value = (part.strip() for part in text.partition("="))
    if not name or not value:
        raise ValueError
    return name, value


def _read_figure_size(text: str) -> tuple[float, float | None]:
    """Return width and height of a figure in inches from a text; the height is None for a single width in mm."""
    metric = text.strip().endswith("mm")
    width, *rest = (float(part.replace("mm", "")) / (25.4 if metric else 1.0) for part in text.split("x"))
    if not all(1 <= side <= 100 for side in (width, *rest)) or len(rest) != 1 - (metric and not rest):
        raise ValueError
    return width, rest[0] if rest else None


_SIZE = Parsed("size", _read_size, "write a size from 128 MiB to 1024 GiB, such as '512 MiB'")
_SLICE = Parsed("name=value", _read_slice, "write NAME=VALUE, such as delta=0.1")
_DPI = click.IntRange(10, 2400)
_FIGURE_SIZE = Parsed(
    "WxH", _read_figure_size, "write width x height from 1 to 100 inches, such as 7x4.5, or a width such as 85mm"
)


@cli.command()
@click.argument("path", metavar="CONFIG", type=PATH)
@click.option("--out", type=PATH, help="Folder for the results.  [default: runs/NAME]")
@click.option("--overwrite", is_flag=True, help="Replace an existing run in the folder.")
@click.option("--resume", is_flag=True, help="Continue a stopped run, and repair damaged files.")
@click.option("--workers", type=click.IntRange(min=1), help="Number of worker processes for sweeps.  [default: none]")
@click.option("--scheduler", metavar="ADDRESS", help="Compute sweeps with this dask.distributed scheduler.")
@click.option("--memory", type=_SIZE, default="256 MiB", show_default=True, help="Memory of one chunk of a sweep.")
@click.option(
    "--size", type=_FIGURE_SIZE, help="Size of the studies' figures: 7x4.5 in inches, or a width such as 85mm."
)
@click.option("--dpi", type=_DPI, help="Resolution of the studies' figures, in dots per inch.")
@click.option("--dry-run", is_flag=True, help="Print the plan of the run without computing.")
def run(path: Path, dry_run: bool, size: tuple[float, float | None] | None, dpi: int | None, **options: Any) -> None:
    """Run the studies of a CONFIG file.

    The command writes data, figures and a record of the run into one folder, and the results of each sweep into
    DIR/STUDY.zarr. If you stop the run with Ctrl-C, the results so far are kept, and --resume continues the run.
    """
    from zwidth.plotting.style import style_sheet
    from zwidth.runs.run import run as run_studies
    from zwidth.studies.document import load_config

    config = load_config(path)
    for line in getattr(config.scene, "warnings", ()):
        click.echo(f"zwidth: {path}: {line}", err=True)
    if dry_run:
        _print_plan(config, **options)
        return
    command = _spell_resume_command(path, size=size, dpi=dpi, **options)
    with _interrupt_on_sigterm() as signals:
        try:
            with reporter() as progress, style_sheet(size=size, dpi=dpi):
                # Pass all other options on by name, because they have the names of the arguments of `zwidth.run`.
                result = run_studies(path, progress=progress, **options)
        except KeyboardInterrupt:
            # The run was interrupted before its first study began, so there is no result to report.
            result = None
    if result is not None:
        _report_end(result, command)
    if result is None or result.interrupted:
        click.echo(f"zwidth: stopped; results so far are kept. Resume with: {command}", err=True)
        raise SystemExit(128 + (signals[0] if signals else signal.SIGINT))
    if not result.ok:
        raise SystemExit(EXIT_FAILED)


@contextmanager
def _interrupt_on_sigterm() -> Iterator[list[int]]:
    """Handle SIGTERM like Ctrl-C; yield the list of received signals."""
    received: list[int] = []

    def end(number: int, frame: Any) -> None:
        received.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield received
    finally:
        signal.signal(signal.SIGTERM, before)


def _print_plan(config: Config, *, out: Path | None, memory: int, workers: int | None, **_: Any) -> None:
    """Print the plan of a run; raise `ResourceError` if memory or disk space is insufficient."""
    from zwidth.runs.run import plan_run
    from zwidth.sweep.plan import Plan, check_resources

    folder = out or Path("runs", config.name)
    steps = plan_run(config, memory=memory)
    for step in steps:
        plan = isinstance(step, Plan)
        lines = step.lines() if plan else (f"study {step.name}", f"  {step.points:,} points ({step.extent})")
        click.echo("\n".join(lines))
    click.echo(f"results go to {folder}")
    check_resources([step for step in steps if isinstance(step, Plan)], folder, workers or 1)


def _spell_resume_command(path: Path, *, out: Path | None, **given: Any) -> str:
    """Return the command that resumes a run, quoted for a shell."""
    words = ["zwidth", "run", path, *(["--out", out] if out else []), "--resume"]
    size = given["size"] and "x".join(f"{25.4 * side:.12g}" for side in given["size"] if side) + "mm"
    for name, value in {**given, "size": size}.items():
        words += [f"--{name}", value] if value and name in ("workers", "scheduler", "size", "dpi") else []
    return shlex.join(map(str, words))


def _report_end(result: RunResult, command: str) -> None:
    """Print the summary of a run: repaired files, results, errors, and the command that resumes the run."""
    for file in result.repaired:
        click.echo(f"repaired {file}", err=True)
    sweeps = result.sweeps.values()
    chunks = [sum(getattr(sweep, name) for sweep in sweeps) for name in ("computed", "skipped", "total")]
    done = sum(study.state in ("done", "kept") for study in result.studies if study.sweep is None)
    parts = [f"{done} of {result.computed_count} done"] if result.computed_count else []
    parts += [f"{chunks[0] + chunks[1]} of {chunks[2]} chunks done ({chunks[0]} now)"] if sweeps else []
    click.echo(f"{', '.join(parts) or 'nothing done'}, results in {result.folder}")
    for study in result.studies:
        print_lines(format_row("" if number else study.name, line) for number, line in enumerate(study.answer))
    if any(study.sweep and study.state in ("done", "kept") for study in result.studies):
        click.echo(f"figures of the sweeps: {shlex.join(['zwidth', 'figures', str(result.folder)])}")
    if result.fatal_error:
        click.echo(f"Error: out: {result.folder}: {result.fatal_error}", err=True)
        click.echo(f"zwidth: the disk is full or read-only; make room and resume with: {command}", err=True)
        return
    for study in result.failed:
        for chunk, error in study.sweep.failed.items() if study.sweep else ():
            click.echo(f"Error: chunk {chunk} failed: {error}", err=True)
        if not study.sweep:
            click.echo(f"Error: study {study.name!r} failed: {study.error}", err=True)
    if result.cluster_error:
        click.echo(f"Error: {result.cluster_error}; results so far are kept. Resume with: {command}", err=True)
    elif result.failed and not result.interrupted:
        click.echo(f"zwidth: retry the failed parts with: {command}", err=True)


@cli.command()
@folder_argument
@json_option
def verify(folder: Path, as_json: bool) -> None:
    """Verify the checksums of all files of the sweeps in DIR.

    The exit code is 1 if a file is damaged or missing; `zwidth run --resume` then repairs the file.
    """
    from zwidth.sweep.dataset import verify as verify_stores

    stores, keys = verify_stores(folder), ("chunks", "done", "damaged", "error", "ok")
    if as_json:
        print_json({store.path.name: {key: getattr(store, key) for key in keys} for store in stores})
    for store in () if as_json else stores:
        state = store.error or f"{store.done} of {store.chunks} chunks done, {len(store.damaged) or 'none'} damaged"
        click.echo(f"{store.path.name}: {state}")
        for damaged in store.damaged:
            click.echo(f"Error: {store.path}: {damaged}", err=True)
    if not all(store.ok for store in stores):
        raise SystemExit(EXIT_FAILED)


@cli.command()
@folder_argument
@click.option("--netcdf", type=PATH, help="Write a netCDF-4 file.")
@click.option("--csv", "table", type=PATH, help="Write a table; at most one million points.")
def export(folder: Path, netcdf: Path | None, table: Path | None) -> None:
    """Write the sweep in DIR, or in a store, as netCDF or CSV."""
    if netcdf is None and table is None:
        raise click.UsageError("give --netcdf FILE or --csv FILE")
    from zwidth.sweep.dataset import to_csv, to_netcdf
    from zwidth.sweep.store import find_store

    missing = len(find_store(folder).missing())
    for write, file in ((to_netcdf, netcdf), (to_csv, table)):
        if file is not None:
            write(folder, file)
            click.echo(f"wrote {file}")
    if missing:
        text = "chunks are missing; their points have status 255. Compute them with 'zwidth run CONFIG --resume'"
        click.echo(f"zwidth: {folder}: {missing} {text}", err=True)


@cli.command()
@folder_argument
@click.option(
    "--at",
    "selection",
    multiple=True,
    type=_SLICE,
    callback=read_pairs,
    help="Draw this slice, such as --at delta=0.1 --at delay=1ms.",
)
@click.option("--format", "formats", multiple=True, type=click.Choice(("png", "svg", "pdf")), default=("png", "svg"),
              help="File format; may be repeated.  [default: png, svg]")  # fmt: skip
@click.option("--dpi", type=_DPI, help="Resolution in dots per inch.")
@click.option("--size", type=_FIGURE_SIZE, help="Size: 7x4.5 in inches, or a width such as 85mm.")
@click.option("--style", type=PATH, help="Style sheet of matplotlib, e.g. with 'svg.fonttype: none'.")
@click.option("--out", type=PATH, help="Folder for the figures.  [default: DIR/figures]")
@json_option
def figures(folder: Path, selection: dict[str, str], out: Path | None, as_json: bool, **drawing: Any) -> None:
    """Draw the sweeps in DIR, as PNG and SVG.

    The figures show stable and passive walls with their boundaries, contours of margins and decay times, and the
    stiffest wall as a surface. --at selects the value of the sweep that is nearest to the given value; values without a
    unit have the unit of the store. Without --at, the figure has one panel for each of up to three values of a
    parameter.
    """
    from zwidth.runs.draw import draw_stores

    callbacks: dict[str, Any] = {"note": lambda text: click.echo(f"zwidth: {text}", err=True)}
    callbacks |= {} if as_json else {"progress": lambda file: click.echo(f"wrote {file}")}
    files = draw_stores(folder, out, selection=selection, **drawing, **callbacks)
    if as_json:
        print_json({"files": [str(file) for file in files]})
    if not files:
        raise SystemExit(EXIT_FAILED)


@cli.command()
@click.option("--quick", is_flag=True, help="Use few delays and small grids; takes one to three minutes on two cores.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("runs/bench"),
    show_default=True,
    help="Folder for bench.json, bench.md, summary.txt and the figure pareto.png.",
)
@click.option("--overwrite", is_flag=True, help="Replace the results of an earlier run in that folder.")
@json_option
def bench(quick: bool, out: Path, overwrite: bool, as_json: bool) -> None:
    """Measure speed and error of every method, and of comparable tools.

    The command requires a checkout of the project, because it runs the programs in benchmarks/methods. To measure the
    errors, it also requires the extra "test".
    """
    # Search the checkout for the benchmarks, because an installed package does not contain them.
    folder = Path(__file__).parents[3] / "benchmarks"
    if not (folder / "methods").is_dir():
        raise ResourceError(
            "bench: requires a checkout of the project with its folder benchmarks/; run there: scripts/setup test, "
            "then .venv/bin/zwidth bench"
        )
    sys.path.insert(0, str(folder))
    from methods.report import run

    run(quick, out, overwrite, as_json)


@contextmanager
def reporter() -> Iterator[Callable[[StudyEvent], None]]:
    """Yield a callback for `zwidth.run` that reports progress on stderr: a bar on a terminal, otherwise lines."""
    printed, template = time.monotonic(), "%(label)s  [%(bar)s]  %(info)s"
    options: dict[str, Any] = {"show_eta": False, "item_show_func": lambda state: state, "bar_template": template}
    shown: Any = nullcontext()
    if sys.stderr.isatty():
        shown = click.progressbar(length=1, label="starting", file=sys.stderr, width=0, **options)
    with shown as bar:

        def show(event: StudyEvent) -> None:
            nonlocal printed
            done, total, state, line, due = event.index - (event.result is None), event.total, "", "", False
            if event.progress is not None:
                done, total, state = event.progress.points, event.progress.total_points, _state(event.progress)
                line = f"{event.progress.chunks}/{event.progress.total_chunks} chunks  {state}"
                due = event.progress.chunks == event.progress.total_chunks or bool(event.progress.error)
            elif event.parts is not None:
                done, total = event.parts
                line = f"{done}/{total} done"
            lines = list(_lines(event))
            if bar is not None:
                # Erase the progress bar before each line; `render_progress` draws it again below the lines.
                lines = [f"\r\033[K{text}" for text in lines]
                bar.label, bar.pos, bar.length, bar.current_item = f"{event.name} ({event.kind})", done, total, state
            elif line and (due or time.monotonic() - printed >= _SECONDS_BETWEEN_LINES):
                printed = time.monotonic()
                lines = [f"{event.name:<20} {line}", *lines]
            for text in lines:
                click.echo(text, err=True)
            if bar is not None:
                bar.render_progress()

        yield show


def _lines(event: StudyEvent) -> Iterator[str]:
    """Yield the printed lines of a finished study: number, name, kind, run time, number of files, and notes."""
    result = event.result
    if result is None:
        return
    state = f"{len(result.files)} files{', kept' if result.state == 'kept' else ''}"
    if result.sweep is not None:
        state = f"{result.sweep.computed + result.sweep.skipped}/{result.sweep.total} chunks"
    if result.state == "failed":
        state = "failed"
    number = f"[{event.index:>{len(str(event.total))}}/{event.total}]"
    yield f"{number} {event.name:<20} {event.kind:<10} {result.seconds:6.1f} s  {state}"
    for note in result.notes:
        yield f"      note: {note}"


def _state(progress: Progress) -> str:
    """Return a text with the speed of a sweep in points per second and its estimated remaining time."""
    left = progress.seconds_left
    text = f"{plain(progress.rate, 3)} points/s"
    if left == left and left > 0:
        hours, rest = divmod(round(left), 3600)
        text += f", {hours}:{rest // 60:02}:{rest % 60:02} left"
    return text
