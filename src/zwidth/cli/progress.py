"""Progress of a run: a live bar on a terminal; elsewhere a line a study, and one now and then for its chunks."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from zwidth.words.formatting import plain

if TYPE_CHECKING:
    from zwidth.runs.result import StudyEvent
    from zwidth.sweep.engine import Progress

_SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def reporter() -> Iterator[Callable[[StudyEvent], None]]:
    """A callback for `zwidth.run` that tells on stderr how far it is."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        shown = bar.add_task("starting", total=None, state="")

        def show(event: StudyEvent) -> None:
            description = f"{event.name} ({event.kind})"
            if event.progress is not None:
                done, total = event.progress.points, event.progress.total_points
                bar.update(shown, description=description, completed=done, total=total, state=_state(event.progress))
            elif event.result is None:
                bar.update(shown, description=description, completed=event.index - 1, total=event.total, state="")
            else:
                bar.update(shown, completed=event.index, total=event.total, state="")
                for line in _lines(event):
                    console.print(line, markup=False, highlight=False)

        yield show


class _Lines:
    """Plain lines; of chunks, at most one in a while."""

    def __init__(self) -> None:
        self.last = time.monotonic()

    def __call__(self, event: StudyEvent) -> None:
        progress = event.progress
        if progress is None:
            for line in _lines(event) if event.result else ():
                click.echo(line, err=True)
            return
        now = time.monotonic()
        last = progress.chunks == progress.total_chunks
        if last or progress.error or now - self.last >= _SECONDS_BETWEEN_LINES:
            self.last = now
            done = f"{progress.chunks}/{progress.total_chunks} chunks"
            click.echo(f"{event.name:<20} {done}  {_state(progress)}", err=True)


def _lines(event: StudyEvent) -> Iterator[str]:
    """One finished study: its number, name, time and files, and its notes."""
    result = event.result
    assert result is not None, "an event at the end of a study has its result"
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
    left = progress.seconds_left
    text = f"{plain(progress.rate, 3)} points/s"
    if left == left and left > 0:
        hours, rest = divmod(round(left), 3600)
        text += f", {hours}:{rest // 60:02}:{rest % 60:02} left"
    return text
