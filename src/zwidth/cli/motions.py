"""Commands in the time domain: `zwidth simulate` for one motion, `zwidth diagnose` for a wall that oscillates.

Both simulate the device with encoder, friction and motor limits (`hardware`). The linear loop excludes these.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from zwidth.app import printing
from zwidth.app.printing import format_row
from zwidth.cli.commands import cli
from zwidth.cli.hardware import hardware_options, spell_hardware_of_file
from zwidth.cli.help import OF_SCENE, show_example
from zwidth.cli.options import (
    figure_option,
    find_omitted,
    json_option,
    quantity_type,
    save_figure,
    scene_options,
)
from zwidth.core.errors import InputError
from zwidth.model.linear_device import LinearDevice
from zwidth.units.formatting import with_unit
from zwidth.units.quantities import ANY, POSITIVE

TIME_CONSTANTS = 8.0  # default length of a simulation, in time constants of the linear loop
FEWEST_PERIODS = 300  # shortest default length of a simulation, in sampling periods
MOVING = 0.02  # deviation from the final position that counts as motion in figures, relative to the range
MOST_PERIODS = 20_000  # longest default length of a simulation, in sampling periods
DEFAULT_DEPTH = 1e-3  # m or rad; default depth from which the device is released, if no encoder is given
DEFAULT_STEPS = 50  # default depth in encoder steps, if an encoder is given

_WALL = "--stiffness '10 kN/m' --virtual-damping '40 N s/m'"
_LIMITS = "--resolution '20 um' --friction '50 mN'"


@cli.command(**show_example("diagnose", _WALL, OF_SCENE, _LIMITS))
@scene_options(wall=True)
@hardware_options
@json_option
def diagnose(scene: Any, hardware: dict[str, Any], as_json: bool) -> None:
    """Find the cause of a device's oscillation on a wall, and the changes that stop it.

    Possible causes are instability of the linear loop, the steps of the encoder, and the limits of the motor. The
    options --stiffness, --mass (or --device) and --rate (or --period) are required. Parameters that are not given as
    options are taken from SCENE.yaml (or from the folder of a run).
    """
    from zwidth.analysis.diagnosis import diagnose as find_cause

    diagnosis = find_cause(scene, **hardware)
    remedy = diagnosis.advise()
    lines = [format_row(diagnosis.word, diagnosis.explain()), *([format_row("to stop it", remedy)] if remedy else [])]
    thin = _list_thin_margins(scene)
    lines += [format_row("hardware", text)] if (text := spell_hardware_of_file(scene)) else []
    lines += [format_row("CAUTION", text) for text in (*thin, *_list_cautions(scene))]
    printing.print_result(diagnosis.as_dict() | {"cautions": thin}, lines, as_json)


def _list_thin_margins(scene: Any) -> list[str]:
    """Return a list with one caution that names the small margins of a stable wall; empty if all are large enough."""
    from zwidth.analysis.assessment import assess
    from zwidth.analysis.cautions import explain_slow, find_thin

    verdict = assess(scene)
    thin = find_thin(verdict, scene.timing.period) if verdict.stable else []
    if cause := explain_slow(scene, verdict, thin):
        return [f"{thin[0]}: {cause}"]
    return [f"{', '.join(thin)}: see zwidth recommend for a wall with larger margins"] if thin else []


def _list_cautions(scene: Any) -> list[str]:
    """Return the cautions about the safe limit and about parameters that the user has omitted."""
    return [*printing.list_limit_cautions(scene), *printing.list_omission_cautions(scene, find_omitted())]


@cli.command(**show_example("simulate --hit '0.1 m/s'", _WALL, OF_SCENE))
@scene_options(wall=True)
@click.option("--hit", type=quantity_type("m/s", POSITIVE), help="Speed with which the device enters the wall, in m/s.")
@click.option(
    "--external-force",
    type=quantity_type("N", ANY),
    help="Constant external force, in N, positive into the wall; also together with --hit or --hold.",
)
@click.option(
    "--hold", type=quantity_type("m", ANY), help="Depth in the wall at which the device is released at rest, in m."
)
@hardware_options
@click.option(
    "--duration",
    type=quantity_type("s", POSITIVE, periods=True),
    help="Simulated time, in s, or in periods such as '500 periods'.",
)
@figure_option
@json_option
def simulate(
    scene: Any,
    hit: float | None,
    external_force: float | None,
    hold: float | None,
    hardware: dict[str, Any],
    duration: Any,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Simulate a hit on a wall, a constant external force, or the release of the device from inside the wall.

    A hit starts at the surface of the wall, at a sample, with the given speed; the wall is then unilateral and
    otherwise bilateral. Without --hit, --external-force and --hold the device is released at a depth of 1 mm (1 mrad if
    rotary), or of 50 encoder steps if --resolution is given. The row "in contact" states what zwidth diagnose finds for
    a device that stays in the wall, which may differ from the simulated motion. With --tool-mass, a virtual coupling
    to a simulated tool replaces the wall. The tool is initially at rest. The device starts at the position of the tool
    with the speed --hit, or at the distance --hold from the tool. The row "linear loop", which states whether the
    coupling is stable, then replaces the row "in contact". The options --stiffness, --mass (or --device) and --rate (or
    --period) are required. Parameters that are not given as options are taken from SCENE.yaml (or from the folder of a
    run).
    """
    from zwidth.analysis.diagnosis import diagnose as find_cause
    from zwidth.simulation.behavior import describe_ending
    from zwidth.simulation.result import OF_WHOLE, MotionKind

    options = _choose_start(scene, hit, external_force, hold, hardware)
    periods = _choose_length(scene) if duration is None else max(1, round(duration.periods(scene.timing.period)))
    motion = scene.simulate(**options, **hardware, periods=periods)
    # Skip the diagnosis of a scene with a tool, because zwidth.diagnose supports only walls.
    cause = None if scene.tool is not None else find_cause(scene, **hardware, remedies=False)
    ending, units = describe_ending(motion), scene.unit_system
    load, body = "torque" if units.rotary else "force", "wall" if scene.tool is None else "tool"
    start = [f"hits the {body} at {with_unit(hit, units['m/s'], 3)}"] if hit is not None else []
    if hit is None and (depth := _get_depth(options)):
        place = "at a depth of " if scene.tool is None else "at a distance from the tool of "
        start.append(f"released {place}{with_unit(depth, units['m'], 3)}")
    if push := options.get("external_force"):
        start.append(f"external {load} {with_unit(push, units['N'], 3)}")
    force = max(abs(float(motion.command.min())), abs(float(motion.command.max())))
    depth = f"{'penetrates' if cause else 'reaches'} {with_unit(float(motion.penetration), units['m'], 3)}, "
    depth += f"{load} up to {with_unit(force, units['N'], 3)}; "
    # Omit the largest depth and force of a growing motion, because they grow with the simulated time.
    depth = "" if int(motion.outcome) == MotionKind.GROWING else depth
    lines = [
        format_row("start", ", ".join(start) or "at rest"),
        format_row("motion", depth + ending),
        format_row("in contact", f"{cause.word}: {cause.explain()}")
        if cause is not None
        else format_row("linear loop", "stable" if scene.is_stable() else "unstable"),
    ]
    if cause is not None and cause.cause not in ("none", "undecided"):
        lines.append(format_row("remedies", "zwidth diagnose, with the same options"))
    lines += [format_row("hardware", text)] if (text := spell_hardware_of_file(scene)) else []
    lines += [format_row("CAUTION", text) for text in _list_cautions(scene)]
    if figure is not None:
        lines.append(save_figure(_draw_motion(motion), figure))
    result = {name: getattr(motion, name) for name in OF_WHOLE if name not in ("outcome", "status")}
    result = {name: value.item() for name, value in result.items()} | {"outcome": MotionKind(int(motion.outcome)).name}
    diagnosis = None if cause is None else cause.as_dict()
    printing.print_result(result | {"ending": ending, "periods": periods, "diagnosis": diagnosis}, lines, as_json)


def _draw_motion(motion: Any) -> Any:
    """Return a figure of a motion; if the device comes to rest, the time axis ends at three times the time to rest."""
    import numpy as np

    from zwidth.plotting import plot
    from zwidth.simulation.result import MotionKind

    ax = plot.motion(motion)
    moving = abs(motion.position - motion.position[-1]) > MOVING * np.ptp(motion.position)
    if int(motion.outcome) == MotionKind.REST and moving.any():
        settled = motion.time[np.flatnonzero(moving)[-1] + 1]
        # Find the unit of the time axis, s or ms, by comparing the time of the second sample.
        unit = np.asarray(ax.lines[0].get_xdata())[1] / motion.time[1]
        ax.set_xlim(0.0, min(3.0 * settled * unit, ax.get_xlim()[1]))
    return ax.figure


def _choose_start(
    scene: Any, hit: float | None, external_force: float | None, hold: float | None, hardware: dict[str, Any]
) -> dict[str, Any]:
    """Return the initial conditions and the external force of a simulation, as arguments of `zwidth.simulate`."""
    if hit is not None and hold is not None:
        raise InputError(
            "--hold: given together with --hit; give only one of them, because a hit starts outside the wall"
        )
    if hit is not None:
        contact = "unilateral" if scene.tool is None else "bilateral"
        return {"start_velocity": hit, "external_force": external_force or 0.0, "contact": contact}
    if hold is None and external_force is None:
        depth = DEFAULT_STEPS * hardware["resolution"] if "resolution" in hardware else DEFAULT_DEPTH
        if isinstance(scene.device, LinearDevice) and scene.tool is None:
            # Displace a linear system by a constant external force, because its simulation always starts at rest at 0.
            return {"external_force": depth * float(scene.wall.stiffness)}
        hold = depth
    start: Any = hold or 0.0
    if scene.tool is not None:
        # Displace the tool if the device is a linear system, because a linear system always starts at 0.
        linear = isinstance(scene.device, LinearDevice)
        start = {"tool_position": start} if linear else {"position": start, "tool_position": 0.0}
    return {"start_position": start, "external_force": external_force or 0.0}


def _get_depth(options: dict[str, Any]) -> float:
    """Return the initial depth in the wall, or distance from the tool, that ``options`` of `zwidth.simulate` set."""
    start = options.get("start_position", 0.0)
    return abs(start.get("position", 0.0) - start["tool_position"]) if isinstance(start, dict) else start


def _choose_length(scene: Any) -> int:
    """Return the length of a simulation in periods that covers the slowest decay of the linear loop."""
    dominant = scene.loop.find_dominant(float(scene.alpha), float(scene.beta))
    rate = abs(float(dominant.rate))
    return int(min(max(TIME_CONSTANTS / rate, FEWEST_PERIODS), MOST_PERIODS)) if 0 < rate < math.inf else MOST_PERIODS
