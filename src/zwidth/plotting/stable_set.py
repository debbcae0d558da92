"""Draw the stable set in the plane of stiffness K and virtual damping B: its exact boundary, and marked walls.

The boundary consists of *outlines*, closed lines of three kinds: the outline of the set connected to K = 0 (in
figures: "outline"), outlines of *islands*, stable sets not connected to it, and outlines of *holes*, unstable sets
inside a stable one. Tables call these kinds ``piece``, together with "passive", the outline of the passive walls. A
*cell* is one point of a grid of walls, drawn as a colored rectangle; outlines *agree* with cells if they separate the
stable from the unstable ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from zwidth.plotting import style
from zwidth.plotting.table import SI_COLUMNS, Table, curves, draws_tables, select, stack
from zwidth.units.formatting import round_conservatively, with_unit

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene

# Points (x, y) of each outline, of shape (n, 2), and True if it is the outline of a hole.
Outlines: TypeAlias = Sequence[tuple[np.ndarray, bool]]
# Colors of regions. They are light, because labels and curves drawn over them must stay legible. In a gray print the
# color of the passive walls is the darker one.
SHADES = {"stable": "#BFE3F7", "passive": "#F3C46B"}
# Number of points by which each straight segment of an outline is replaced on a logarithmic axis, on which it is
# curved.
_INTERPOLATION = 32
# Marks of walls by kind, in panels and legends.
MARKS: dict[str, dict[str, Any]] = {
    "stiffest": {"marker": "o", "markersize": 4.5},
    "recommended": {"marker": "D", "markersize": 5.0},
}
_LETTER_WIDTH = 4.4  # mean width of a letter of the text next to a mark, in points
_FRAME_MARGIN = 0.8  # width of a panel outside the frame of its axes, in inches
_MARGINS = 1.08  # width of the stiffness axis without room for text, relative to the largest stiffness
_WIDEST_TEXT = 0.45  # largest width of a text to the right of the stiffest wall, relative to the panel
# Line style of each kind of outline.
_DASHES = {"outline": style.SOLID, "island": style.DASHED, "hole": style.DOTTED, "passive": style.DASH_DOTTED}


def shade_region(ax: Axes, outlines: Outlines, face: Any, *, alpha: float | None = None, zorder: float = 1.0) -> None:
    """Shade the region inside outlines, except for holes.

    Args:
        ax: Axes to draw into.
        outlines: Outlines of the region.
        face: Color of the region; "none" to draw nothing.
        alpha: Opacity.
        zorder: Drawing order.
    """
    if outlines and face != "none":
        path = to_path(outlines)
        # Update the data limits by the vertices and add the patch as an artist, because `add_patch` computes the limits
        # segment by segment, which takes as long as all other drawing.
        ax.update_datalim(path.vertices)
        ax.add_artist(PathPatch(path, facecolor=face, alpha=alpha, linewidth=0.0, zorder=zorder))


def to_path(outlines: Outlines) -> Path:
    """Return the path of the region inside outlines, with clockwise holes, which matplotlib does not fill."""
    paths = []
    for closed, hole in ((_close(points), hole) for points, hole in outlines):
        x, y = closed[:-1].T
        turn = float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
        paths.append(Path(closed if (turn > 0) != hole else closed[::-1], closed=True))
    return Path.make_compound_path(*paths)


def _close(points: np.ndarray) -> np.ndarray:
    """Return the points of a closed line with the first point repeated at the end."""
    return points if np.array_equal(points[0], points[-1]) else np.append(points, points[:1], 0)


def mark_wall(
    ax: Axes,
    wall: Any,
    label: str,
    *,
    kind: str,
    text: str = "",
    rooms: tuple[float, float] = (np.inf, 0.0),
    **look: Any,
) -> None:
    """Mark a wall in a panel.

    Args:
        ax: Axes of the panel.
        wall: Stiffness and virtual damping, in the units of the axes.
        label: Label of the mark for legends.
        kind: Kind of the mark, a key of `MARKS`.
        text: Text next to the mark.
        rooms: Widths available to the left and to the right of the mark, in points. The text is written to the left
            if it fits there, otherwise to the right, otherwise above the mark, beginning at the vertical axis.
        look: Properties of the mark that replace those of its kind.
    """
    look = {"linestyle": "", "color": style.BLACK, "zorder": 5, "clip_on": False, **MARKS[kind], **look}
    ax.plot(*wall, label=label, **look)
    if text:
        needed = _measure_width(text)
        place: Any = {"xytext": (-8, 0), "ha": "right", "va": "center"}
        if rooms[0] < needed <= rooms[1]:
            place = {"xytext": (6, 0), "ha": "left", "va": "center"}
        elif rooms[0] < needed:
            # Write the text above the mark, starting at the vertical axis. Give the text a white background, because
            # lines may cross the text there.
            background = {"facecolor": "white", "alpha": 0.7, "linewidth": 0.0, "pad": 1.0}
            place = {"xytext": (4 - rooms[0], 6), "ha": "left", "va": "bottom", "bbox": background}
        ax.annotate(text, wall, textcoords="offset points", fontsize=8, zorder=6, **place)


def _estimate_width(ax: Axes) -> float:
    """Return the width of the frame of an Axes in points, as expected after a layout engine has arranged the figure."""
    figure, spec = style.figure_of(ax), ax.get_subplotspec()
    width = figure.get_figwidth() * ax.get_position().width
    if figure.get_layout_engine() is not None:
        width = figure.get_figwidth() / (spec.get_gridspec().ncols if spec else 1) - _FRAME_MARGIN
    return 72.0 * width


def _measure_width(text: str) -> float:
    """Return the approximate width of a text next to a mark in points, including its distance from the mark."""
    return _LETTER_WIDTH * max(len(line.replace("$", "")) for line in text.split("\n")) + 8.0


def draw_zeros(ax: Axes) -> None:
    """Draw the lines of zero stiffness and of zero damping."""
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)


def name_axes(ax: Axes, spring: str, damper: str) -> None:
    """Label the axes of stiffness and damping, and draw the lines of zero stiffness and damping.

    Args:
        ax: Axes to label.
        spring: Unit of the stiffness; "" if the axes are normalized (alpha and beta).
        damper: Unit of the damping; "" if the axes are normalized.
    """
    draw_zeros(ax)
    in_si = f"stiffness  $K$  in {spring}", f"virtual damping  $B$  in {damper}"
    style.label_axes(
        np.array([ax]),
        *(in_si if spring else (style.label_quantity("alpha"), style.label_quantity("beta"))),
        once=False,
    )


def agrees(outlines: Outlines, x: np.ndarray, y: np.ndarray, good: np.ndarray) -> bool:
    """Return whether cells agree with outlines: ``good`` is True for all cells inside, False for all others.

    Cells next to the boundary are not compared.

    Args:
        outlines: The outlines.
        x: Horizontal coordinates of the cells.
        y: Vertical coordinates of the cells.
        good: Mask of the stable cells, or of the passive ones, of shape (y, x).
    """
    inside = _cells_inside(outlines, x, y)
    return not np.any((inside != good) & ~_changes(inside) & ~_changes(good))


def _cells_inside(outlines: Outlines, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a mask of the cells inside outlines, of shape (y, x): a ray to the left crosses an odd number of lines.

    The coordinates x and y may be ascending or descending.
    """
    columns, rows = np.argsort(x), np.argsort(y)
    crossed = np.zeros((y.size, x.size + 1), int)
    for closed, _ in outlines:
        begin, end = closed, np.roll(closed, -1, 0)
        low, high = np.sort(np.searchsorted(y[rows], [begin[:, 1], end[:, 1]]), axis=0)
        edge = np.repeat(np.arange(len(closed)), high - low)
        row = np.arange(edge.size) - np.repeat(np.cumsum(high - low) - high, high - low)
        begin, end = begin[edge], end[edge]
        share = (y[rows[row]] - begin[:, 1]) / (end[:, 1] - begin[:, 1])
        place = np.searchsorted(x[columns], begin[:, 0] + share * (end[:, 0] - begin[:, 0]))
        np.add.at(crossed, (rows[row], place), 1)
    inside = np.empty((y.size, x.size), bool)
    inside[:, columns] = np.cumsum(crossed, 1)[:, :-1] % 2
    return inside


def draw_exact(
    ax: Axes, outlines: Outlines | None, x: np.ndarray, y: np.ndarray, good: np.ndarray, face: Any = "none", **look: Any
) -> Outlines:
    """Draw exact outlines if there are any and the cells agree with them.

    Args:
        ax: Axes with their final scales and limits.
        outlines: The outlines; None if there are none.
        x: Horizontal coordinates of the cells.
        y: Vertical coordinates of the cells.
        good: Mask of the stable cells, or of the passive ones, of shape (y, x).
        face: Color of the region.
        look: Properties of the lines.

    Returns:
        The outlines as drawn; empty if none are drawn.
    """
    if outlines is None or not agrees(outlines, x, y, good):
        return []
    fitted = fit_axes(outlines, ax)
    shade_region(ax, fitted, face, zorder=1.5)
    for points, _ in fitted:
        ax.plot(*_close(points).T, label="exact boundary", **look)
    return fitted


def _changes(cells: np.ndarray) -> np.ndarray:
    """Return a mask of the cells that differ in value from at least one of their eight neighbors."""
    padded = np.pad(cells, 1, mode="edge").view(np.uint8)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    true = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return (true > 0) & (true < 9)


def fit_axes(outlines: Outlines, ax: Axes) -> Outlines:
    """Return outlines in coordinates that can be drawn on the scales of an Axes.

    On a logarithmic axis, zero and negative coordinates become small positive ones below the limits of the axis.
    """
    both = ax.xaxis, ax.yaxis
    least = [0.1 * min(axis.get_view_interval()) if axis.get_scale() == "log" else -np.inf for axis in both]
    if not np.isfinite(least).any():
        return outlines
    return [
        (np.maximum(Path(_close(points)).interpolated(_INTERPOLATION).vertices, least), hole)
        for points, hole in outlines
    ]


def trace_outlines(scene: Scene, **columns: Any) -> Iterator[dict[str, Any]]:
    """Yield each outline of the stable set of a scene as columns of a table, with the additional ``columns``."""
    for number, outline in enumerate(scene.stable_region(), start=1):
        piece = "hole" if outline.hole else ("island" if outline.island else "outline")
        # Repeat the first point at the end, because tables contain closed lines.
        closed = (np.append(part, part[0]) for part in outline[:2])
        yield {**columns, "number": number, "piece": piece, **tabulate_walls(scene, *closed)}


def tabulate_walls(scene: Scene, stiffness: Any, virtual_damping: Any) -> dict[str, Any]:
    """Return walls as columns of a table, normalized by the units of a scene and in SI units."""
    normalized = {"alpha": stiffness / scene.units.stiffness, "beta": virtual_damping / scene.units.virtual_damping}
    return {**normalized, **dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))}


def tabulate_sets(scenes: Mapping[str, Scene]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return two tables for `draw_stable_set`: the outlines of the stable sets of scenes, and their stiffest walls."""
    outlines = stack(piece for label, scene in scenes.items() for piece in trace_outlines(scene, label=label))
    tops = {label: tabulate_walls(scene, *scene.max_stiffness()[:2]) for label, scene in scenes.items()}
    return outlines, stack({"label": label, "wall": "stiffest", **wall} for label, wall in tops.items())


@draws_tables
def draw_stable_set(
    outlines: Table, walls: Table, axes: style.AnyAxes | None = None, *, normalized: bool = False
) -> np.ndarray:
    """Draw the stable walls of one or several devices over stiffness and virtual damping.

    The outline of the walls connected to K = 0 is solid, that of islands (not connected to K = 0) dashed, that of holes
    (unstable walls inside) dotted, and that of the passive walls dash-dotted.

    Args:
        outlines: Columns label, number, piece (outline, island, hole or passive), stiffness_N_per_m,
            virtual_damping_N_s_per_m.
        walls: Columns label, wall (stiffest or recommended), stiffness_N_per_m, virtual_damping_N_s_per_m and, if a
            wall must be printed with more than 4 digits, digits.
        axes: An existing Axes.
        normalized: Draw the columns alpha and beta instead of those in SI units.
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.0)
    tables = [table for table in (walls, outlines) if "label" in table]
    labels = list(dict.fromkeys(label for table in tables for label in np.asarray(table["label"]).tolist()))
    alone = len(labels) == 1
    colors = {label: style.look(k)["color"] for k, label in enumerate(labels)}
    markers = {label: style.MARKERS[k % len(style.MARKERS)] for k, label in enumerate(labels)}
    names = ("alpha", "beta") if normalized else SI_COLUMNS
    factors, units = scale_walls(tables, names)
    pieces = set()
    for label, color in colors.items() if "label" in outlines else ():
        pieces |= _draw_pieces(ax, select(outlines, label=label), names, color, factors, 0.5 / (1 + len(labels)))
    rows, right_margin = select(walls), 0.0
    rows = {"digits": np.full(len(rows["wall"]), 4), **rows}
    most = max(rows[names[0]], default=np.nan) * factors[0]
    width = _estimate_width(ax)
    for kind, label, digits, *wall in zip(*(rows[name] for name in ("wall", "label", "digits", *names)), strict=True):
        # Round K down, because the wall with the printed K must be stable.
        read = round_conservatively(wall[0], "below", digits), wall[1]
        wall = [value * factor for value, factor in zip(wall, factors, strict=True)]
        which = kind.split()[0]
        symbols = zip((r"\alpha", r"\beta") if normalized else "KB", read, ("N/m", "N s/m"), strict=True)
        numbers = [
            f"${symbol}$ = {f'{value:.{digits}g}' if normalized else with_unit(value, style.units()[unit], digits)}"
            for symbol, value, unit in symbols
        ]
        text = "\n".join([kind.replace(" (", "\n("), *numbers]) if alone and np.isfinite(wall[0]) else ""
        look = {"color": style.BLACK} if alone else {"color": colors[label]}
        look |= {"marker": markers[label]} if which == "stiffest" else {}
        scale = width / (_MARGINS * (1.0 + right_margin) * most)
        rooms = scale * wall[0], scale * (most - wall[0])
        if which == "stiffest" and text:
            # Extend the stiffness axis for a text to the right of the stiffest wall. In a narrow panel, write the text
            # to the left, because the extended axis would leave little room for the curves.
            share = _measure_width(text) / width
            right_margin = share / (1.0 - share) if share < _WIDEST_TEXT else 0.0
            rooms = (0.0, np.inf) if right_margin else (np.inf, 0.0)
        mark_wall(ax, wall, kind, kind=which, text=text, rooms=rooms, **look)
    name_axes(ax, *units)
    ax.margins(0.04)
    if right_margin:
        low, high = ax.get_xlim()
        ax.set_xlim(low, high + right_margin * (high - low))
    handles: list[Any] = []
    for label, color in colors.items() if not alone else ():
        mark = {**MARKS["stiffest"], "marker": markers[label]}
        handles.append(style.line(style.literal(label), color=color, **mark))
    handles += [style.line(name, dash) for name, dash in _DASHES.items() if name in pieces and name != "outline"]
    handles += [] if alone else [style.line("stiffest stable wall", "", **MARKS["stiffest"])]
    style.legend(panels, handles, outside=axes is None, ncols=3, loc="upper right")
    return panels


def scale_walls(tables: Sequence[Table], names: Sequence[str] = SI_COLUMNS) -> tuple[list[float], list[str]]:
    """Choose units with SI prefixes that keep the stiffness and damping of walls short in print.

    Args:
        tables: Tables of walls.
        names: Columns of stiffness and damping.

    Returns:
        The factors to these units, and the units; factors of 1 and empty units for normalized columns.
    """
    units = ("N/m", "N s/m") if tuple(names) == SI_COLUMNS else ("1", "1")
    scales = [
        style.si_unit(np.concatenate([np.asarray(table[name], float) for table in tables]), unit)
        for name, unit in zip(names, units, strict=True)
    ]
    return [factor for factor, _ in scales], [unit.removeprefix("1") for _, unit in scales]


def _draw_pieces(
    ax: Axes, table: Table, names: tuple[str, ...], color: Any, factors: Sequence[float], shade: float
) -> set[str]:
    """Draw the outlines of one device, and shade its stable and its passive walls.

    Args:
        ax: Axes to draw into.
        table: Outlines of the device.
        names: Columns of stiffness and damping.
        color: Color of the device.
        factors: Factors from the units of these columns to those of the axes.
        shade: Opacity of the regions.

    Returns:
        The kinds of the outlines.
    """
    edges: dict[bool, list[Any]] = {False: [], True: []}
    pieces = curves(table, "number", "piece")
    for outline in pieces:
        path = np.stack([getattr(outline, name) for name in names], -1) * factors
        look = {"color": color, "linestyle": _DASHES[outline.piece], "zorder": 3}
        ax.plot(*path.T, label=f"{outline.piece} {outline.number}", **look)
        edges[outline.piece == "passive"].append((path, outline.piece == "hole"))
    for passive, outlines in edges.items():
        shade_region(ax, outlines, style.GRAY if passive else color, alpha=shade, zorder=1.5 if passive else 1.0)
    return {str(outline.piece) for outline in pieces}
