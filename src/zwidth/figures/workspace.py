"""The stiffest wall over the workspace of a device whose mass and damping vary with its pose."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm

from zwidth.figures import style
from zwidth.figures.plane import draw_contours
from zwidth.figures.table import Table
from zwidth.words.quantities import OUTPUTS


@style.house_style()
def draw_workspace(table: Table, across: str, up: str, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable wall over two coordinates of a device's pose, the weakest pose marked.

    Poses on a grid are a surface with contours, others dots.

    Args:
        table: columns of a workspace study.
        across: the column from left to right.
        up: the one from bottom to top.
        axes: an Axes of yours.
    """
    (ax,) = panels = style.panels(axes, 1, 5.9, 4.3)
    wanted = next(str(name) for name in table if str(name).startswith("stiffness_"))
    x, y, stiffness = (np.asarray(table[name], float) for name in (across, up, wanted))
    factor, unit = style.si_unit(stiffness, "N/m")
    # A pose without an answer stays empty, which no smooth shading can show.
    stiffness = np.ma.masked_invalid(stiffness)
    shading = "nearest" if np.ma.is_masked(stiffness) else "gouraud"
    norm, weakest = LogNorm(factor * stiffness.min(), factor * stiffness.max()), int(stiffness.argmin())
    columns, rows = np.unique(x), np.unique(y)
    order = np.lexsort((x, y))
    shape = rows.size, columns.size
    grid = np.stack(np.meshgrid(columns, rows)).reshape(2, -1)
    if min(shape) > 1 and np.array_equal(np.stack([x, y])[:, order], grid):
        values = factor * stiffness[order].reshape(shape)
        image = ax.pcolormesh(columns, rows, values, shading=shading, rasterized=True, norm=norm)
        draw_contours(ax, columns, rows, values, OUTPUTS["stiffness_max"], norm, [np.array([[x[weakest], y[weakest]]])])
    else:
        image = ax.scatter(x, y, c=factor * stiffness, s=9.0, norm=norm, label="poses")
    mark = {"marker": "o", "markersize": 5, "markerfacecolor": "white", "markeredgecolor": style.BLACK}
    ax.plot(x[weakest], y[weakest], linestyle="", label="weakest pose", clip_on=False, zorder=5, **mark)
    ax.set(**{f"{which}label": _spell(name) for which, name in (("x", across), ("y", up))})
    label = rf"maximum stable stiffness  $K_{{\max}}$  in {unit}"
    bar = style.figure_of(panels).colorbar(image, ax=ax, label=label)
    style.use_logarithmic(bar.ax, "y", factor * stiffness)
    style.legend(panels, [style.line("weakest pose", "", **mark)], outside=axes is None)
    return panels


def _spell(column: str) -> str:
    """The name of a column and its unit as an axis has them."""
    name, _, unit = column.rpartition("_")
    return f"{style.literal(name.replace('_', ' '))}  in {unit}" if name else column
