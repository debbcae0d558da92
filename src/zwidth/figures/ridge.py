"""Fig. 10: the maximum stable virtual stiffness over the physical damping."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zwidth.figures import style
from zwidth.figures.data import RidgeData, RidgePath

# The first scaling of Fig. 10 shows this share of the range of delta.
_ZOOM = 0.1


def draw_ridge(data: RidgeData, ax: Axes | None = None, *, two_scalings: bool = False) -> Figure:
    """Draw alpha_max over delta, one curve for every delay and delay model; below a curve some wall is stable.

    Args:
        data: the paths of maximum stiffness.
        ax: draw into this Axes instead of a new figure.
        two_scalings: in a new figure, show the small deltas in a panel of their own, as the paper does.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            _draw_panel(ax, data, 1.0)
            return style.figure_of(ax)
        if not two_scalings:
            figure, axes = style.new_figure(5.4, 4.1)
            _draw_panel(axes[0, 0], data, 1.0)
            return figure
        figure, axes = style.new_figure(style.WIDTH, 3.6, 1, 2)
        for panel, share, title in zip(axes.flat, (_ZOOM, 1.0), "ab", strict=True):
            _draw_panel(panel, data, share)
            panel.set_title(f"({title})")
        axes[0, 1].set_ylabel("")
        return figure


def _draw_panel(ax: Axes, data: RidgeData, share: float) -> None:
    """Draw the curves up to a share of the range of delta."""
    colors = style.color_by_value([path.d for path in data.paths])
    end = share * max(float(path.delta.max()) for path in data.paths)
    shown = [_up_to(path, end) for path in data.paths]
    for path in shown:
        held = path.delay_model == "held"
        label = f"alpha_max, d = {path.d:g}, {path.delay_model}"
        dash = style.SOLID if held else style.DASHED
        ax.plot(path.delta, path.alpha_max, color=colors[path.d], linestyle=dash, label=label, zorder=3)
        if held:
            ax.fill_between(path.delta, 0.0, path.alpha_max, color=colors[path.d], alpha=0.07, linewidth=0.0, zorder=1)
    ax.set_xlim(min(float(path.delta.min()) for path in shown), end)
    ax.set_ylim(0.0, 1.04 * max(float(np.nanmax(path.alpha_max)) for path in shown))
    named = [path for path in shown if path.delay_model == "held"] or shown
    ends = [float(path.alpha_max[-1]) for path in named]
    style.label_ends(ax, [f"$d = {path.d:g}$" for path in named], ends, [colors[path.d] for path in named])
    ax.set_xlabel(style.DELTA_LABEL)
    ax.set_ylabel(style.ALPHA_MAX_LABEL)
    if any(path.delay_model == "fractional_power" for path in shown):
        ax.legend(handles=style.delay_model_handles(), loc="upper left")


def _up_to(path: RidgePath, end: float) -> RidgePath:
    keep = path.delta <= end * (1.0 + 1e-12)
    columns = (path.delta, path.alpha_max, path.beta, path.omega, path.kind)
    return RidgePath(path.d, path.delay_model, *(column[keep] for column in columns))
