"""Maps of an output over the (alpha, beta) plane: stable, spectral radius, passive."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from zwidth.figures import style
from zwidth.figures.data import MapData

# A grid of more panels than this says nothing on a page: evenly spaced deltas and delays stand for all.
_PANELS = 3

# Light, so that labels and curves drawn over them stay legible; in gray, passive is the darker one.
_SHADES = {"stable": "#BFE3F7", "passive": "#F3C46B"}


def draw_map(data: MapData, output: str, ax: Axes | None = None) -> Figure:
    """Draw one output over alpha and beta: panels for delta (columns) and d (rows), three of each at most.

    Args:
        data: the grid and its outputs.
        output: "stable", "spectral_radius" or "passive".
        ax: draw the first delta and d alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            image = _draw_panel(ax, data, output, 0, 0)
            _explain(style.figure_of(ax), [ax], output, image)
            return style.figure_of(ax)
        columns, rows = _evenly(data.delta.size), _evenly(data.d.size)
        single = len(columns) == len(rows) == 1
        width, height = (5.9, 4.3) if single else (0.6 + 2.3 * len(columns), 1.0 + 2.1 * len(rows))
        figure, axes = style.new_figure(max(width, 4.0), height, len(rows), len(columns), sharex=True, sharey=True)
        image = None
        for row, d_index in enumerate(rows):
            for column, delta_index in enumerate(columns):
                panel = axes[row, column]
                image = _draw_panel(panel, data, output, delta_index, d_index)
                if not single:
                    panel.set(xlabel="", ylabel="")
        if not single:
            figure.supxlabel(style.ALPHA_LABEL, fontsize=9.0)
            figure.supylabel(style.BETA_LABEL, fontsize=9.0)
        if single and data.si is not None:
            style.add_si_axes(axes[0, 0], data.si)
        _explain(figure, list(axes.flat), output, image)
        return figure


def _evenly(count: int) -> list[int]:
    """Indices of all values, or of three that are spaced evenly."""
    return list(range(count)) if count <= _PANELS else sorted({0, (count - 1) // 2, count - 1})


def _draw_panel(ax: Axes, data: MapData, output: str, delta_index: int, d_index: int) -> Any:
    values = data.outputs[output][:, :, delta_index, d_index].T
    if output == "spectral_radius":
        image = _draw_radius(ax, data, values)
    else:
        shades = ListedColormap(["white", _SHADES[output]])
        grid = (data.alpha, data.beta, values.astype(float))
        image = ax.pcolormesh(*grid, cmap=shades, vmin=0, vmax=1, shading="nearest", rasterized=True)
    ax.set_title(rf"$\delta = {data.delta[delta_index]:g}$,  $d = {data.d[d_index]:g}$")
    ax.set_xlabel(style.ALPHA_LABEL)
    ax.set_ylabel(style.BETA_LABEL)
    return image


def _draw_radius(ax: Axes, data: MapData, values: np.ndarray) -> Any:
    """Shades on both sides of 1, where the loop changes from stable to unstable, and that contour."""
    finite = values[np.isfinite(values)]
    low = float(np.min(finite, initial=0.9))
    high = max(2.0 - low, 1.0 + 1e-6)
    norm = TwoSlopeNorm(1.0, min(low, 1.0 - 1e-6), high)
    image = ax.pcolormesh(data.alpha, data.beta, values, cmap="PuOr_r", norm=norm, shading="nearest", rasterized=True)
    _draw_edge(ax, data, values)
    return image


def _draw_edge(ax: Axes, data: MapData, values: np.ndarray) -> None:
    """The contour at which stable turns into unstable, where the grid has one."""
    # On alpha = 0 a pole sits at z = 1 whatever beta is, and the contour would follow that column.
    keep = data.alpha != 0
    shown = values[:, keep]
    if min(shown.shape) >= 2 and np.nanmin(shown) < 1.0 < np.nanmax(shown):
        ax.contour(data.alpha[keep], data.beta, shown, levels=[1.0], colors=style.BLACK, linewidths=1.2)


def _explain(figure: Figure, axes: list[Axes], output: str, image: Any) -> None:
    if output == "spectral_radius":
        beyond = "max" if np.nanmax(image.get_array()) > image.norm.vmax else "neither"
        figure.colorbar(image, ax=axes, label="spectral radius (stable below 1)", extend=beyond)
        return
    handles = [
        Patch(facecolor=_SHADES[output], edgecolor=style.BLACK, linewidth=0.6, label=output),
        Patch(facecolor="white", edgecolor=style.BLACK, linewidth=0.6, label=f"not {output}"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
