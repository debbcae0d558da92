"""Outputs of a sweep over two parameters: regions with their boundaries, contours of margins, ridge surfaces."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator

from zwidth.figures import style
from zwidth.figures.sweep_data import Panel, PlaneData, Quantity, Scale

# Light, so that curves drawn over them stay legible; in gray, passive is the darker one.
STABLE, PASSIVE, MISSING = "#BFE3F7", "#F3C46B", "#D9D9D9"
# Numbers whose contour at this level is the boundary of the stable walls.
_EDGES = {"margin": 0.0, "decay_rate": 0.0, "phase_margin": 0.0, "gain_margin": 1.0, "spectral_radius": 1.0}
# Beyond this multiple of the smallest, a quantity that grows without end has one color.
_STEEP = 100.0
# A region that fills less of its panel than this has no room for labels.
_LABELLED = 0.1
# Less than this cannot be seen.
_SEEN = 0.003
_PEAK: dict[str, Any] = {"marker": "o", "markersize": 5, "markerfacecolor": "white", "markeredgecolor": style.BLACK}


def draw_plane(data: PlaneData, quantity: Quantity, ax: Axes | None = None) -> Figure:
    """Draw one quantity over two parameters, a panel for each of some values of the others.

    Truth values are shown as regions within their boundary, ``passive`` over ``stable`` where both are known; numbers
    as colors under labelled contours, the edge of what is stable or passive as the bold one. The stiffest stable wall
    is marked where it is known; in a ridge surface, corner optima are hatched.

    Args:
        data: axes and panels.
        quantity: which of the fields, and how it looks.
        ax: draw the first panel alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            norm = _norm(data.panels[:1], quantity)
            image = _draw_panel(ax, data, data.panels[0], quantity, norm)
            _explain(style.figure_of(ax), [ax], data.panels[:1], quantity, image)
            return style.figure_of(ax)
        figure, axes = panel_grid(len(data.panels), data.columns)
        norm, image = _norm(data.panels, quantity), None
        for panel, panel_ax in zip(data.panels, axes, strict=True):
            image = _draw_panel(panel_ax, data, panel, quantity, norm)
        label_outside(figure, axes, data.x.label, data.y.label)
        _explain(figure, axes, data.panels, quantity, image)
        return figure


def panel_grid(count: int, columns: int) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels in columns, which share their axes."""
    columns = min(count, columns)
    rows = -(-count // columns)
    width, height = (5.9, 4.5) if count == 1 else (max(5.0, 0.9 + 2.5 * columns), 1.2 + 2.2 * rows)
    figure, axes = style.new_figure(width, height, rows, columns, sharex=True, sharey=True)
    flat = list(axes.flat)
    for spare in flat[count:]:
        spare.remove()
    for above in flat[max(0, count - columns) : count]:
        # The lowest of its column, in the last row or not.
        above.tick_params(labelbottom=True)
    return figure, flat[:count]


def label_outside(figure: Figure, axes: list[Axes], x: str, y: str) -> None:
    """Name the axes once for all panels."""
    if len(axes) == 1:
        axes[0].set(xlabel=x, ylabel=y)
        return
    figure.supxlabel(x, fontsize=9.0)
    figure.supylabel(y, fontsize=9.0)


def scale_axis(ax: Axes, which: str, scale: Scale) -> None:
    """The range of an axis, and its spacing."""
    if scale.logarithmic:
        getattr(ax, f"set_{which}scale")("log")
    getattr(ax, f"set_{which}lim")(float(scale.values.min()), float(scale.values.max()))


def _draw_panel(ax: Axes, data: PlaneData, panel: Panel, quantity: Quantity, norm: Any) -> Any:
    ax.set_facecolor(MISSING)
    values = panel.fields[quantity.name]
    mesh: dict[str, Any] = {"shading": "nearest", "rasterized": True}
    if quantity.look == "truth":
        image = _draw_regions(ax, data, panel, quantity, mesh)
    else:
        shown = np.ma.masked_invalid(values)
        image = ax.pcolormesh(data.x.values, data.y.values, shown, cmap=_colors(quantity), norm=norm, **mesh)
        _draw_contours(ax, data, shown, quantity, norm)
        _draw_corners(ax, data, panel)
    if panel.peak is not None:
        ax.plot(*panel.peak, linestyle="", zorder=5, clip_on=False, label="stiffest stable wall", **_PEAK)
    scale_axis(ax, "x", data.x)
    scale_axis(ax, "y", data.y)
    ax.set_title(panel.title)
    return image


def _draw_regions(ax: Axes, data: PlaneData, panel: Panel, quantity: Quantity, mesh: dict[str, Any]) -> Any:
    """Stable and passive walls as areas, each with its boundary."""
    image = None
    for name, color, dash in (("stable", STABLE, style.SOLID), ("passive", PASSIVE, style.DASH_DOTTED)):
        if name not in panel.fields or (name != quantity.name and quantity.name != "stable"):
            continue
        values = np.ma.masked_less(panel.fields[name].astype(float), 0.0)
        low = "white" if image is None else (0, 0, 0, 0)
        shades = ListedColormap([low, color])
        image = ax.pcolormesh(data.x.values, data.y.values, values, cmap=shades, vmin=0, vmax=1, **mesh)
        smooth = next((edge for edge in _EDGES if name == "stable" and edge in panel.fields), None)
        if smooth is None:
            _draw_line(ax, data, values, 0.5, dash)
        else:
            _draw_line(ax, data, np.ma.masked_invalid(panel.fields[smooth]), _EDGES[smooth], dash)
    return image


def _draw_line(ax: Axes, data: PlaneData, values: Any, level: float, dash: Any = style.SOLID) -> None:
    """The boundary: the contour on which something changes, where the panel has one."""
    if min(values.shape) < 2 or not values.count() or not values.min() < level < values.max():
        return
    ax.contour(data.x.values, data.y.values, values, levels=[level], colors=style.BLACK, linewidths=1.3,
               linestyles=[dash])  # fmt: skip


def _draw_contours(ax: Axes, data: PlaneData, values: Any, quantity: Quantity, norm: Any) -> None:
    """Labelled contours where a number is good, and the bold one at which it ceases to be."""
    if min(values.shape) < 2 or not values.count():
        return
    levels = _levels(values, quantity, norm)
    if levels.size:
        # Over a dark color a light line, over a light one a dark line.
        shade = _colors(quantity)(norm(levels))
        luminance = shade[:, :3] @ np.array([0.299, 0.587, 0.114])
        colors = [("white" if dark < 0.5 else "#303030") for dark in luminance]
        drawn = ax.contour(data.x.values, data.y.values, values, levels=levels, colors=colors, linewidths=0.7)
        within = (values < levels.max()) if quantity.below else (values > levels.min())
        if quantity.look == "steep":
            within = values < levels.max()
        if within.filled(False).mean() > _LABELLED:
            ax.clabel(drawn, fontsize=7, inline_spacing=2, fmt=lambda level: f"{level:.4g}")
    if quantity.look == "diverging":
        _draw_line(ax, data, values, quantity.center)


def _levels(values: Any, quantity: Quantity, norm: Any) -> np.ndarray:
    """Round numbers at which contours are drawn."""
    low, high = float(values.min()), float(values.max())
    if quantity.look in ("logarithmic", "steep"):
        end = min(high, norm.vmax / 2.0) if quantity.look == "steep" else high
        levels = np.asarray(LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, end))
        levels = levels[levels <= end]
    elif quantity.look == "diverging":
        ends = (low, quantity.center) if quantity.below else (quantity.center, high)
        levels = np.asarray(MaxNLocator(6).tick_values(*ends)) if ends[0] < ends[1] else np.empty(0)
        levels = levels[levels != quantity.center]
        levels = levels[(levels < quantity.center) == quantity.below]
    else:
        levels = np.asarray(MaxNLocator(8).tick_values(low, high))
    return levels[(levels > low) & (levels < high)]


def _draw_corners(ax: Axes, data: PlaneData, panel: Panel) -> None:
    """Hatch where the stiffest wall is a corner of the stable region."""
    kind = panel.fields.get("kind")
    if kind is None or min(kind.shape) < 2 or not (kind == 1).any():
        return
    with matplotlib.rc_context({"hatch.linewidth": 0.5, "hatch.color": "#606060"}):
        ax.contourf(
            data.x.values, data.y.values, (kind == 1).astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"]
        )


def _colors(quantity: Quantity) -> Any:
    if quantity.look == "diverging":
        return matplotlib.colormaps["PuOr_r" if quantity.below else "PuOr"]
    return matplotlib.colormaps["viridis_r" if quantity.look == "steep" else "viridis"]


def _norm(panels: tuple[Panel, ...], quantity: Quantity) -> Any:
    """The colors of all panels alike."""
    fields = [panel.fields[quantity.name] for panel in panels]
    finite = np.concatenate([field[np.isfinite(field)].ravel() for field in fields])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if quantity.look == "diverging":
        # As far on the bad side as on the good one: what lies beyond is no better known by its color.
        good = max(quantity.center - low if quantity.below else high - quantity.center, 1e-6)
        return TwoSlopeNorm(quantity.center, quantity.center - good, quantity.center + good)
    if quantity.look in ("logarithmic", "steep"):
        low = max(low, 1e-300)
        high = min(high, _STEEP * low) if quantity.look == "steep" else high
        return LogNorm(low, max(high, 1.001 * low))
    return Normalize(low, high if high > low else low + 1.0)


def _explain(figure: Figure, axes: list[Axes], panels: tuple[Panel, ...], quantity: Quantity, image: Any) -> None:
    """The legend, and the colors of numbers."""
    handles: list[Any] = []
    fields = panels[0].fields
    if quantity.look == "truth":
        if quantity.name == "stable":
            handles.append(Patch(facecolor=STABLE, edgecolor=style.BLACK, linewidth=0.8, label="stable"))
        if "passive" in fields:
            handles.append(
                Patch(facecolor=PASSIVE, edgecolor=style.BLACK, linewidth=0.8, linestyle="-.", label="passive")
            )
    else:
        bar = figure.colorbar(image, ax=axes, label=quantity.label, extend=_beyond(panels, quantity, image))
        bar.ax.tick_params(labelsize=8)
    if quantity.look == "diverging":
        edge = "passive" if quantity.name == "passivity_margin" else "stable"
        handles.append(Line2D([], [], color=style.BLACK, linewidth=1.3, label=f"edge of what is {edge}"))
    if quantity.name in ("settling_time", "delay_margin"):
        handles.append(Patch(facecolor=MISSING, label="unstable"))
    elif any(_missing(panel.fields[quantity.name]) for panel in panels):
        handles.append(Patch(facecolor=MISSING, label="not computed"))
    if quantity.name != "kind" and any(
        (panel.fields["kind"] == 1).mean() > _SEEN for panel in panels if "kind" in panel.fields
    ):
        handles.append(Patch(facecolor="white", hatch="////", edgecolor="#606060", linewidth=0, label="corner optimum"))
    if any(panel.peak is not None for panel in panels):
        handles.append(Line2D([], [], linestyle="", label="stiffest stable wall", **_PEAK))
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))


def _missing(values: np.ndarray) -> bool:
    return bool(np.isnan(values).any() if values.dtype.kind == "f" else (values < 0).any())


def _beyond(panels: tuple[Panel, ...], quantity: Quantity, image: Any) -> Any:
    finite = [panel.fields[quantity.name][np.isfinite(panel.fields[quantity.name])] for panel in panels]
    low = any(field.size and field.min() < image.norm.vmin for field in finite)
    high = any(field.size and field.max() > image.norm.vmax for field in finite)
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[low, high]
