"""`zwidth recommend`: the wall to set on a device, what would allow a stiffer one, and the code of its loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import SHARE, Parsed, figure_option, json_option, read_factor, save_figure, scene_options
from zwidth.pages import words
from zwidth.pages.words import row

_FACTOR = Parsed("FACTOR", read_factor, "write a factor, as 2, or 6 dB")
_DEGREES = Parsed("DEGREES", lambda text: float(text.strip().removesuffix("deg")), "write degrees, as 30")


@cli.command()
@scene_options(wall=False, required=True)
@click.option("--stiffness-fraction", type=SHARE, help="At most this share of K_max; 75% if nothing is asked for.")
@click.option("--gain-margin", type=_FACTOR, help="At least this factor on K and B together.")
@click.option("--phase-margin", type=_DEGREES, help="At least so many degrees.")
@click.option("--passive", is_flag=True, help="Only walls that are passive, whatever the hand.")
@figure_option
@click.option("--code", type=click.Choice(("c", "python")), help="Print the wall as a program for the loop, alone.")
@json_option
def recommend(scene: Any, figure: Path | None, code: Any, as_json: bool, **wanted: Any) -> None:
    """Say which wall to set: the stiffest one with wanted margins.

    Then what else is known of that wall, and what would allow a stiffer one.
    """
    if code and as_json:
        raise click.UsageError("give --code or --json: each has all of the output")
    found = scene.recommend(**wanted)
    wrote = []
    if figure is not None:
        from zwidth.studies.recommend import draw

        wrote.append(save_figure(draw(found), figure))
    if code:
        click.echo(found.code(code), nl=False)
        return
    notes = [*words.coded_period_notes(scene), *found.notes]
    lines = [*words.scene_lines(scene), *(row("" if k else "set", text) for k, text in enumerate(found.lines()))]
    if found.verdict is not None:
        lines += words.pole_lines(found.verdict)
    lines += [row("" if k else "what buys stiffness", step.spell()) for k, step in enumerate(found.steps)]
    words.tell(found.as_dict() | {"notes": notes}, [*lines, *wrote, *words.note_lines(notes)], as_json)
