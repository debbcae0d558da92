"""Figures in matplotlib: a table or a dataset in, Axes out.

Each function draws into Axes of yours where they are given, else into those of a new figure, and returns them. No
module here imports JAX, touches pyplot's figures or changes matplotlib's global settings. From the table of a study, as
its CSV file holds it (a map: from its arrays; a recommendation: from its JSON file, too):

    draw_boundary         Figs. 5, 7, 8: boundaries over alpha and beta
    draw_zero_stiffness   Figs. 6, 9: boundaries over delta and beta for alpha -> 0
    draw_ridge            Fig. 10: maximum stiffness over delta
    draw_slope            eq. (22): maximum stiffness over strong damping
    draw_step             Fig. 11: step responses
    draw_passivity_cost   stiffest passive and stiffest stable wall over delta
    draw_map              stable, spectral radius or passive over alpha and beta
    draw_recommendation   the recommended wall of a device, in SI units

From the dataset of a sweep, as `zwidth.open_dataset` gives it, or a part of one:

    draw_plane            an output over two parameters
    draw_curves           an output over one parameter
    draw_outlines         the boundaries of many devices

Example:
    >>> import numpy as np, zwidth
    >>> from zwidth import figures
    >>> delta = np.linspace(0, 2, 41)
    >>> table = {"d": np.ones(41), "delay_model": ["held"] * 41, "delta": delta}
    >>> (ax,) = figures.draw_ridge({**table, "alpha_max": zwidth.alpha_max(delta, 1.0).alpha})
    >>> ax.lines[0].get_label()
    'alpha_max, d = 1, held'
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zwidth.figures.boundary import draw_boundary as draw_boundary
    from zwidth.figures.curves import draw_curves as draw_curves
    from zwidth.figures.curves import draw_outlines as draw_outlines
    from zwidth.figures.passivity_cost import draw_passivity_cost as draw_passivity_cost
    from zwidth.figures.plane import draw_plane as draw_plane
    from zwidth.figures.recommendation import draw_recommendation as draw_recommendation
    from zwidth.figures.ridge import draw_ridge as draw_ridge
    from zwidth.figures.slope import draw_slope as draw_slope
    from zwidth.figures.stability_map import draw_map as draw_map
    from zwidth.figures.step import draw_step as draw_step
    from zwidth.figures.style import house_style as house_style
    from zwidth.figures.style import save as save
    from zwidth.figures.zero_stiffness import draw_zero_stiffness as draw_zero_stiffness

_HOME = {
    "draw_boundary": "boundary",
    "draw_curves": "curves",
    "draw_outlines": "curves",
    "draw_passivity_cost": "passivity_cost",
    "draw_plane": "plane",
    "draw_recommendation": "recommendation",
    "draw_ridge": "ridge",
    "draw_slope": "slope",
    "draw_map": "stability_map",
    "draw_step": "step",
    "house_style": "style",
    "save": "style",
    "draw_zero_stiffness": "zero_stiffness",
}

__all__ = [
    "draw_boundary",
    "draw_curves",
    "draw_map",
    "draw_outlines",
    "draw_passivity_cost",
    "draw_plane",
    "draw_recommendation",
    "draw_ridge",
    "draw_slope",
    "draw_step",
    "draw_zero_stiffness",
    "house_style",
    "save",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for: matplotlib takes a moment, and a plan or a configuration needs none of it."""
    if name not in _HOME:
        raise AttributeError(f"module 'zwidth.figures' has no attribute {name!r}")
    return getattr(import_module(f"zwidth.figures.{_HOME[name]}"), name)
