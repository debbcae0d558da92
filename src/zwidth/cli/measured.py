"""`zwidth excite` and `zwidth respond`: the record to play, and the response and the safe wall that it tells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import (
    figure_option,
    json_option,
    log_options,
    period_options,
    quantity_type,
    read_logs,
    save_figure,
    velocity_options,
)
from zwidth.pages.words import row, tell
from zwidth.words.formatting import with_unit
from zwidth.words.quantities import POSITIVE

_FILE, _TIME = click.Path(path_type=Path), quantity_type("s", POSITIVE)


@cli.command()
@period_options
@click.option("--force", type=quantity_type("N", POSITIVE), required=True, help="The largest to command, in N.")
@click.option("--resolution", type=quantity_type("m", POSITIVE), required=True, help="One count of the encoder, in m.")
@click.option("--duration", type=_TIME, default="60 s", show_default=True, help="In s.")
@click.option("--response", type=_FILE, help="The response of a first record, to design the second.")
@click.option("--out", type=_FILE, default=Path("play.csv"), show_default=True, help="The file to play.")
@velocity_options
@json_option
def excite(response: Path | None, out: Path, as_json: bool, **options: Any) -> None:
    """Design the force to play before `zwidth respond`."""
    if options["period"] is None:
        raise click.UsageError("give --period or --rate")
    from zwidth.fitting.excite import excite as design
    from zwidth.parts.measured import MeasuredDevice

    made = design(response=None if response is None else MeasuredDevice.read(response), **options)
    made.save(out)
    low, high = (with_unit(end, "Hz") for end in made.frequency[[0, -1]])
    lines = [
        row("record", f"{made.force.size} samples, up to {with_unit(abs(made.force).max(), 'N')}"),
        row("lines", f"{made.frequency.size} from {low} to {high}, repeated after {with_unit(made.cycle, 's')}"),
        row("deviation", f"{_compliance(made.deviation)} to expect, in the median"),
    ]
    found: dict[str, Any] = {"file": str(out), "samples": made.force.size, "cycle": made.cycle}
    if made.expected is not None and made.limit is not None:
        share = float(made.expected.stiffness / made.limit.stiffness)
        found |= {"expected": _plain(made.expected), "limit": _plain(made.limit)}
        lines += [row("will tell", f"{_wall(made.expected)} as safe, {100 * share:.0f} % of K_max by now")]
    tell(found, [*lines, row("wrote", str(out))], as_json)


@cli.command()
@click.argument("logs", metavar="LOG.csv...", nargs=-1, required=True, type=_FILE)
@period_options
@click.option("--cycle", type=_TIME, help="Period of the force, in s; found from a force that repeats exactly.")
@log_options
@click.option("--save", type=_FILE, metavar="FILE.csv", help="Keep the response.")
@velocity_options
@figure_option
@json_option
def respond(
    logs: tuple[Path, ...],
    period: float | None,
    cycle: float | None,
    save: Path | None,
    velocity: Any,
    figure: Path | None,
    as_json: bool,
    **of_logs: str | None,
) -> None:
    """Find a device's frequency response, and what is safe by it.

    Without a model, with the band that noise leaves. From logs of a force that `zwidth excite` designed, or of any
    other. What --save keeps, and any table of an analyzer, is a device of the other commands: `zwidth ridge --device
    FILE.csv` answers of it.
    """
    from zwidth.fitting.respond import find_nominal_limit, respond_to_logs
    from zwidth.parts.timing import Timing
    from zwidth.parts.velocity import BackwardDifference
    from zwidth.scenes.scene import Scene

    if of_logs["time"] is not None and period is not None:
        raise click.UsageError("give one of --time, --period and --rate")
    found = respond_to_logs(read_logs(logs, period, **of_logs), period=period, cycle=cycle)
    device, period, doubts = found.device, found.period, found.doubts
    kind = "stretches of a force that repeats" if found.cycle else "pieces"
    source = f"{' and '.join(log.name for log in logs)}, {found.records} {kind}"
    scene = Scene(device, Timing(period), velocity=velocity or BackwardDifference())
    top, safe = find_nominal_limit(scene), scene.max_stiffness()
    low, high = (with_unit(float(end), "Hz") for end in device.frequency[[0, -1]])
    lines = [row("response of", source), row("lines", f"{device.frequency.size} from {low} to {high}")]
    if device.deviation is not None:
        lines.append(row("deviation", f"{_compliance(device.deviation)} in the median"))
    said = scene.explain_undecided(float(top.stiffness), float(top.virtual_damping)) if top.status == 0 else []
    lines.append(row("K_max", f"{_wall(top)}, by the curve that was measured" if top.status == 0 else "undecided"))
    given = safe.status == 0 and device.deviation is not None and not doubts
    words = f"{_wall(safe)}: stable for every response in the band" if given else "none is told"
    lines.append(row("safe wall", words))
    lines += [row("a stiffer one" if k == 0 else "", text) for k, text in enumerate(said)]
    lines += [row("doubt", text) for text in doubts]
    if save is not None:
        device.save(save, f"from {source}, T = {with_unit(period, 's')}")
        lines.append(row("wrote", str(save)))
    if figure is not None:
        lines.append(save_figure(_draw(scene, safe if safe.status == 0 else None), figure))
    told = {"lines": device.frequency.size, "period": period, "maximum": _plain(top)}
    told |= {"safe_wall": _plain(safe) if given else None, "undecided": said, "doubts": list(doubts)}
    tell(told, lines, as_json)


def _compliance(deviation: Any) -> str:
    import numpy as np

    return with_unit(float(np.median(deviation)), "m/N", 3)


def _wall(wall: Any) -> str:
    return f"K = {with_unit(float(wall.stiffness), 'N/m')}, B = {with_unit(float(wall.virtual_damping), 'N s/m')}"


def _plain(wall: Any) -> dict[str, float]:
    return {name: float(getattr(wall, name)) for name in ("stiffness", "virtual_damping", "frequency", "status")}


def _draw(scene: Any, wall: Any) -> Any:
    """The response with its band, and the open loop of a wall."""
    from zwidth import figures

    device = scene.device
    table = {"frequency_Hz": device.frequency, "real_m_per_N": device.response.real}
    table |= {"imag_m_per_N": device.response.imag}
    if device.deviation is not None:
        table["deviation_m_per_N"] = device.deviation
    if wall is not None:
        loop = scene.frequency_response(wall.stiffness, wall.virtual_damping, device.frequency)
        table |= {"open_loop_real": loop.real, "open_loop_imag": loop.imag}
    return figures.draw_response(table)
