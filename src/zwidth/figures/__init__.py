"""Figures in matplotlib: a table or a dataset in, Axes out.

Each function draws into Axes of yours where they are given, else into those of a new figure, which pyplot does not
know, and returns them. No module here imports JAX or changes matplotlib's global settings, and none is loaded before it
is asked for. `draw_plane`, `draw_curves` and `draw_outlines` take the dataset of a sweep, as `zwidth.open_dataset`
gives it, or a part of one; the others the table of a study, as its CSV file holds it, of maps and limit cycles the
arrays of their npz file. What each draws, its first line says: ``help(zwidth.figures)`` lists them.

Example:
    >>> import numpy as np, zwidth
    >>> from zwidth import figures
    >>> delta = np.linspace(0, 2, 41)
    >>> table = {"d": np.ones(41), "delta": delta}
    >>> (ax,) = figures.draw_ridge({**table, "alpha_max": zwidth.alpha_max(delta, 1.0).alpha})
    >>> ax.lines[0].get_label()
    'alpha_max, d = 1'
"""

import lazy_loader

# The names stand in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
