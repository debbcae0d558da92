"""Sweeps on the command line: the options of ``run`` that concern them, ``verify``, ``export`` and ``figures``."""

from __future__ import annotations

import json
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zwidth.cli.options import json_option
from zwidth.quantities import plain

if TYPE_CHECKING:
    from zwidth.sweep.document import Config
    from zwidth.sweep.engine import SweepEvent, SweepResult

_SECONDS_BETWEEN_LINES = 10.0
_EXIT_FAILED, _EXIT_STOPPED = 1, 130


class Shard(click.ParamType):
    """One of n runs that share the chunks: ``3/8``."""

    name = "i/n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse one option."""
        if isinstance(value, tuple):
            return value
        first, slash, second = str(value).partition("/")
        if slash and first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second) <= 10**6:
            return int(first), int(second)
        self.fail(f"got {value!r}; write i/n with 1 <= i <= n, as in 3/8", param, ctx)


class Size(click.ParamType):
    """A size of memory: ``512 MiB``."""

    name = "size"
    _UNITS = ("B", "KiB", "MiB", "GiB")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Parse one option."""
        text = str(value).strip()
        for power, unit in reversed(list(enumerate(self._UNITS))):
            number = text.removesuffix(unit).strip()
            if number != text or unit == "B":
                try:
                    size = int(float(number) * 1024**power)
                except (ValueError, OverflowError):
                    break
                if 2**27 <= size <= 2**40:
                    return size
                break
        self.fail(f"got {value!r}; write a size from 128 MiB to 1024 GiB, as in '512 MiB'", param, ctx)


@click.command()
@click.argument("path", metavar="CONFIG", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the results.  [default: runs/NAME]")
@click.option("--overwrite", is_flag=True, help="Replace a run that the folder already holds.")
@click.option("--resume", is_flag=True, help="Go on with a run that was stopped; repair what is damaged.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes for sweeps.  [default: this one]")
@click.option("--scheduler", metavar="ADDRESS", help="A dask.distributed scheduler to compute sweeps.")
@click.option("--shard", type=Shard(), help="Compute every n-th chunk of sweeps only, as one of n jobs.")
@click.option("--memory", type=Size(), default="256 MiB", show_default=True, help="Memory for a chunk of a sweep.")
@click.option("--dry-run", is_flag=True, help="Print the plan and do nothing.")
def run(
    path: Path,
    out: Path | None,
    overwrite: bool,
    resume: bool,
    workers: int | None,
    scheduler: str | None,
    shard: tuple[int, int] | None,
    memory: int,
    dry_run: bool,
) -> None:
    """Run the studies of a CONFIG file.

    Data, figures and a record of the run go into one folder, the results of each sweep into a store DIR/STUDY.zarr.
    Ctrl-C keeps what is done; --resume goes on.
    """
    if overwrite and (resume or shard):
        raise click.UsageError("--overwrite starts again, --resume and --shard go on; give one of them")
    if workers and scheduler:
        raise click.UsageError("give --workers or --scheduler; a cluster has its own workers")
    from zwidth.sweep.config import load_config
    from zwidth.sweep.engine import run_sweeps, sweeps_of

    config = load_config(path)
    folder = out or Path("runs", config.name)
    if dry_run:
        _print_plan(config, folder, memory, workers)
        return
    sweeps = sweeps_of(config)
    again = _again(path, out, workers, scheduler, shard)
    going_on = resume or shard is not None
    ok = _run_others(path, config, folder, overwrite, going_on, shard) if len(sweeps) < len(config.studies) else True
    if sweeps:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with _reporter() as progress:
                result = run_sweeps(
                    config,
                    folder,
                    resume=resume,
                    overwrite=overwrite,
                    workers=workers,
                    scheduler=scheduler,
                    shard=shard,
                    memory=memory,
                    progress=progress,
                )
        except KeyboardInterrupt:
            # Before the first chunk began.
            _tell_stopped(again)
        if not result.hopeless:
            _keep_config(path, folder)
        _tell(result, folder, again)
    if not ok:
        raise SystemExit(_EXIT_FAILED)


def _run_others(
    path: Path, config: Config, folder: Path, overwrite: bool, going_on: bool, shard: tuple[int, int] | None
) -> bool:
    """Run the studies that are no sweeps, unless they are done; returns whether all went well."""
    from zwidth.cli.progress import reporter
    from zwidth.studies import run as run_studies
    from zwidth.studies.folder import RUN_FILE
    from zwidth.sweep.engine import sweeps_of
    from zwidth.sweep.lock import holding

    if (shard and shard[0] > 1) or (going_on and (folder / RUN_FILE).is_file()):
        return True
    # A folder that is overwritten is held by `run_studies`; one that sweeps never enter takes its name only when done.
    held = holding(folder, shard) if sweeps_of(config) and not overwrite else nullcontext()
    with held, reporter() as progress:
        result = run_studies(path, out=folder, overwrite=overwrite, progress=progress)
    done = len(result.studies) - len(result.failed)
    click.echo(f"{done} of {len(result.studies)} done, results in {result.folder}")
    for study in result.failed:
        click.echo(f"zwidth: study {study.name!r} failed: {study.error}", err=True)
    return result.ok


def _print_plan(config: Config, folder: Path, memory: int, workers: int | None) -> None:
    """The plan, or why it does not fit."""
    from zwidth.sweep.engine import plan_sweeps, sweeps_of
    from zwidth.sweep.plan import check_resources

    names = {study.name for study in sweeps_of(config)}
    for study in config.studies:
        if study.name not in names:
            click.echo(f"study {study.name}\n  {study.points:,} points ({study.extent})")
    plans = plan_sweeps(config, memory=memory)
    for plan in plans:
        for line in plan.lines():
            click.echo(line)
    click.echo(f"results go to {folder}")
    check_resources(plans, folder, workers or 1)


def _keep_config(path: Path, folder: Path) -> None:
    """A copy of the configuration beside its results."""
    from zwidth.sweep.files import write_whole

    kept = folder / "config.yaml"
    if not kept.exists():
        write_whole(kept, path.read_bytes())


def _again(
    path: Path, out: Path | None, workers: int | None, scheduler: str | None, shard: tuple[int, int] | None
) -> str:
    """The command that goes on with a run, as a shell takes it."""
    words = ["zwidth", "run", str(path)]
    words += ["--out", str(out)] if out else []
    words += ["--resume"]
    words += ["--shard", f"{shard[0]}/{shard[1]}"] if shard else []
    words += ["--workers", str(workers)] if workers else []
    words += ["--scheduler", scheduler] if scheduler else []
    return shlex.join(words)


def _tell_stopped(again: str) -> NoReturn:
    click.echo(f"zwidth: stopped; what is done is kept, go on with: {again}", err=True)
    raise SystemExit(_EXIT_STOPPED)


def _tell(result: SweepResult, folder: Path, again: str) -> None:
    """The end of a run of sweeps; leaves with the exit code of what happened."""
    for found in result.repaired:
        click.echo(f"repaired {found}", err=True)
    done = result.computed + result.skipped
    click.echo(f"{done} of {result.total} chunks done ({result.computed} now), results in {folder}")
    if result.hopeless:
        click.echo(f"zwidth: out: {folder}: {result.hopeless}", err=True)
        click.echo(f"zwidth: the disk is full or read-only; make room and go on with: {again}", err=True)
        raise SystemExit(_EXIT_FAILED)
    for chunk, error in result.failed.items():
        click.echo(f"zwidth: chunk {chunk} failed: {error}", err=True)
    if result.interrupted:
        _tell_stopped(again)
    if result.failed:
        click.echo(f"zwidth: try the failed chunks again with: {again}", err=True)
        raise SystemExit(_EXIT_FAILED)


@contextmanager
def _reporter() -> Iterator[Callable[[SweepEvent], None]]:
    """A callback that tells on stderr how far the sweeps are: a bar on a terminal, a line now and then elsewhere."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[state]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        shown = bar.add_task("starting", total=None, state="")

        def show(event: SweepEvent) -> None:
            bar.update(
                shown, description=event.study, total=event.total_points, completed=event.points, state=_state(event)
            )

        yield show


class _Lines:
    """Plain lines, at most one in a while."""

    def __init__(self) -> None:
        self.last = time.monotonic()

    def __call__(self, event: SweepEvent) -> None:
        now = time.monotonic()
        if event.chunks == event.total_chunks or event.error or now - self.last >= _SECONDS_BETWEEN_LINES:
            self.last = now
            click.echo(f"{event.study:<20} {event.chunks}/{event.total_chunks} chunks  {_state(event)}", err=True)


def _state(event: SweepEvent) -> str:
    left = event.seconds_left
    text = f"{plain(event.rate, 3)} points/s"
    if left == left and left > 0:
        hours, rest = divmod(round(left), 3600)
        text += f", {hours}:{rest // 60:02}:{rest % 60:02} left"
    return text


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@json_option
def verify(folder: Path, as_json: bool) -> None:
    """Read the sweeps in DIR again and check every file.

    Exit code 1 where something is damaged or missing; `zwidth run --resume` repairs it.
    """
    from zwidth.sweep.verify import verify as verify_stores

    found = verify_stores(folder)
    if as_json:
        keys = ("chunks", "done", "damaged", "error", "ok")
        click.echo(
            json.dumps({store.path.name: {key: getattr(store, key) for key in keys} for store in found}, indent=2)
        )
    for store in () if as_json else found:
        state = store.error or f"{store.done} of {store.chunks} chunks done, {len(store.damaged) or 'none'} damaged"
        click.echo(f"{store.path.name}: {state}")
        for damaged in store.damaged:
            click.echo(f"zwidth: {store.path}: {damaged}", err=True)
    if not all(store.ok for store in found):
        raise SystemExit(_EXIT_FAILED)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--netcdf", type=click.Path(path_type=Path), help="Write a netCDF-4 file.")
@click.option("--csv", "table", type=click.Path(path_type=Path), help="Write a table, of a million points at most.")
def export(folder: Path, netcdf: Path | None, table: Path | None) -> None:
    """Write a sweep, a store or a folder DIR with one, as netCDF or CSV."""
    if netcdf is None and table is None:
        raise click.UsageError("give --netcdf FILE or --csv FILE")
    from zwidth.sweep.store import to_csv, to_netcdf

    for write, file in ((to_netcdf, netcdf), (to_csv, table)):
        if file is not None:
            write(folder, file)
            click.echo(f"wrote {file}")


class Slice(click.ParamType):
    """A value of a parameter: ``delta=0.1``."""

    name = "name=value"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, str]:
        """Parse one option."""
        if isinstance(value, tuple):
            return value
        name, equals, wanted = str(value).partition("=")
        if equals and name.strip() and wanted.strip():
            return name.strip(), wanted.strip()
        self.fail(f"got {value!r}; write NAME=VALUE, as in delta=0.1", param, ctx)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--at", multiple=True, type=Slice(), help="Draw this slice, as in --at delta=0.1 --at d=1.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the figures.  [default: DIR/figures]")
@json_option
def figures(folder: Path, at: tuple[tuple[str, str], ...], out: Path | None, as_json: bool) -> None:
    """Draw the sweeps in DIR, as PNG and SVG.

    Stable and passive walls with their boundaries, contours of margins and settling times, surfaces of the stiffest
    wall. --at chooses slices by the nearest value that the sweep has, in the units of the store; without it up to
    three values of a parameter have a panel each.
    """
    from zwidth.studies.stored import draw_stores

    files = draw_stores(
        folder, out, at=dict(at), progress=None if as_json else lambda file: click.echo(f"wrote {file}")
    )
    if as_json:
        click.echo(json.dumps({"files": [str(file) for file in files]}, indent=2))


COMMANDS = (run, verify, export, figures)
"""What the command line gets from this module."""
