"""Draw figures of scenes into an existing Axes or pyplot's current one; each function returns its Axes.

    region          stable walls, islands and holes, with the stiffest wall and the passive set
    ridge           maximum stiffness over a parameter of the scene
    step            response to a step of force
    bode            magnitude and phase of the open loop over frequency, with its margins
    nyquist         open loop around -1, with its gain crossover
    poles           poles and the unit circle
    motion          position of a simulated motion over time
    recommendation  recommended wall among the stable ones, and its response to a step of force

Without an Axes, the functions draw into ``matplotlib.pyplot.gca()``; functions with two panels create a pyplot figure.
The house style applies while drawing; matplotlib's settings do not change. Use ``zwidth.plotting.save(ax, path)`` or
``ax.figure.savefig(path)`` to write the figure. A *scene* (`zwidth.Scene`) is a device with its timing and, optionally,
wall. K and B are the stiffness and the virtual damping of a wall, L is the open loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, Concatenate

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from zwidth.analysis.assessment import round_margin, trace_passivity_boundary
from zwidth.analysis.base import check_scene, wrap_function
from zwidth.analysis.recommendation import Recommendation
from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError
from zwidth.core.types import ArrayLike
from zwidth.model.checks import read_texts
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.wall import resolve_wall
from zwidth.numerics.evaluate import as_float64
from zwidth.plotting import style
from zwidth.plotting.grid import scale_axis
from zwidth.plotting.motion import draw_motion, draw_positions, draw_step
from zwidth.plotting.stable_set import draw_stable_set, scale_walls, tabulate_sets, tabulate_walls
from zwidth.plotting.table import Parameters, Result, Table, name_as_linear, stack
from zwidth.simulation.result import Motion
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.stability.rigid.step_response import settling_time
from zwidth.units.formatting import format_wall
from zwidth.units.quantities import PARAMETERS

N_ANGLES = 181  # number of points on the outline of the passive walls
# Number of frequencies of an open loop on each of two grids up to the Nyquist frequency, one logarithmic and one
# linear.
N_FREQUENCIES = 2000
MIN_PERIODS = 100  # least number of sampling periods in the step response of a recommended wall
MAX_PERIODS = 20_000  # largest number of sampling periods in the step response of a recommended wall

__all__ = ["bode", "motion", "nyquist", "poles", "recommendation", "region", "ridge", "step"]


def __dir__() -> list[str]:
    """Return the names of the public functions, without the names that this module imports."""
    return sorted(__all__)


def _with_house_style(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function so that it draws in the house style, in the unit system of its first argument."""

    @wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        owner: Any = args[0] if args else next(iter(kwargs.values()), None)
        # The scenes of a mapping have the same units; `region` rejects others.
        owner = next(iter(owner.values()), None) if isinstance(owner, Mapping) else owner
        with style.house_style(getattr(owner, "unit_system", None)):
            return function(*args, **kwargs)

    return within


def _with_checked_scene(
    function: Callable[Concatenate[Scene, Parameters], Result],
) -> Callable[Concatenate[Scene, Parameters], Result]:
    """Wrap a function so that it raises an error if its first argument is not a scene, and draws in the house style."""
    return wrap_function(_with_house_style(function))


def _choose_axes(ax: Axes | None) -> Axes:
    """Return the Axes to draw into: the given one, or pyplot's current one."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.gca() if plt.get_fignums() else plt.figure(layout="constrained").gca()


def _choose_two_axes(
    axes: style.AnyAxes | None, rows: int, columns: int, size: tuple[float, float] | None
) -> np.ndarray:
    """Return the Axes to draw into: at most two of the given ones, or those of a new pyplot figure.

    Args:
        axes: Existing Axes, or None for a new figure.
        rows: Number of rows of panels in a new figure.
        columns: Number of columns of panels in a new figure.
        size: Size of a new figure in inches; None for the default.
    """
    if axes is None:
        import matplotlib.pyplot as plt

        axes = plt.figure(figsize=size, layout="constrained").subplots(rows, columns, sharex=rows == 2)
    return np.asarray(axes, dtype=object).ravel()[:2]


def _make_complex_plane(ax: Axes | None, real: tuple[float, float], imaginary: tuple[float, float]) -> Axes:
    """Prepare an Axes as the complex plane with the unit circle, for given ranges of real and imaginary parts."""
    ax = _choose_axes(ax)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor=style.BLACK, linewidth=0.7))
    ax.set(xlim=real, ylim=imaginary, xlabel="real part", ylabel="imaginary part", aspect="equal")
    return ax


@_with_house_style
def region(
    scene: Scene | Mapping[str, Scene], ax: Axes | None = None, *, normalized: bool = False, passive: bool = False
) -> Axes:
    """Draw the stable walls of one or several scenes, with the stiffest wall of each.

    Args:
        scene: A scene, or a mapping from labels to scenes.
        ax: An existing Axes. Default: pyplot's current one.
        normalized: Use axes of alpha and beta in place of K and B.
        passive: Also draw the passive walls with stiffness > 0 (dash-dotted).

    Returns:
        The Axes. Stable walls are shaded; the largest outline is solid, outlines of islands dashed, of holes dotted.

    Raises:
        InputError: if a value is no scene, if both linear and rotary devices are given, or if ``passive`` is set and a
            scene has no passivity condition.
    """
    scenes = scene if isinstance(scene, Mapping) else {"": scene}
    for each in scenes.values():
        check_scene(each)
    if len({each.unit_system.rotary for each in scenes.values()}) > 1:
        raise InputError(
            "scene: got linear and rotary devices, whose stiffnesses have different units; draw them apart"
        )
    outlines, walls = tabulate_sets(scenes)
    edges = [_trace_passive(each, label) for label, each in (scenes if passive else {}).items()]
    return draw_stable_set(stack([outlines, *edges]), walls, _choose_axes(ax), normalized=normalized)[0]


def _trace_passive(scene: Scene, label: str = "") -> dict[str, Any]:
    """Return the outline of the passive walls, with the columns of `tabulate_sets`."""
    edge = tabulate_walls(scene, *trace_passivity_boundary(scene, N_ANGLES))
    return {"label": label, "number": 0, "piece": "passive", **edge}


@_with_house_style
def recommendation(
    recommendation: Recommendation, axes: style.AnyAxes | None = None, *, response: Table | None = None
) -> np.ndarray:
    """Draw a recommended wall among the stable ones, and its response to a step of 1 N.

    Args:
        recommendation: Result of `zwidth.Scene.recommend`; if it has no wall, only the stable walls are drawn.
        axes: An existing Axes for the walls only, or two. Default: a pyplot figure.
        response: Columns of a step study of this wall, in SI units. Default: computed at the samples.
    """
    scene, verdict, recommended = recommendation.scene, recommendation.verdict, recommendation.as_dict()["recommended"]
    # Omit the step response of a measured device, because it can only be computed from a model.
    has_model = not isinstance(scene.device, MeasuredDevice)
    if axes is None:
        axes = (
            _choose_two_axes(None, 1, 2, (style.WIDTH, 3.5))
            if verdict is not None and has_model
            else _choose_axes(None)
        )
    panels = _choose_two_axes(axes, 1, 2, None)
    outlines, walls = tabulate_sets({"": scene})
    if not find_obstacle(scene) and scene.device.damping > 0:
        outlines = stack([outlines, _trace_passive(scene)])
    if verdict is None:
        return draw_stable_set(outlines, walls, panels[:1])
    K, B = recommendation.stiffness, recommendation.virtual_damping
    row = {
        "label": "",
        "wall": f"recommended ({100 * recommended['stiffness_fraction']:.3g} %)",
        "digits": recommended["digits"],
    }
    walls = stack([{**walls, "digits": 4}, {**row, **tabulate_walls(scene, K, B)}])
    draw_stable_set(outlines, walls, panels[:1])
    (spring, damper), _ = scale_walls([outlines, walls])
    interval = np.array([verdict.virtual_damping_lower, verdict.virtual_damping_upper])
    look = {"color": style.GRAY, "linewidth": 1.0, "label": "virtual_damping_interval"}
    panels[0].plot([K * spring] * 2, interval * damper, **look)
    shown = panels[0].get_legend()
    handles = [*(shown.legend_handles if shown else ()), style.line("stable $B$ at this $K$", width=1.0)]
    style.legend(panels, handles, outside=False, loc="upper right")
    if response is None and has_model:
        # Simulate one and a half times the decay time of the dominant pole, within MIN_PERIODS and MAX_PERIODS.
        periods = int(
            min(max(MIN_PERIODS, 1.5 * (recommended["decay_time"] or 0.0) / scene.timing.period), MAX_PERIODS)
        )
        columns = _tabulate_step(scene, K, B, periods)
        if not scene.nonrigid_parts:
            wall = verdict.alpha, verdict.beta, float(scene.delta), float(scene.d)
            columns["settling_time_s"] = settling_time(*wall) * scene.timing.period
        response = stack([columns])
    for ax in panels[1:] if response is not None else ():
        _draw_response(ax, name_as_linear(response))
    style.letter(panels)
    return panels


def _draw_response(ax: Axes, response: Table) -> None:
    """Draw the position of a step response over time, and mark its settling time if the table contains it."""
    clock, unit = draw_positions(ax, response)
    time = np.asarray(response["time_s"])
    ax.set(xlim=(0.0, float(time[-1] + time[1]) * clock), xlabel=f"time  $t$  in {unit}")
    settled = float(response["settling_time_s"][0]) if "settling_time_s" in response else math.nan
    if settled <= time[-1]:
        dot = Line2D([], [], linestyle="", marker="o", markersize=4.5, color=ax.lines[0].get_color())
        text = f"settled to 2 % after {settled * clock:.3g} {unit}"
        ax.legend([dot], [text], loc="lower right", handletextpad=0.2)


@_with_checked_scene
def ridge(scene: Scene, parameter: str, values: ArrayLike, ax: Axes | None = None) -> Axes:
    """Draw the maximum stiffness over one parameter of a scene.

    Args:
        scene: The scene.
        parameter: Dotted path as in `zwidth.Scene.replace`, such as "damping" or "velocity.cutoff".
        values: Values of the parameter in SI units.
        ax: An existing Axes. Default: pyplot's current one.
    """
    quantity = PARAMETERS.get(parameter)
    grid = as_float64("values", read_texts("values", values, scene.unit_system[quantity.unit]) if quantity else values)
    if grid.ndim != 1 or not grid.size:
        raise InputError(f"values: got shape {grid.shape}; pass a list of values of {parameter}")
    walls = [scene.replace(**{parameter: value}).max_stiffness() for value in grid.tolist()]
    top, value_unit = np.array([float(wall.stiffness) for wall in walls]), quantity.unit if quantity else "1"
    if scene.unit_system[value_unit] != value_unit:
        scale, value_unit = style.si_unit(grid, value_unit)
        grid = scale * grid
    ax = _choose_axes(ax)
    factor, unit = style.si_unit(top, "N/m")
    whole = quantity is not None and quantity.whole
    ax.plot(grid, top * factor, color=style.BLUE, label="stiffest stable wall", **(style.POINTS if whole else {}))
    if not whole:
        ax.fill_between(grid, 0.0, top * factor, color=style.BLUE, alpha=0.08, linewidth=0.0)
    words = quantity.label_in(scene.unit_system) if quantity else style.literal(parameter)
    words += f"  in {value_unit}" if value_unit not in ("", "1") else ""
    ax.set(xlabel=words, ylabel=rf"maximum stable stiffness  $K_{{\max}}$  in {unit}", ylim=(0.0, None))
    scale_axis(ax, "x", grid)
    if whole and ax.get_xscale() == "linear":
        ax.set_xlim(*style.span(float(grid.min()), float(grid.max())))
    return ax


@_with_checked_scene
def step(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
    *,
    periods: int = 100,
) -> Axes:
    """Draw the response of the device in a wall to a step of 1 N, at the samples.

    Args:
        scene: The scene.
        stiffness: K of the wall in N/m. Default of K and B: the wall of the scene.
        virtual_damping: B of the wall in N s/m.
        ax: An existing Axes. Default: pyplot's current one.
        periods: Number of sampling periods.
    """
    K, B = map(float, resolve_wall(scene.wall, stiffness, virtual_damping, scene.unit_system))
    drawn = draw_step(stack([_tabulate_step(scene, K, B, periods)]), _choose_axes(ax))[0]
    drawn.lines[0].set(marker=".", markersize=3)
    return drawn


def _tabulate_step(scene: Scene, stiffness: float, virtual_damping: float, periods: int) -> dict[str, Any]:
    """Return the response of a scene with a wall (K, B) to a step of 1 N at the samples, as columns of a step study."""
    label = format_wall(stiffness, virtual_damping, scene.unit_system)
    columns = {**tabulate_walls(scene, stiffness, virtual_damping), "label": label}
    columns["time_s"] = np.arange(periods) * scene.timing.period
    columns["position_m"] = scene.state_space(stiffness, virtual_damping).step(periods)
    return columns | {"final_position_m": 1.0 / stiffness if stiffness else math.nan}


def _choose_frequencies(scene: Scene) -> np.ndarray:
    """Return a grid of frequencies in Hz that resolves an open loop; for a measured response, its own frequencies."""
    if isinstance(scene.device, MeasuredDevice):
        return scene.device.frequency
    nyquist_frequency = 0.5 / float(scene.timing.period)
    slow, fast = (
        np.geomspace(1e-4 * nyquist_frequency, 0.05 * nyquist_frequency, N_FREQUENCIES),
        np.linspace(0.05 * nyquist_frequency, nyquist_frequency, N_FREQUENCIES),
    )
    return np.concatenate([slow, fast[1:]])


@_with_checked_scene
def bode(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    axes: style.AnyAxes | None = None,
) -> np.ndarray:
    """Draw magnitude and phase of the open loop of a wall over frequency, with its gain and phase margin.

    Args:
        scene: The scene.
        stiffness: K of the wall in N/m. Default of K and B: the wall of the scene.
        virtual_damping: B of the wall in N s/m.
        axes: Two existing Axes. Default: a pyplot figure.

    Returns:
        The Axes of magnitude and phase; bars mark the margins of `zwidth.Scene.margins`.
    """
    hertz = _choose_frequencies(scene)
    L = scene.frequency_response(stiffness, virtual_damping, hertz)
    margins = scene.margins(stiffness, virtual_damping)
    upper, lower = _choose_two_axes(axes, 2, 1, None)
    gain, phase = float(margins.gain_margin), float(margins.phase_margin)
    stable = bool(scene.is_stable(stiffness, virtual_damping))
    rounded = {name: round_margin(f"{name}_margin", margins, stable, 3) for name in ("gain", "phase")}
    gain_crossover, phase_crossover = float(margins.gain_crossover), float(margins.phase_crossover)
    # Shift the phase by a multiple of 360 degrees to start between -360 and 0, because its branch is arbitrary.
    angles = np.unwrap(np.angle(L))
    angles = np.degrees(angles - 2.0 * np.pi * np.round((angles[0] + np.pi) / (2.0 * np.pi)))
    upper.plot(hertz, np.abs(L), color=style.BLUE, label="$|L|$")
    lower.plot(hertz, angles, color=style.BLUE, label="phase of $L$")
    upper.axhline(1.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    lower.axhline(-180.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    bar: dict[str, Any] = {"color": style.VERMILION, "marker": "_", "markersize": 7, "zorder": 4}
    if np.isfinite(gain) and gain > 0:
        upper.plot([phase_crossover] * 2, [1.0, 1.0 / gain], label=f"gain margin {rounded['gain']:.3g}", **bar)
    if np.isfinite(phase):
        angle = float(np.interp(gain_crossover, hertz, angles))
        # Start the bar at the odd multiple of 180 degrees that is nearest to the phase, because there L is real and
        # negative.
        foot = angle - (angle + 180.0 + 180.0) % 360.0 + 180.0
        lower.plot([gain_crossover] * 2, [foot, angle], label=f"phase margin {rounded['phase']:.3g}°", **bar)
    upper.set(yscale="log", ylabel="$|L|$")
    for ax in (upper, lower):
        style.use_logarithmic(ax, "x", hertz, style.DECADES)
        ax.set_xlim(hertz[0], hertz[-1])
        ax.legend(loc="lower left", fontsize=7.5)
    lower.set(xlabel="frequency  $f$  in Hz", ylabel="phase of $L$  in degrees")
    return np.array([upper, lower])


@_with_checked_scene
def nyquist(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the Nyquist plot of the open loop of a wall, with the point -1.

    With increasing frequency, the curve of a stable loop has the point -1 on its left.

    Args:
        scene: The scene.
        stiffness: K of the wall in N/m. Default of K and B: the wall of the scene.
        virtual_damping: B of the wall in N s/m.
        ax: An existing Axes. Default: pyplot's current one.

    Returns:
        The Axes; a dot marks each gain crossover, an intersection with the unit circle.
    """
    L = scene.frequency_response(stiffness, virtual_damping, _choose_frequencies(scene))
    ax = _make_complex_plane(ax, (-2.6, 1.6), (-2.2, 2.0))
    ax.plot(L.real, L.imag, color=style.BLUE, label="open loop $L$, up to the Nyquist frequency")
    size = np.abs(L)
    k = np.flatnonzero((size[:-1] > 1.0) != (size[1:] > 1.0))
    share = np.log(size[k]) / (np.log(size[k]) - np.log(size[k + 1]))
    crossing = L[k] + share * (L[k + 1] - L[k])
    ax.plot(crossing.real, crossing.imag, "o", color=style.BLUE, markersize=4.5, label="gain crossover")
    ax.plot(-1.0, 0.0, "x", color=style.VERMILION, markersize=7, markeredgewidth=1.8, label="$-1$")
    ax.legend(loc="lower right", fontsize=7)
    return ax


@_with_checked_scene
def poles(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the poles of the closed loop with a wall, and the unit circle.

    Args:
        scene: The scene.
        stiffness: K of the wall in N/m. Default of K and B: the wall of the scene.
        virtual_damping: B of the wall in N s/m.
        ax: An existing Axes. Default: pyplot's current one.
    """
    z: Any = np.asarray(scene.poles(stiffness, virtual_damping)).ravel()
    outside = np.abs(z) >= 1.0
    reach = 1.15 * max(1.0, float(np.abs(z).max()))
    ax = _make_complex_plane(ax, (-reach, reach), (-reach, reach))
    looks = (
        (~outside, style.BLUE, "x", "inside the unit circle"),
        (outside, style.VERMILION, "D", "on or outside the unit circle"),
    )
    for mask, color, mark, words in looks:
        if mask.any():
            ax.plot(z[mask].real, z[mask].imag, mark, color=color, markersize=6, label=f"poles {words}")
    ax.legend(loc="upper left", fontsize=7)
    return ax


@_with_house_style
def motion(motion: Motion, ax: Axes | None = None, *, labels: Sequence[str] = ()) -> Axes:
    """Draw the position of one or several simulated motions over time, and that of a simulated tool as a thin line.

    Args:
        motion: Result of `zwidth.simulate` with recorded positions.
        ax: An existing Axes. Default: pyplot's current one.
        labels: Names of several motions, in their order.
    """
    if not hasattr(motion, "wall_force"):
        raise InputError(f"motion: got {type(motion).__name__}; pass the result of zwidth.simulate")
    if motion.position is None or motion.time is None:
        raise InputError("motion: got a motion that was not recorded; simulate with record=True")
    rows = motion.position.reshape(-1, motion.position.shape[-1])
    if labels and len(labels) != len(rows):
        raise InputError(f"labels: got {len(labels)} for {len(rows)} motions; pass one for each")
    times = np.broadcast_to(motion.time.reshape(-1, rows.shape[-1]), rows.shape)
    contact = motion.contact.reshape(len(rows), -1)
    touching = np.repeat(contact, rows.shape[-1] // contact.shape[-1], axis=1)
    columns = {"label": list(labels) or [""] * len(rows), "time_s": times, "position_m": rows, "contact": touching}
    if motion.tool_position is not None:
        tool = motion.tool_position.reshape(len(rows), -1)
        columns["tool_position_m"] = np.repeat(tool, rows.shape[-1] // tool.shape[-1], axis=1)
    parts = (dict(zip(columns, each, strict=True)) for each in zip(*columns.values(), strict=True))
    return draw_motion(stack(parts), _choose_axes(ax))[0]
