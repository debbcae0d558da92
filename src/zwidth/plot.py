"""Pictures of scenes, straight into an Axes of yours or a new figure's: each function returns its Axes.

    region      stable walls, islands and holes, with the stiffest wall and the passive set
    ridge       the stiffest stable wall over a parameter of the scene
    step        the response to a step of force
    nyquist     the open loop around -1, with its gain crossover
    poles       in the unit circle
    motion      a simulated motion: position and velocity over time

The look is applied while drawing; matplotlib's settings stay as they are. An Axes without a figure of yours belongs to
one that pyplot does not know: ``zwidth.figures.save(ax, path)`` or ``ax.figure.savefig(path)`` write it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, PathPatch

from zwidth._types import ArrayLike
from zwidth.batching import as_float64
from zwidth.design.passive import passive_edge
from zwidth.errors import InputError
from zwidth.figures import style
from zwidth.figures.grid import logarithmic
from zwidth.figures.region import to_path
from zwidth.parts.wall import resolve_wall
from zwidth.quantities import PARAMETERS
from zwidth.scene import Scene
from zwidth.simulation.result import Motion
from zwidth.status import Status

_ANGLES = 181
_FREQUENCIES = 2000


def _axes(ax: Axes | None, width: float = 5.6, height: float = 4.0) -> Axes:
    return style.panels(ax, 1, width, height)[0]


def _complex_plane(ax: Axes | None, real: tuple[float, float], imaginary: tuple[float, float]) -> Axes:
    """Complex numbers in an Axes, with the unit circle."""
    ax = _axes(ax, 4.4, 4.2)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor=style.BLACK, linewidth=0.7))
    ax.set(xlim=real, ylim=imaginary, xlabel="real part", ylabel="imaginary part", aspect="equal")
    return ax


def _units(scene: Scene, normalized: bool, largest: float = math.nan) -> tuple[tuple[float, float], tuple[str, str]]:
    """What stiffness and damping are divided by, and the labels of their axes."""
    if normalized:
        return tuple(scene.units), (style.ALPHA_LABEL, style.BETA_LABEL)
    factor, unit = style.si_unit(largest, "N/m")
    return (1.0 / factor, 1.0), (f"stiffness  $K$  in {unit}", "virtual damping  $B$  in N s/m")


@style.house_style()
def region(
    scene: Scene | Mapping[str, Scene], ax: Axes | None = None, *, normalized: bool = False, passive: bool = False
) -> Axes:
    """Draw the stable walls of a scene, or of several by their labels, with the stiffest of each.

    Args:
        scene: one, or a mapping from labels to scenes.
        ax: an Axes of yours.
        normalized: over alpha and beta in place of K and B.
        passive: also the walls that are passive, with stiffness > 0 (dash-dotted).

    Returns:
        The Axes. Solid: outlines; islands and holes alike, what is stable is shaded.

    Raises:
        InputError: no passivity condition holds for the scene, with ``passive``.
    """
    scenes = dict(scene) if isinstance(scene, Mapping) else {"": scene}
    pieces = {label: each.stable_region() for label, each in scenes.items()}
    largest = max((float(np.max(part.stiffness)) for found in pieces.values() for part in found), default=1.0)
    ax = _axes(ax)
    names = _units(next(iter(scenes.values())), normalized, largest)[1]
    handles = []
    for k, (label, each) in enumerate(scenes.items()):
        (x_unit, y_unit), _ = _units(each, normalized, largest)
        color = style.DISTINCT[k % len(style.DISTINCT)]
        paths = [np.stack([part.stiffness / x_unit, part.virtual_damping / y_unit], -1) for part in pieces[label]]
        if paths:
            shape = to_path([(path, part.hole) for path, part in zip(paths, pieces[label], strict=True)])
            ax.add_patch(PathPatch(shape, facecolor=color, alpha=0.15, linewidth=0.0, zorder=1))
        for path in paths:
            ax.plot(*np.append(path, path[:1], 0).T, color=color, zorder=3, label=label or "edge of what is stable")
        top = each.max_stiffness()
        if top.status == Status.OK:
            at = top.stiffness / x_unit, top.virtual_damping / y_unit
            ax.plot(*at, "o", color=color, markersize=4.5, zorder=5, clip_on=False, label="stiffest stable wall")
        if passive:
            walls = passive_edge(each, _ANGLES)
            ax.plot(walls[0] / x_unit, walls[1] / y_unit, color=color, linestyle=style.DASH_DOTTED, zorder=3)
        handles.append(style.line(label or "stable", color=color))
    handles += [style.line("passive", style.DASH_DOTTED)] if passive else []
    handles.append(style.line("stiffest stable wall", "", marker="o", markersize=4.5))
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    ax.set(xlabel=names[0], ylabel=names[1])
    ax.margins(0.04)
    ax.legend(handles=handles, loc="best")
    return ax


@style.house_style()
def ridge(scene: Scene, parameter: str, values: ArrayLike, ax: Axes | None = None) -> Axes:
    """Draw the stiffest stable wall over one parameter of a scene, all others as they are.

    Args:
        scene: the scene.
        parameter: its dotted path, as in `zwidth.Scene.replace`: "damping", "velocity.cutoff", ...
        values: of it, in SI units.
        ax: an Axes of yours.
    """
    grid = as_float64("values", values)
    if grid.ndim != 1 or not grid.size:
        raise InputError(f"values: got shape {grid.shape}; a list of values of {parameter} is needed")
    walls = [scene.replace(**{parameter: value}).max_stiffness() for value in grid.tolist()]
    top = np.array([float(wall.stiffness) for wall in walls])
    ax = _axes(ax, 5.2, 3.6)
    factor, unit = style.si_unit(float(np.nanmax(top, initial=0.0)), "N/m")
    ax.plot(grid, top * factor, color=style.BLUE, label="stiffest stable wall")
    ax.fill_between(grid, 0.0, top * factor, color=style.BLUE, alpha=0.08, linewidth=0.0)
    known = PARAMETERS.get(parameter)
    words = f"{known.words}  ${known.symbol}$  in {known.unit}" if known else parameter
    ax.set(xlabel=words, ylabel=rf"stiffest stable wall  $K_{{\max}}$  in {unit}", ylim=(0.0, None))
    if logarithmic(grid):
        style.use_logarithmic(ax, "x", float(grid.min()), float(grid.max()))
    ax.margins(x=0.0)
    return ax


@style.house_style()
def step(
    scene: Scene,
    stiffness: float | None = None,
    virtual_damping: float | None = None,
    ax: Axes | None = None,
    *,
    periods: int = 100,
) -> Axes:
    """Draw the response of the device, in contact with a wall, to a force of 1 N on it, at the samples.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours.
        periods: how many sampling periods.
    """
    stiffness, virtual_damping = resolve_wall(scene.wall, stiffness, virtual_damping)
    loop = scene.state_space(stiffness, virtual_damping)
    state, positions = np.zeros(loop.A.shape[0]), np.empty(periods)
    for k in range(periods):
        positions[k] = (loop.C @ state)[0]
        state = loop.A @ state + loop.B[:, 0]
    ax = _axes(ax, 5.2, 3.4)
    second, clock = style.si_unit(periods * loop.dt, "s")
    final = 1.0 / stiffness if stiffness else math.nan
    meter, length = style.si_unit(abs(final) if math.isfinite(final) else float(np.abs(positions).max()), "m")
    ax.plot(
        np.arange(periods) * loop.dt * second, positions * meter, ".-", color=style.BLUE, markersize=3, linewidth=1.0
    )
    if math.isfinite(final):
        ax.axhline(final * meter, color=style.GRAY, linewidth=0.6, zorder=1)
    ax.set(xlabel=f"time  $t$  in {clock}", ylabel=f"position  $x$  in {length} for 1 N")
    ax.margins(x=0.0)
    return ax


@style.house_style()
def nyquist(
    scene: Scene, stiffness: float | None = None, virtual_damping: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the open loop of a wall over frequency, with the point -1 that it must leave on its left.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours.

    Returns:
        The Axes; a dot marks each gain crossover, where the loop meets the unit circle.
    """
    half = 0.5 / float(scene.timing.period)
    hertz = np.concatenate(
        [np.geomspace(1e-4 * half, 0.05 * half, _FREQUENCIES), np.linspace(0.05 * half, half, _FREQUENCIES)]
    )
    found = scene.frequency_response(stiffness, virtual_damping, hertz)
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


@style.house_style()
def poles(
    scene: Scene, stiffness: float | None = None, virtual_damping: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the poles of the loop with a wall, in the unit circle.

    Args:
        scene: the scene.
        stiffness: K of the wall in N/m; the scene's own wall where neither is given.
        virtual_damping: B in N s/m.
        ax: an Axes of yours.
    """
    found: Any = np.asarray(scene.poles(stiffness, virtual_damping)).ravel()
    outside = np.abs(found) >= 1.0
    reach = 1.15 * max(1.0, float(np.abs(found).max()))
    ax = _complex_plane(ax, (-reach, reach), (-reach, reach))
    for mask, color, mark, words in (
        (~outside, style.BLUE, "x", "inside"),
        (outside, style.VERMILION, "D", "not inside"),
    ):
        if mask.any():
            ax.plot(found[mask].real, found[mask].imag, mark, color=color, markersize=6, label=f"poles {words}")
    ax.legend(loc="upper left", fontsize=7)
    return ax


@style.house_style()
def motion(found: Motion, ax: Axes | None = None, *, labels: Sequence[str] = ()) -> Axes:
    """Draw the position of one simulated motion, or of several, over time.

    Args:
        found: what `zwidth.simulate` returns, recorded.
        ax: an Axes of yours.
        labels: a name for each of several, in their order.
    """
    if not hasattr(found, "wall_force"):
        raise InputError(f"found: got {type(found).__name__}; give what zwidth.simulate returns")
    if found.position is None or found.time is None:
        raise InputError("found: got a motion that was not recorded; simulate with record=True")
    rows = found.position.reshape(-1, found.position.shape[-1])
    if labels and len(labels) != len(rows):
        raise InputError(f"labels: got {len(labels)} for {len(rows)} motions; give one for each")
    names = list(labels) or [f"motion {k}" for k in range(len(rows))]
    times = np.broadcast_to(found.time.reshape(-1, rows.shape[-1]), rows.shape)
    ax = _axes(ax, 5.6, 3.4)
    second, clock = style.si_unit(float(times[0, -1]), "s")
    meter, length = style.si_unit(float(np.nanmax(np.abs(rows), initial=0.0)), "m")
    for k, (time, row) in enumerate(zip(times, rows, strict=True)):
        ax.plot(
            time * second, row * meter, color=style.DISTINCT[k % len(style.DISTINCT)], linewidth=1.1, label=names[k]
        )
    ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=1)
    ax.set(xlabel=f"time  $t$  in {clock}", ylabel=f"position  $x$  in {length}")
    ax.margins(x=0.0)
    if labels:
        ax.legend(loc="best")
    return ax
