"""Labels of contours are readable: upright, separate, inside the panel and on their line."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure

from zwidth.plotting.grid import label_contours
from zwidth.plotting.style import new_figure

X, Y = np.linspace(-1.0, 1.0, 40), np.linspace(-2.0, 2.0, 50)
SURFACES = {
    "steep": X[None] + 0.01 * Y[:, None],
    "ring": np.hypot(X[None], Y[:, None]),
    "saddle": X[None] ** 2 - Y[:, None] ** 2,
}


def draw_labeled(values, others=(), count=4, columns=2, decimals=3):
    figure, axes = new_figure(6.4, 3.2, 1, columns)
    levels = np.linspace(values.min(), values.max(), count + 2)[1:-1].round(decimals)
    for ax in axes.flat:
        ax.set(xlim=(-1, 1), ylim=(-2, 2), title="a panel")
        drawn = ax.contour(X, Y, values, levels=levels)
        label_contours(ax, drawn, ["black"] * count, ["white"] * count, others)
    return figure, axes.ravel()


@pytest.mark.parametrize("name", SURFACES)
def test_labels_are_upright_and_separate_within_the_panel(name):
    figure, axes = draw_labeled(SURFACES[name])
    figure.draw_without_rendering()
    for ax in axes:
        assert len(ax.texts) >= 2
        assert {text.get_rotation() for text in ax.texts} == {0.0}
        boxes = [text.get_window_extent() for text in ax.texts]
        frame = ax.get_window_extent()
        assert all(frame.contains(box.x0, box.y0) and frame.contains(box.x1, box.y1) for box in boxes)
        assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))


@pytest.mark.parametrize("name", SURFACES)
def test_label_is_the_level_of_its_line(name):
    _, (ax, _) = draw_labeled(SURFACES[name])
    (drawn,) = ax.collections
    for text in ax.texts:
        (k,) = (k for k, level in enumerate(drawn.levels) if f"{level:g}" == text.get_text())
        distance = np.hypot(*(drawn.get_paths()[k].interpolated(8).vertices - text.get_position()).T)
        assert distance.min() < 0.02


def test_nearly_equal_levels_are_labeled_with_all_digits():
    _, (ax, _) = draw_labeled(1.0 - 1e-6 * (3.0 + SURFACES["steep"]), count=2, decimals=8)
    written = {float(text.get_text()) for text in ax.texts}
    assert len(written) >= 2
    assert written <= set(ax.collections[0].levels.tolist())


def test_labels_avoid_other_lines():
    _, (ax, _) = draw_labeled(SURFACES["ring"])
    positions = np.array([text.get_position() for text in ax.texts])
    figure, (ax, _) = draw_labeled(SURFACES["ring"], [positions])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in ax.texts]
    assert len(boxes) >= 2
    assert not any(box.contains(*position) for box in boxes for position in ax.transData.transform(positions))


def test_short_lines_have_no_label():
    _, (ax, _) = draw_labeled(SURFACES["ring"])
    tiny = Figure(figsize=(0.5, 0.5)).subplots()
    tiny.set(xlim=(-1, 1), ylim=(-2, 2))
    label_contours(tiny, tiny.contour(X, Y, SURFACES["ring"], levels=[0.5, 1.0]), ["k"] * 2, ["w"] * 2)
    assert ax.texts
    assert not tiny.texts
