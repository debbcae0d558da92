"""Options of the commands on records (`zwidth fit`, `excite`, `respond`): logs, and the control loop of the recording.

A record is a log of force and position of a device. Its sampling period and velocity estimate come from options or
from a scene file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from zwidth.cli.options import (
    BOTH_PERIODS,
    PATH,
    Command,
    change_scene,
    get_hardware,
    get_options_with_kind,
    scene_argument,
    take_options,
)
from zwidth.cli.parts import make_kind, name_option, select_part
from zwidth.model.checks import find_kind
from zwidth.units.log_columns import OF_LOGS
from zwidth.units.quantities import CHOICES, OF_PARTS
from zwidth.units.unit_system import UnitSystem

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene
    from zwidth.model.velocity import Velocity

_LONG = 2**23  # size of a log in bytes above which a message is printed before it is read


class RecordLoop(NamedTuple):
    """Control loop in which a record was measured, from options and a scene file."""

    period: float | None  # in s, from the options
    velocity: Velocity | None  # velocity estimate from the options or the file
    scene: Scene | None  # the scene of the file

    @property
    def known_period(self) -> float | None:
        """The sampling period in s, from the options or the file."""
        return self.scene.timing.period if self.period is None and self.scene is not None else self.period

    def check_kind(self, rotary: bool) -> None:
        """Raise an error if record, scene file and options do not all belong to linear, or all to rotary devices."""
        implied = {"the scene file has": self.scene and self.scene.device.rotary}
        implied |= {f"{flag} has units of": find_kind({flag: text}) for flag, text in get_options_with_kind().items()}
        kinds = ("rotary", "linear") if rotary else ("linear", "rotary")
        for source, kind in implied.items():
            if kind is not None and bool(kind) != rotary:
                raise click.UsageError(f"the record is that of a {kinds[0]} device, but {source} a {kinds[1]} one")


def _make_loop(given: dict[str, Any], _: UnitSystem) -> RecordLoop:
    """Return the control loop built from the options in ``given`` (by path) and from a scene file."""
    scene = given.pop("scene", None)
    if {"period", "rate"} <= given.keys():
        raise click.UsageError(BOTH_PERIODS)
    period = 1.0 / given["rate"] if "rate" in given else given.get("period")
    changes = {path: value for path, value in given.items() if path.startswith("velocity.")}
    if scene is not None:
        return RecordLoop(period, change_scene(scene, changes).velocity, scene)
    return RecordLoop(period, make_kind("velocity", select_part(changes, "velocity")) if changes else None, None)


def _is_scene(path: Path) -> bool:
    """Return whether a path names a scene file or the folder of a run, and not a log."""
    return path.suffix in (".yaml", ".yml") or path.is_dir()


def loop_options(*, logs: bool) -> Callable[[Command], Command]:
    """Return a decorator that adds the options of period and velocity estimate, and the argument of a scene file.

    The command receives a `RecordLoop` as ``loop``. With ``logs``, the arguments are logs, one of which may be a scene
    file, and the command receives the paths of the others as ``logs``.
    """
    paths = ("period", "rate", *(path for path in (*CHOICES, *OF_PARTS) if path.startswith("velocity.")))
    take = take_options("loop", paths, _make_loop)

    def decorate(command: Command) -> Command:
        made = take(command)
        if not logs:
            return scene_argument(made)

        @wraps(made)
        def with_files(files: tuple[Path, ...], **given: Any) -> Any:
            scenes = [file for file in files if _is_scene(file)]
            if len(scenes) > 1:
                raise click.UsageError(f"got {len(scenes)} scene files; give at most one")
            given["logs"] = tuple(file for file in files if file not in scenes)
            return made(scene_file=scenes[0] if scenes else None, **given)

        return click.argument("files", metavar="[LOG.csv]... [SCENE.yaml|DIR]", nargs=-1, type=PATH)(with_files)

    return decorate


def log_options(command: Command) -> Command:
    """Return a command with the options for the columns of a log, the encoder step and the motor constant added."""
    for name, text in reversed(OF_LOGS.items()):
        command = click.option(name_option(name), help=text)(command)
    return command


def read_logs(
    logs: Iterable[Path], loop: RecordLoop, *, resolution: str | None, motor_constant: str | None, **columns: Any
) -> list[Any]:
    """Return the recorded motion of each log; print the names of long logs to the error stream.

    Args:
        logs: paths of the logs.
        loop: loop of the logs; the period of its scene replaces a missing column of times.
        resolution: text of the option, or None; the default is the value of the scene file.
        motor_constant: text of the option, or None.
        columns: texts of the other `log_options`.
    """
    if columns["time"] is not None and loop.period is not None:
        raise click.UsageError("give one of --time, --period and --rate")
    from zwidth.identification.columns import read_log

    for log in logs:
        size = log.stat().st_size if log.is_file() else 0
        if size > _LONG:
            click.echo(f"zwidth: reading {log.name}, {size / 2**20:.0f} MiB; the results follow", err=True)
    options = {"period": loop.period, "usual_period": loop.known_period, "motor_constant": motor_constant}
    options["resolution"] = resolution or get_hardware().get("resolution")
    motions = [read_log(log, columns, **options) for log in logs]
    for motion in motions:
        loop.check_kind(motion.rotary)
    return motions
