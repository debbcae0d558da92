"""Draw figures in matplotlib: each function draws a table or a dataset and returns the Axes.

A function draws into existing Axes if they are passed, otherwise into a new figure that pyplot does not manage. No
function changes the global settings of matplotlib. Modules are loaded on first use and do not import JAX. `draw_plane`,
`draw_curves` and `draw_outlines` draw the dataset of a sweep as returned by `zwidth.open_dataset`, or a part of it. The
other functions draw the table of a study, as in its CSV file; those for maps and limit cycles draw the arrays of its
npz file. ``help(zwidth.plotting)`` lists all functions.

Example:
    >>> import numpy as np, zwidth
    >>> from zwidth import plotting
    >>> delta = np.linspace(0, 2, 41)
    >>> table = {"d": np.ones(41), "delta": delta}
    >>> (ax,) = plotting.draw_ridge({**table, "alpha_max": zwidth.alpha_max(delta, 1.0).alpha})
    >>> ax.lines[0].get_label()
    'alpha_max, d = 1'
"""

import lazy_loader

# The stub __init__.pyi lists the public names and the modules that define them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
