"""Regions within outlines, and whether cells agree with them."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from zwidth.plotting import stable_set

TURN = np.linspace(0.0, 2.0 * np.pi, 200)[:-1]
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], -1)
RING = [(CIRCLE, False), (0.5 * CIRCLE[::-1], True)]
AXIS = np.linspace(-1.2, 1.2, 49)
RADIUS = np.hypot(AXIS[None], AXIS[:, None])


def test_cells_agree_but_for_those_beside_the_outline():
    good = (RADIUS < 1.0) & (RADIUS > 0.5)
    assert stable_set.agrees(RING, AXIS, AXIS, good)
    assert stable_set.agrees(RING, AXIS, AXIS, (RADIUS < 1.03) & (RADIUS > 0.5))
    assert not stable_set.agrees(RING[:1], AXIS, AXIS, good)
    assert not stable_set.agrees(RING, AXIS, AXIS, ~good)


@pytest.mark.parametrize("width, agree", [(1, True), (5, False)])
def test_cells_that_are_no_edge_are_told(width, agree):
    good = RADIUS < 1.0
    good[24 : 24 + width, 24 : 24 + width] = False
    # The middle of a patch has no cell beside it that differs; the corner of one cell has.
    assert stable_set.agrees([(CIRCLE, False)], AXIS, AXIS, good) is agree


@pytest.mark.parametrize("turned", [False, True])
def test_holes_stay_empty_whichever_way_they_run(turned):
    points = 0.5 * (CIRCLE[::-1] if turned else CIRCLE)
    path = stable_set.to_path([(CIRCLE, False), (points, True)])
    turns = []
    for part in path.to_polygons():
        x, y = np.asarray(part)[:-1].T
        turns.append(np.sign(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y)))
    assert turns[0] == -turns[1]


def test_on_logarithmic_axes_nothing_is_lost():
    ax = Figure().subplots()
    ax.set(xlim=(0.1, 2.0), ylim=(-2, 2))
    assert stable_set.fit_axes(RING, ax) is RING
    ax.set_xscale("log")
    ((points, _), (hole, _)) = stable_set.fit_axes(RING, ax)
    assert points[:, 0].min() == pytest.approx(0.01, rel=1e-12)
    assert hole[:, 0].min() == pytest.approx(0.01, rel=1e-12)
    seen = points[points[:, 0] > 0.1]
    # Chords of the circle, which it is made of.
    assert np.abs(np.hypot(*seen.T) - 1.0).max() < 1.0 - np.cos(np.pi / 198)
