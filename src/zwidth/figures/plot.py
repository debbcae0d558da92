"""Pictures of scenes, into an Axes of yours or pyplot's current one: each function returns its Axes.

    region      stable walls, islands and holes, with the stiffest wall and the passive set
    ridge       the stiffest stable wall over a parameter of the scene
    step        the response to a step of force
    bode        size and phase of the open loop over frequency, with its margins
    nyquist     the open loop around -1, with its gain crossover
    poles       in the unit circle
    motion      a simulated motion: position and velocity over time
    recommendation  the wall to set among the stable ones, and its response to a step of force

Without an Axes they draw into ``matplotlib.pyplot.gca()``; those with two panels make a figure of pyplot's. The look is
applied while drawing; matplotlib's settings stay as they are. ``zwidth.figures.save(ax, path)`` or
``ax.figure.savefig(path)`` write it.
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

from zwidth.arrays.evaluate import as_float64
from zwidth.figures import style
from zwidth.figures.grid import scale_axis
from zwidth.figures.motion import draw_motion, draw_positions, draw_step
from zwidth.figures.stable_set import draw_stable_set, scale_walls, tabulate_sets, tabulate_walls
from zwidth.figures.table import Parameters, Result, Table, name_as_linear, stack
from zwidth.loops.linear.passivity import find_unsupported_reason
from zwidth.loops.rigid.response import settling_time
from zwidth.parts.checks import read_texts
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.wall import resolve_wall
from zwidth.scenes.assessment import passive_edge, round_margin
from zwidth.scenes.base import check_scene, of_scene
from zwidth.scenes.recommendation import Recommendation
from zwidth.scenes.scene import Scene
from zwidth.simulation.result import Motion
from zwidth.words.errors import InputError
from zwidth.words.formatting import name_wall
from zwidth.words.quantities import PARAMETERS
from zwidth.words.types import ArrayLike

_ANGLES = 181
_FREQUENCIES = 2000
_PERIODS, _MOST_PERIODS = 100, 20_000


__all__ = ["bode", "motion", "nyquist", "poles", "recommendation", "region", "ridge", "step"]


def __dir__() -> list[str]:
    """Its own names, and not those that it imports."""
    return sorted(__all__)


def _draws(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function to draw in the house style, in the units of its first argument."""

    @wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        owner = args[0] if args else next(iter(kwargs.values()), None)
        with style.house_style(getattr(owner, "unit_system", None)):
            return function(*args, **kwargs)

    return within


def _draws_scene(
    function: Callable[Concatenate[Scene, Parameters], Result],
) -> Callable[Concatenate[Scene, Parameters], Result]:
    """Wrap a function of a scene as `_draws` does, and check the scene."""
    return of_scene(_draws(function))


def _axes(ax: Axes | None) -> Axes:
    """The Axes to draw into; pyplot is loaded where it is asked for its own, of a new figure if it has none."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.gca() if plt.get_fignums() else plt.figure(layout="constrained").gca()


def _two(axes: style.AnyAxes | None, rows: int, columns: int, size: tuple[float, float] | None) -> np.ndarray:
    """Two Axes to draw into, of a new figure of pyplot's where none are given."""
    if axes is None:
        import matplotlib.pyplot as plt

        axes = plt.figure(figsize=size, layout="constrained").subplots(rows, columns, sharex=rows == 2)
    return np.asarray(axes, dtype=object).ravel()[:2]


def _complex_plane(ax: Axes | None, real: tuple[float, float], imaginary: tuple[float, float]) -> Axes:
    """Complex numbers in an Axes, with the unit circle."""
    ax = _axes(ax)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor=style.BLACK, linewidth=0.7))
    ax.set(xlim=real, ylim=imaginary, xlabel="real part", ylabel="imaginary part", aspect="equal")
    return ax


@_draws
def region(
    scene: Scene | Mapping[str, Scene], ax: Axes | None = None, *, normalized: bool = False, passive: bool = False
) -> Axes:
    """Draw the stable walls of a scene, or of several by their labels, with the stiffest of each.

    Args:
        scene: one, or a mapping from labels to scenes.
        ax: an Axes of yours; pyplot's current one where left out.
        normalized: over alpha and beta in place of K and B.
        passive: also the walls that are passive, with stiffness > 0 (dash-dotted).

    Returns:
        The Axes. Solid: the largest outline; dashed: islands; dotted: holes; what is stable is shaded.

    Raises:
        InputError: one is no scene; or no passivity condition holds for it, with ``passive``.
    """
    scenes = scene if isinstance(scene, Mapping) else {"": scene}
    for each in scenes.values():
        check_scene(each)
    outlines, walls = tabulate_sets(scenes)
    edges = [_trace_passive(each, label) for label, each in (scenes if passive else {}).items()]
    return draw_stable_set(stack([outlines, *edges]), walls, _axes(ax), normalized=normalized)[0]


def _trace_passive(scene: Scene, label: str = "") -> dict[str, Any]:
    """The outline of the passive walls, as columns beside those of `tabulate_sets`."""
    edge = tabulate_walls(scene, *passive_edge(scene, _ANGLES))
    return {"label": label, "number": 0, "piece": "passive", **edge}


@_draws
def recommendation(
    found: Recommendation, axes: style.AnyAxes | None = None, *, response: Table | None = None
) -> np.ndarray:
    """Draw the wall that `zwidth.Scene.recommend` found among the stable ones, and its response to a step of 1 N.

    Args:
        found: what it returned; without a wall the stable walls alone are drawn.
        axes: an Axes of yours for the walls alone, or two; a figure of pyplot's where left out.
        response: columns of a step study of this wall, in SI units; computed at the samples where left out.
    """
    scene, verdict, told = found.scene, found.verdict, found.as_dict()["recommended"]
    # Without a model there is no response.
    moves = not isinstance(scene.device, MeasuredDevice)
    if axes is None:
        axes = _two(None, 1, 2, (style.WIDTH, 3.5)) if verdict is not None and moves else _axes(None)
    panels = _two(axes, 1, 2, None)
    outlines, walls = tabulate_sets({"": scene})
    if not find_unsupported_reason(**vars(scene.device)) and scene.device.damping > 0:
        outlines = stack([outlines, _trace_passive(scene)])
    if verdict is None:
        return draw_stable_set(outlines, walls, panels[:1])
    K, B = found.stiffness, found.virtual_damping
    named = {"label": "", "wall": f"recommended ({100 * told['stiffness_fraction']:.3g} %)", "digits": told["digits"]}
    walls = stack([{**walls, "digits": 4}, {**named, **tabulate_walls(scene, K, B)}])
    draw_stable_set(outlines, walls, panels[:1])
    (spring, damper), _ = scale_walls([outlines, walls])
    interval = np.array([verdict.virtual_damping_lower, verdict.virtual_damping_upper])
    look = {"color": style.GRAY, "linewidth": 1.0, "label": "virtual_damping_interval"}
    panels[0].plot([K * spring] * 2, interval * damper, **look)
    if response is None and moves:
        # As long as the slowest motion takes to decay, or so many periods.
        periods = int(min(max(_PERIODS, 1.5 * (told["decay_time"] or 0.0) / scene.timing.period), _MOST_PERIODS))
        columns = _tabulate_step(scene, K, B, periods)
        if not scene.parts_beyond:
            wall = verdict.alpha, verdict.beta, float(scene.delta), float(scene.d)
            columns["settling_time_s"] = settling_time(*wall) * scene.timing.period
        response = stack([columns])
    for ax in panels[1:] if response is not None else ():
        _draw_response(ax, name_as_linear(response))
    style.letter(panels)
    return panels


def _draw_response(ax: Axes, response: Table) -> None:
    """Positions over time, and when they have settled."""
    clock, unit = draw_positions(ax, response)
    time = np.asarray(response["time_s"])
    ax.set(xlim=(0.0, float(time[-1] + time[1]) * clock), xlabel=f"time  $t$  in {unit}")
    settled = float(response["settling_time_s"][0]) if "settling_time_s" in response else math.nan
    if settled <= time[-1]:
        dot = Line2D([], [], linestyle="", marker="o", markersize=4.5, color=ax.lines[0].get_color())
        text = f"settled to 2 % after {settled * clock:.3g} {unit}"
        ax.legend([dot], [text], loc="lower right", handletextpad=0.2)


@_draws_scene
def ridge(scene: Scene, parameter: str, values: ArrayLike, ax: Axes | None = None) -> Axes:
    """Draw the stiffest stable wall over one parameter of a scene, all others as they are.

    Args:
        scene: the scene.
        parameter: its dotted path, as in `zwidth.Scene.replace`: "damping", "velocity.cutoff", ...
        values: of it, in SI units.
        ax: an Axes of yours; pyplot's current one where left out.
    """
    known = PARAMETERS.get(parameter)
    grid = as_float64("values", read_texts("values", values, scene.unit_system[known.unit]) if known else values)
    if grid.ndim != 1 or not grid.size:
        raise InputError(f"values: got shape {grid.shape}; a list of values of {parameter} is needed")
    walls = [scene.replace(**{parameter: value}).max_stiffness() for value in grid.tolist()]
    top, spelled = np.array([float(wall.stiffness) for wall in walls]), known.unit if known else "1"
    if scene.unit_system[spelled] != spelled:
        scale, spelled = style.si_unit(grid, spelled)
        grid = scale * grid
    ax = _axes(ax)
    factor, unit = style.si_unit(top, "N/m")
    whole = known is not None and known.whole
    ax.plot(grid, top * factor, color=style.BLUE, label="stiffest stable wall", **(style.POINTS if whole else {}))
    if not whole:
        ax.fill_between(grid, 0.0, top * factor, color=style.BLUE, alpha=0.08, linewidth=0.0)
    words = known.label_in(scene.unit_system) if known else style.literal(parameter)
    words += f"  in {spelled}" if spelled not in ("", "1") else ""
    ax.set(xlabel=words, ylabel=rf"stiffest stable wall  $K_{{\max}}$  in {unit}", ylim=(0.0, None))
    scale_axis(ax, "x", grid)
    if whole and ax.get_xscale() == "linear":
        ax.set_xlim(*style.span(float(grid.min()), float(grid.max())))
    return ax


@_draws_scene
def step(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
    *,
    periods: int = 100,
) -> Axes:
    """Draw the response of the device, in contact with a wall, to a force of 1 N on it, at the samples.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours; pyplot's current one where left out.
        periods: how many sampling periods.
    """
    K, B = map(float, resolve_wall(scene.wall, stiffness, virtual_damping, scene.unit_system))
    drawn = draw_step(stack([_tabulate_step(scene, K, B, periods)]), _axes(ax))[0]
    drawn.lines[0].set(marker=".", markersize=3)
    return drawn


def _tabulate_step(scene: Scene, stiffness: float, virtual_damping: float, periods: int) -> dict[str, Any]:
    """The response to 1 N at the samples, as columns of a step study."""
    label = name_wall(stiffness, virtual_damping, scene.unit_system)
    columns = {**tabulate_walls(scene, stiffness, virtual_damping), "label": label}
    columns["time_s"] = np.arange(periods) * scene.timing.period
    columns["position_m"] = scene.state_space(stiffness, virtual_damping).step(periods)
    return columns | {"final_position_m": 1.0 / stiffness if stiffness else math.nan}


def _frequencies(scene: Scene) -> np.ndarray:
    """Frequencies in Hz that resolve an open loop, up to half the sampling rate."""
    if isinstance(scene.device, MeasuredDevice):
        return scene.device.frequency
    half = 0.5 / float(scene.timing.period)
    slow, fast = np.geomspace(1e-4 * half, 0.05 * half, _FREQUENCIES), np.linspace(0.05 * half, half, _FREQUENCIES)
    return np.concatenate([slow, fast[1:]])


@_draws_scene
def bode(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    axes: style.AnyAxes | None = None,
) -> np.ndarray:
    """Draw size and phase of the open loop of a wall over frequency, with its gain and phase margin.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        axes: two Axes of yours; a figure of pyplot's where left out.

    Returns:
        The Axes of size and phase; bars mark the margins where they are taken, as `zwidth.Scene.margins` has them.
    """
    hertz = _frequencies(scene)
    found = scene.frequency_response(stiffness, virtual_damping, hertz)
    known = scene.margins(stiffness, virtual_damping)
    upper, lower = _two(axes, 2, 1, None)
    gain, phase = float(known.gain_margin), float(known.phase_margin)
    stable = bool(scene.is_stable(stiffness, virtual_damping))
    read = {name: round_margin(f"{name}_margin", known, stable, 3) for name in ("gain", "phase")}
    at_phase, at_gain = float(known.gain_crossover), float(known.phase_crossover)
    # The turn that the margin is measured from, where the phase crosses -180 degrees.
    angles = np.unwrap(np.angle(found))
    angles = np.degrees(angles - 2.0 * np.pi * np.round((angles[0] + np.pi) / (2.0 * np.pi)))
    upper.plot(hertz, np.abs(found), color=style.BLUE, label="$|L|$")
    lower.plot(hertz, angles, color=style.BLUE, label="phase of $L$")
    upper.axhline(1.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    lower.axhline(-180.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    bar: dict[str, Any] = {"color": style.VERMILION, "marker": "_", "markersize": 7, "zorder": 4}
    if np.isfinite(gain) and gain > 0:
        upper.plot([at_gain] * 2, [1.0, 1.0 / gain], label=f"gain margin {read['gain']:.3g}", **bar)
    if np.isfinite(phase):
        there = float(np.interp(at_phase, hertz, angles))
        foot = there - (there + 180.0 + 180.0) % 360.0 + 180.0
        lower.plot([at_phase] * 2, [foot, there], label=f"phase margin {read['phase']:.3g}°", **bar)
    upper.set(yscale="log", ylabel="$|L|$")
    for ax in (upper, lower):
        style.use_logarithmic(ax, "x", hertz, style.DECADES)
        ax.set_xlim(hertz[0], hertz[-1])
        ax.legend(loc="lower left", fontsize=7.5)
    lower.set(xlabel="frequency  $f$  in Hz", ylabel="phase of $L$  in degrees")
    return np.array([upper, lower])


@_draws_scene
def nyquist(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the open loop of a wall over frequency, with the point -1 that it must leave on its left.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours; pyplot's current one where left out.

    Returns:
        The Axes; a dot marks each gain crossover, where the loop meets the unit circle.
    """
    found = scene.frequency_response(stiffness, virtual_damping, _frequencies(scene))
    ax = _complex_plane(ax, (-2.6, 1.6), (-2.2, 2.0))
    ax.plot(found.real, found.imag, color=style.BLUE, label="open loop $L$, up to half the sampling rate")
    size = np.abs(found)
    k = np.flatnonzero((size[:-1] > 1.0) != (size[1:] > 1.0))
    share = np.log(size[k]) / (np.log(size[k]) - np.log(size[k + 1]))
    crossing = found[k] + share * (found[k + 1] - found[k])
    ax.plot(crossing.real, crossing.imag, "o", color=style.BLUE, markersize=4.5, label="gain crossover")
    ax.plot(-1.0, 0.0, "x", color=style.VERMILION, markersize=7, markeredgewidth=1.8, label="$-1$")
    ax.legend(loc="lower right", fontsize=7)
    return ax


@_draws_scene
def poles(
    scene: Scene,
    stiffness: float | str | None = None,
    virtual_damping: float | str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the poles of the loop with a wall, in the unit circle.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours; pyplot's current one where left out.
    """
    found: Any = np.asarray(scene.poles(stiffness, virtual_damping)).ravel()
    outside = np.abs(found) >= 1.0
    reach = 1.15 * max(1.0, float(np.abs(found).max()))
    ax = _complex_plane(ax, (-reach, reach), (-reach, reach))
    looks = (~outside, style.BLUE, "x", "inside"), (outside, style.VERMILION, "D", "not inside")
    for mask, color, mark, words in looks:
        if mask.any():
            ax.plot(found[mask].real, found[mask].imag, mark, color=color, markersize=6, label=f"poles {words}")
    ax.legend(loc="upper left", fontsize=7)
    return ax


@_draws
def motion(found: Motion, ax: Axes | None = None, *, labels: Sequence[str] = ()) -> Axes:
    """Draw the position of one simulated motion, or of several, over time.

    Args:
        found: what `zwidth.simulate` returns, recorded.
        ax: an Axes of yours; pyplot's current one where left out.
        labels: a name for each of several, in their order.
    """
    if not hasattr(found, "wall_force"):
        raise InputError(f"found: got {type(found).__name__}; give what zwidth.simulate returns")
    if found.position is None or found.time is None:
        raise InputError("found: got a motion that was not recorded; simulate with record=True")
    rows = found.position.reshape(-1, found.position.shape[-1])
    if labels and len(labels) != len(rows):
        raise InputError(f"labels: got {len(labels)} for {len(rows)} motions; give one for each")
    times = np.broadcast_to(found.time.reshape(-1, rows.shape[-1]), rows.shape)
    contact = found.contact.reshape(len(rows), -1)
    touching = np.repeat(contact, rows.shape[-1] // contact.shape[-1], axis=1)
    columns = zip(list(labels) or [""] * len(rows), times, rows, touching, strict=True)
    names = ("label", "time_s", "position_m", "contact")
    return draw_motion(stack(dict(zip(names, each, strict=True)) for each in columns), _axes(ax))[0]
