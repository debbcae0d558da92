"""Maps of an output over the (alpha, beta) plane: stable, spectral radius, passive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, TwoSlopeNorm
from matplotlib.patches import Patch

from zwidth.figures import region, style
from zwidth.figures.table import si_scale

# A grid of more panels than this says nothing on a page: evenly spaced deltas and delays stand for all.
_PANELS = 3

# Light, so that labels and curves drawn over them stay legible; in gray, passive is the darker one.
SHADES = {"stable": "#BFE3F7", "passive": "#F3C46B"}


@style.house_style()
def draw_map(
    arrays: Mapping[str, np.ndarray],
    output: str,
    axes: style.AnyAxes | None = None,
    *,
    edges: Callable[[float, float], region.Outlines | None] = lambda delta, d: None,
) -> np.ndarray:
    """Draw one output over alpha and beta: panels for delta (columns) and d (rows), three of each at most.

    Args:
        arrays: what the npz file of a map study holds: alpha, beta, delta, d, and the output along these; with
            stiffness_N_per_m and virtual_damping_N_s_per_m a single panel is in SI units as well.
        output: "stable", "spectral_radius" or "passive".
        axes: an Axes of yours for the first delta and d alone, or one for each panel.
        edges: gives the exact edge of what is stable or passive at a delta and d, drawn in place of that of the cells
            where all cells agree with it; where there is none, the contour of the spectral radius bounds stable walls.
    """
    delta, d = arrays["delta"], arrays["d"]
    rows, columns = style.pick_evenly(d.size, _PANELS), style.pick_evenly(delta.size, _PANELS)
    places = list(product(rows, columns))
    single = len(places) == 1
    width, height = (5.9, 4.3) if single else (0.6 + 2.3 * len(columns), 1.0 + 2.1 * len(rows))
    size = (max(width, 4.0), height, len(columns))
    panels = style.panels(axes, len(places), *size, sharex=True, sharey=True)
    image: Any = None
    for ax, (row, column) in zip(panels, places, strict=False):
        place = np.s_[:, :, column, row]
        image = _draw_panel(ax, arrays, output, arrays[output][place].T)
        exact = edges(float(delta[column]), float(d[row])) if output in SHADES else None
        if output in SHADES and _draw_region(ax, arrays, output, place, exact):
            image.set_cmap(ListedColormap(["white", "white"]))
        ax.set_title(rf"$\delta = {delta[column]:g}$,  $d = {d[row]:g}$")
    style.label_axes(panels, style.ALPHA_LABEL, style.BETA_LABEL, once=axes is None)
    scale = si_scale(arrays)
    if single and scale is not None:
        style.add_si_axes(panels[0], scale)
    if output == "spectral_radius":
        beyond = "max" if np.nanmax(image.get_array()) > image.norm.vmax else "neither"
        panels[0].figure.colorbar(image, ax=list(panels), label="spectral radius (stable below 1)", extend=beyond)
        return panels
    edge: dict[str, Any] = {"edgecolor": style.BLACK, "linewidth": 0.6}
    shades = {output: SHADES[output], f"not {output}": "white"}
    handles = [Patch(facecolor=color, label=label, **edge) for label, color in shades.items()]
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _draw_region(
    ax: Axes, arrays: Mapping[str, np.ndarray], output: str, place: Any, exact: region.Outlines | None
) -> bool:
    """The region within its exact edge, or within the contour of the radius; tells whether either is known."""
    alpha, beta, good = arrays["alpha"], arrays["beta"], arrays[output][place].T.astype(bool)
    look: dict[str, Any] = {"color": style.BLACK, "linewidth": 1.2, "zorder": 2}
    if exact is not None and region.agrees(exact, alpha, beta, good):
        region.draw_region(ax, exact, SHADES[output], label="exact edge", **look)
        return True
    radius = arrays["spectral_radius"][place].T if output == "stable" and "spectral_radius" in arrays else None
    # On alpha = 0 a pole sits at z = 1 whatever beta is, and the contour would follow that column.
    keep = alpha != 0
    if radius is None or min(radius[:, keep].shape) < 2 or not np.isfinite(radius).all():
        return False
    if not radius[:, keep].min() < 1.0 < radius[:, keep].max():
        return False
    ax.contourf(alpha[keep], beta, radius[:, keep], levels=[-np.inf, 1.0], colors=[SHADES[output]], zorder=1)
    ax.contour(alpha[keep], beta, radius[:, keep], levels=[1.0], colors=style.BLACK, linewidths=1.2, zorder=2)
    return True


def _draw_panel(ax: Axes, arrays: Mapping[str, np.ndarray], output: str, values: np.ndarray) -> Any:
    alpha, beta = arrays["alpha"], arrays["beta"]
    look: dict[str, Any] = {"shading": "nearest", "rasterized": True}
    if output != "spectral_radius":
        shades = ListedColormap(["white", SHADES[output]])
        return ax.pcolormesh(alpha, beta, values.astype(float), cmap=shades, vmin=0, vmax=1, **look)
    # Shades on both sides of 1, where the loop changes from stable to unstable, and that contour.
    low = float(np.min(values[np.isfinite(values)], initial=0.9))
    norm = TwoSlopeNorm(1.0, min(low, 1.0 - 1e-6), max(2.0 - low, 1.0 + 1e-6))
    image = ax.pcolormesh(alpha, beta, values, cmap="PuOr_r", norm=norm, **look)
    # On alpha = 0 a pole sits at z = 1 whatever beta is, and the contour would follow that column.
    keep = alpha != 0
    shown = values[:, keep]
    if min(shown.shape) >= 2 and np.nanmin(shown) < 1.0 < np.nanmax(shown):
        ax.contour(alpha[keep], beta, shown, levels=[1.0], colors=style.BLACK, linewidths=1.2)
    return image
