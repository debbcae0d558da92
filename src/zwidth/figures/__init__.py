"""Figures in matplotlib: a table or a dataset in, Axes out.

Each function draws into Axes of yours where they are given, else into those of a new figure, which pyplot does not
know, and returns them. No module here imports JAX or changes matplotlib's global settings, and none is loaded before it
is asked for. From the table of a study, as its CSV file holds it (a map: from its arrays; a recommendation: from its
JSON file, too):

    draw_boundary         Figs. 5, 7, 8: boundaries over alpha and beta
    draw_zero_stiffness   Figs. 6, 9: boundaries over delta and beta for alpha -> 0
    draw_ridge            Fig. 10: maximum stiffness over delta
    draw_slope            eq. (22): maximum stiffness over strong damping
    draw_step             Fig. 11: step responses
    draw_passivity_cost   stiffest passive and stiffest stable wall over delta
    draw_map              stable, spectral radius or passive over alpha and beta
    draw_recommendation   the recommended wall of a device, in SI units
    draw_stable_set       outlines of devices with a velocity filter, a hand or a coupling
    draw_workspace        maximum stiffness over two coordinates of a pose
    draw_filters          maximum stiffness over the cut-off of a velocity filter and over its window
    draw_filter_noise     the same over the noise that the filter lets through
    draw_motion           simulated positions and wall forces over time
    draw_phase_plane      simulated velocity over position
    draw_energy           what wall and hand have given, and what damping and friction have taken
    draw_limit_cycles     amplitude of the buzz over two parameters (from arrays)
    draw_limit_cycle_curves  amplitude and frequency of the buzz over one parameter (from arrays)
    draw_response         a measured frequency response with its band, and the open loop of a wall
    draw_device_fit       a fitted device: motion, residuals, and the boundary with its band (from several tables)

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

import lazy_loader

# The names stand in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
