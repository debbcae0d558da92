"""Fig. 10: the maximum stable virtual stiffness over the physical damping."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import grid, style
from zwidth.figures.table import Table, curves, select

# The first scaling of Fig. 10 shows this share of the range of delta.
_ZOOM = 0.1


@style.house_style()
def draw_ridge(table: Table, axes: style.AnyAxes | None = None, *, two_scalings: bool = False) -> np.ndarray:
    """Draw alpha_max over delta, one curve for every delay and delay model; below a curve some wall is stable.

    Args:
        table: columns of a ridge study: d, delay_model, delta, alpha_max.
        axes: an Axes of yours; two of them, in this order, for the two scalings.
        two_scalings: show the small deltas in a panel of their own, as the paper does.
    """
    width, height = (style.WIDTH, 3.6) if two_scalings else (5.4, 4.1)
    panels = style.panels(axes, 1 + two_scalings, width, height, columns=1 + two_scalings)
    for panel, share in zip(panels, (_ZOOM, 1.0)[-len(panels) :], strict=True):
        _draw_panel(panel, table, share)
    style.letter(panels)
    for panel in panels[1:]:
        panel.set_ylabel("")
    return panels


def _draw_panel(ax: Axes, table: Table, share: float) -> None:
    """Draw the curves up to a share of the range of delta."""
    delta = np.asarray(table["delta"])
    end = share * float(delta.max())
    columns = {name: column[delta <= end * (1.0 + 1e-12)] for name, column in select(table).items()}
    shown = curves(columns, "d", "delay_model")
    colors = style.color_by_value([path.d for path in shown])
    for path in shown:
        color = colors[path.d]
        look = {"color": color, "linestyle": style.dash_of(path), "zorder": 3}
        ax.plot(path.delta, path.alpha_max, label=f"alpha_max, d = {path.d:g}, {path.delay_model}", **look)
        if path.delay_model == "held":
            ax.fill_between(path.delta, 0.0, path.alpha_max, color=color, alpha=0.07, linewidth=0.0, zorder=1)
    ax.set_xlim(float(columns["delta"].min()), end)
    highest = float(np.nanmax(columns["alpha_max"]))
    ax.set_ylim(0.0, 1.04 * highest)
    if grid.logarithmic(shown[0].delta):
        # The stiffest wall grows with the damping, over as many decades.
        style.use_logarithmic(ax, "x", columns["delta"])
        style.use_logarithmic(ax, "y", columns["alpha_max"])
        ax.set_ylim(float(np.nanmin(columns["alpha_max"])), 1.2 * highest)
    style.label_ends(ax, shown, [path.alpha_max[-1] for path in shown], colors)
    ax.set(xlabel=style.DELTA_LABEL, ylabel=style.ALPHA_MAX_LABEL)
    if handles := style.delay_model_handles(shown):
        ax.legend(handles=handles, loc="upper left")
