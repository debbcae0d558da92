"""Stable walls in a plane: regions within exact outlines, islands and holes, and marked walls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from zwidth.figures import style
from zwidth.figures.table import SI_COLUMNS, Table, curves, draws_tables, select, stack
from zwidth.words.formatting import round_safely, with_unit

if TYPE_CHECKING:
    from zwidth.scenes.scene import Scene

# Points (x, y) of each closed line, and whether it surrounds a hole.
Outlines: TypeAlias = Sequence[tuple[np.ndarray, bool]]
# Light, so that labels and curves drawn over them stay legible; in gray, passive is the darker one.
SHADES = {"stable": "#BFE3F7", "passive": "#F3C46B"}
# So many points a step of an outline bend it as a logarithmic axis does.
_BEND = 32
# How walls that matter are marked, in a legend as well.
MARKS: dict[str, dict[str, Any]] = {
    "stiffest": {"marker": "o", "markersize": 4.5},
    "recommended": {"marker": "D", "markersize": 5.0},
}
# Of words beside them, in points; and what of a panel lies beside its axes, in inches.
_LETTER, _AROUND = 4.4, 0.8
_DASHES = {"outline": style.SOLID, "island": style.DASHED, "hole": style.DOTTED, "passive": style.DASH_DOTTED}


def shade_region(ax: Axes, outlines: Outlines, face: Any, *, alpha: float | None = None, zorder: float = 1.0) -> None:
    """Shade what lies within outlines, and not in their holes."""
    if outlines and face != "none":
        path = to_path(outlines)
        # `add_patch` would look for the extremes of every straight piece by itself, for as long as all else takes.
        ax.update_datalim(path.vertices)
        ax.add_artist(PathPatch(path, facecolor=face, alpha=alpha, linewidth=0.0, zorder=zorder))


def to_path(outlines: Outlines) -> Path:
    """The shape of a region; holes run the other way round, so that they stay empty."""
    paths = []
    for closed, hole in ((_close(points), hole) for points, hole in outlines):
        x, y = closed[:-1].T
        turn = float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
        paths.append(Path(closed if (turn > 0) != hole else closed[::-1], closed=True))
    return Path.make_compound_path(*paths)


def _close(points: np.ndarray) -> np.ndarray:
    return points if np.array_equal(points[0], points[-1]) else np.append(points, points[:1], 0)


def mark_wall(
    ax: Axes,
    wall: Any,
    label: str,
    *,
    kind: str,
    text: str = "",
    right: bool = False,
    room: float = np.inf,
    **look: Any,
) -> None:
    """Mark a wall (stiffness, damping) with a text to the right, or to the left within ``room`` points."""
    look = {"linestyle": "", "color": style.BLACK, "zorder": 5, "clip_on": False, **MARKS[kind], **look}
    ax.plot(*wall, label=label, **look)
    if text:
        place: Any = {"xytext": (6 if right else -8, 0), "ha": "left" if right else "right", "va": "center"}
        if room < _LETTER * max(map(len, text.split("\n"))) + 8:
            # From the axis on, above the mark, readable over the lines behind.
            behind = {"facecolor": "white", "alpha": 0.7, "linewidth": 0.0, "pad": 1.0}
            place = {"xytext": (4 - room, 6), "ha": "left", "va": "bottom", "bbox": behind}
        ax.annotate(text, wall, textcoords="offset points", fontsize=8, zorder=6, **place)


def draw_zeros(ax: Axes) -> None:
    """Draw the lines of zero stiffness and zero damping."""
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)


def name_axes(ax: Axes, spring: str, damper: str) -> None:
    """Label the axes of stiffness and damping, normalized where they have no unit, with lines where these are zero."""
    draw_zeros(ax)
    in_si = f"stiffness  $K$  in {spring}", f"virtual damping  $B$  in {damper}"
    style.label_axes(
        np.array([ax]),
        *(in_si if spring else (style.label_quantity("alpha"), style.label_quantity("beta"))),
        once=False,
    )


def agrees(outlines: Outlines, x: np.ndarray, y: np.ndarray, good: np.ndarray) -> bool:
    """Return whether the good cells (y, x) lie within the outlines; cells next to a change may differ."""
    inside = _cells_inside(outlines, x, y)
    return not np.any((inside != good) & ~_changes(inside) & ~_changes(good))


def _cells_inside(outlines: Outlines, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Cells (y, x) with an odd number of edges to their left; axes may run either way."""
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
    """Draw outlines where they are known and the cells agree with them; returns what is drawn, on these axes."""
    if outlines is None or not agrees(outlines, x, y, good):
        return []
    fitted = fit_axes(outlines, ax)
    shade_region(ax, fitted, face, zorder=1.5)
    for points, _ in fitted:
        ax.plot(*_close(points).T, label="exact edge", **look)
    return fitted


def _changes(cells: np.ndarray) -> np.ndarray:
    """Cells that differ from one beside them: of all nine some are true and some are not."""
    padded = np.pad(cells, 1, mode="edge").view(np.uint8)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    true = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return (true > 0) & (true < 9)


def fit_axes(outlines: Outlines, ax: Axes) -> Outlines:
    """Outlines as they can be drawn on logarithmic axes: what is not positive lies beyond the frame."""
    both = ax.xaxis, ax.yaxis
    least = [0.1 * min(axis.get_view_interval()) if axis.get_scale() == "log" else -np.inf for axis in both]
    if not np.isfinite(least).any():
        return outlines
    return [(np.maximum(Path(_close(points)).interpolated(_BEND).vertices, least), hole) for points, hole in outlines]


def trace_outlines(scene: Scene, **columns: Any) -> Iterator[dict[str, Any]]:
    """The outlines of the stable set, the largest first, as columns; the hole of an island lies inside of it."""
    for number, outline in enumerate(scene.stable_region(), start=1):
        piece = "hole" if outline.hole else ("island" if outline.island else "outline")
        # Closed: the first point comes again at the end.
        closed = (np.append(part, part[0]) for part in outline[:2])
        yield {**columns, "number": number, "piece": piece, **tabulate_walls(scene, *closed)}


def tabulate_walls(scene: Scene, stiffness: Any, virtual_damping: Any) -> dict[str, Any]:
    """Return walls as columns, normalized and in SI units."""
    normalized = {"alpha": stiffness / scene.units.stiffness, "beta": virtual_damping / scene.units.virtual_damping}
    return {**normalized, **dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))}


def tabulate_sets(scenes: Mapping[str, Scene]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The outlines of devices by their labels, and the stiffest wall of each, as `draw_stable_set` takes them."""
    outlines = stack(piece for label, scene in scenes.items() for piece in trace_outlines(scene, label=label))
    tops = {label: tabulate_walls(scene, *scene.max_stiffness()[:2]) for label, scene in scenes.items()}
    return outlines, stack({"label": label, "wall": "stiffest", **wall} for label, wall in tops.items())


@draws_tables
def draw_stable_set(
    outlines: Table, walls: Table, axes: style.AnyAxes | None = None, *, normalized: bool = False
) -> np.ndarray:
    """Draw the stable walls of one or several devices over stiffness and virtual damping.

    Solid: the largest outline; dashed: islands, stable walls apart from it; dotted: holes, unstable walls within;
    dash-dotted: passive walls.

    Args:
        outlines: columns label, number, piece (outline, island, hole or passive), stiffness_N_per_m,
            virtual_damping_N_s_per_m.
        walls: columns label, wall (stiffest or recommended), the same two and, where one needs more than 4, digits.
        axes: an Axes of yours.
        normalized: from the columns alpha and beta in place of those two.
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
    rows, spec = select(walls), ax.get_subplotspec()
    wide = style.figure_of(ax).get_figwidth() / (spec.get_gridspec().ncols if spec else 1)
    # Room for words to the right of the stiffest wall, as wide as they are in a narrow panel too.
    beyond, most = 0.28 * max(1.0, 5.6 / wide), max(rows[names[0]], default=np.nan) * factors[0]
    rows = {"digits": np.full(len(rows["wall"]), 4), **rows}
    for kind, label, digits, *wall in zip(*(rows[name] for name in ("wall", "label", "digits", *names)), strict=True):
        # Round K down, so that the printed wall is stable.
        read = round_safely(wall[0], "below", digits), wall[1]
        wall = [value * factor for value, factor in zip(wall, factors, strict=True)]
        which = kind.split()[0]
        symbols = zip((r"\alpha", r"\beta") if normalized else "KB", read, ("N/m", "N s/m"), strict=True)
        numbers = [
            f"${symbol}$ = {f'{value:.{digits}g}' if normalized else with_unit(value, style.units()[unit], digits)}"
            for symbol, value, unit in symbols
        ]
        text = "\n".join([kind, *numbers]) if alone and np.isfinite(wall[0]) else ""
        look = {"color": style.BLACK} if alone else {"color": colors[label]}
        look |= {"marker": markers[label]} if which == "stiffest" else {}
        room = np.inf if which == "stiffest" else 72.0 * (wide - _AROUND) * wall[0] / ((1.0 + beyond) * most)
        mark_wall(ax, wall, kind, kind=which, text=text, right=kind == "stiffest", room=room, **look)
    name_axes(ax, *units)
    ax.margins(0.04)
    if alone and np.isfinite(rows[names[0]]).any():
        low, high = ax.get_xlim()
        ax.set_xlim(low, high + beyond * (high - low))
    handles: list[Any] = []
    for label, color in colors.items() if not alone else ():
        mark = {**MARKS["stiffest"], "marker": markers[label]}
        handles.append(style.line(style.literal(label), color=color, **mark))
    handles += [style.line(name, dash) for name, dash in _DASHES.items() if name in pieces and name != "outline"]
    handles += [] if alone else [style.line("stiffest wall", "", **MARKS["stiffest"])]
    style.legend(panels, handles, outside=axes is None, ncols=3, loc="upper right")
    return panels


def scale_walls(tables: Sequence[Table], names: Sequence[str] = SI_COLUMNS) -> tuple[list[float], list[str]]:
    """The factors and the units in which stiffness and damping of some walls have few digits; normalized ones stay."""
    units = ("N/m", "N s/m") if tuple(names) == SI_COLUMNS else ("1", "1")
    found = [
        style.si_unit(np.concatenate([np.asarray(table[name], float) for table in tables]), unit)
        for name, unit in zip(names, units, strict=True)
    ]
    return [factor for factor, _ in found], [unit.removeprefix("1") for _, unit in found]


def _draw_pieces(
    ax: Axes, table: Table, names: tuple[str, ...], color: Any, factors: Sequence[float], shade: float
) -> set[str]:
    """One device's outlines, what is stable and what is passive shaded; returns which kinds of them there are."""
    edges: dict[bool, list[Any]] = {False: [], True: []}
    found = curves(table, "number", "piece")
    for one in found:
        path = np.stack([getattr(one, name) for name in names], -1) * factors
        look = {"color": color, "linestyle": _DASHES[one.piece], "zorder": 3}
        ax.plot(*path.T, label=f"{one.piece} {one.number}", **look)
        edges[one.piece == "passive"].append((path, one.piece == "hole"))
    for passive, outlines in edges.items():
        shade_region(ax, outlines, style.GRAY if passive else color, alpha=shade, zorder=1.5 if passive else 1.0)
    return {str(one.piece) for one in found}
