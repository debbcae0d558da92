"""Stability maps: exact boundaries where available, color scales and missing points."""

import numpy as np
from figure_tables import grid_map

from zwidth import plotting

ANGLE = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 100)
# The boundary of the synthetic map: alpha + beta^2 = 0.5.
EDGE = np.append(np.stack([0.5 * (1 - np.sin(ANGLE) ** 2), np.sqrt(0.5) * np.sin(ANGLE)], -1), [[0.0, np.sqrt(0.5)]], 0)


def exact_lines(ax):
    return [line.get_xydata() for line in ax.lines if line.get_label() == "exact boundary"]


def test_outline_is_drawn_if_the_cells_agree():
    (ax,) = plotting.draw_map(grid_map(), "stable", edges=lambda delta, d: {(0.1, 1.0): [(EDGE, False)]}[delta, d])
    (line,) = exact_lines(ax)
    np.testing.assert_array_equal(line[:-1], EDGE)
    # Below the outline all cells are white.
    assert ax.collections[0].get_cmap()(0) == ax.collections[0].get_cmap()(1)
    for edge in (None, [(EDGE * [0.1, 1], False)]):
        (ax,) = plotting.draw_map(
            {**make_fine_map(), "delta": np.array([0.1])}, "stable", edges=lambda *_, edge=edge: edge
        )
        assert not exact_lines(ax)


def test_logarithmic_axes_and_points_without_result():
    status = np.zeros((30, 30, 1, 1), int)
    status[0] = 7
    (ax,) = plotting.draw_map(
        {**make_fine_map(), "alpha": np.geomspace(1e-3, 1.0, 30), "delta": np.array([0.1]), "status": status}, "stable"
    )
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "linear")
    drawn = ax.collections[0].get_array()
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn).T, status[:, :, 0, 0] == 7)
    assert "no result" in [text.get_text() for legend in ax.figure.legends for text in legend.get_texts()]


def test_color_scale_is_common_to_all_panels():
    arrays = grid_map(np.array([0.0, 0.5]))
    arrays["spectral_radius"] = arrays["spectral_radius"] * np.array([1.0, 0.5])[:, None]
    first, second = (ax.collections[0].norm for ax in plotting.draw_map(arrays, "spectral_radius"))
    assert (first.vmin, first.vmax) == (second.vmin, second.vmax)
    assert first.vmin == arrays["spectral_radius"].min()


def make_fine_map():
    alpha, beta = np.linspace(0.0, 1.0, 30), np.linspace(-1.0, 1.0, 30)
    radius = 0.5 + alpha[:, None] + beta[None] ** 2
    return {"alpha": alpha, "beta": beta, "d": np.array([1.0]), "stable": (radius < 1)[:, :, None, None]}
