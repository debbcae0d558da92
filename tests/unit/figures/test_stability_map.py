"""Maps end at the exact edge where one is known."""

import numpy as np
from figure_tables import grid_map

from zwidth import figures

TURN = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 100)
# Of the made-up map: alpha + beta^2 = 0.5.
EDGE = np.append(np.stack([0.5 * (1 - np.sin(TURN) ** 2), np.sqrt(0.5) * np.sin(TURN)], -1), [[0.0, np.sqrt(0.5)]], 0)


def exact(ax):
    return [line.get_xydata() for line in ax.lines if line.get_label() == "exact edge"]


def test_the_outline_is_drawn_where_the_cells_agree():
    (ax,) = figures.draw_map(grid_map(), "stable", edges=lambda delta, d: {(0.1, 1.0): [(EDGE, False)]}[delta, d])
    (line,) = exact(ax)
    np.testing.assert_array_equal(line[:-1], EDGE)
    # All is white below it.
    assert ax.collections[0].get_cmap()(0) == ax.collections[0].get_cmap()(1)
    for edge in (None, [(EDGE * [0.1, 1], False)]):
        (ax,) = figures.draw_map({**fine(), "delta": np.array([0.1])}, "stable", edges=lambda *_, edge=edge: edge)
        assert not exact(ax)


def fine():
    alpha, beta = np.linspace(0.0, 1.0, 30), np.linspace(-1.0, 1.0, 30)
    radius = 0.5 + alpha[:, None] + beta[None] ** 2
    return {"alpha": alpha, "beta": beta, "d": np.array([1.0]), "stable": (radius < 1)[:, :, None, None]}
