"""Progress of a run: a live bar on a terminal, one plain line a study elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from zwidth.studies.events import StudyEvent, StudyResult


def _line(event: StudyEvent, result: StudyResult) -> str:
    """One finished study: its number, name, time and files."""
    width = len(str(event.total))
    state = "failed" if result.state == "failed" else f"{len(result.files)} files"
    return f"[{event.index:>{width}}/{event.total}] {event.name:<20} {event.kind:<10} {result.seconds:6.1f} s  {state}"


@contextmanager
def reporter() -> Iterator[Callable[[StudyEvent], None]]:
    """A callback for `zwidth.run` that tells on stderr how far it is."""
    if not sys.stderr.isatty():
        yield _plain
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def show(event: StudyEvent) -> None:
            if event.result is None:
                bar.update(task, total=event.total, description=f"{event.name} ({event.kind})")
                return
            bar.update(task, completed=event.index)
            console.print(_line(event, event.result), markup=False, highlight=False)
            for note in event.result.notes:
                console.print(f"      note: {note}", markup=False, highlight=False)

        yield show


def _plain(event: StudyEvent) -> None:
    if event.result is None:
        return
    click.echo(_line(event, event.result), err=True)
    for note in event.result.notes:
        click.echo(f"      note: {note}", err=True)
