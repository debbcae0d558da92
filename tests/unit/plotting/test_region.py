"""Regions within outlines, and their comparison with grid cells."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from zwidth.plotting import stable_set

ANGLE = np.linspace(0.0, 2.0 * np.pi, 200)[:-1]
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)
RING = [(CIRCLE, False), (0.5 * CIRCLE[::-1], True)]
AXIS = np.linspace(-1.2, 1.2, 49)
RADIUS = np.hypot(AXIS[None], AXIS[:, None])


def test_agreement_ignores_cells_next_to_the_outline():
    is_stable = (RADIUS < 1.0) & (RADIUS > 0.5)
    assert stable_set.agrees(RING, AXIS, AXIS, is_stable)
    assert stable_set.agrees(RING, AXIS, AXIS, (RADIUS < 1.03) & (RADIUS > 0.5))
    assert not stable_set.agrees(RING[:1], AXIS, AXIS, is_stable)
    assert not stable_set.agrees(RING, AXIS, AXIS, ~is_stable)


@pytest.mark.parametrize("width, agree", [(1, True), (5, False)])
def test_disagreement_away_from_the_outline_is_detected(width, agree):
    is_stable = RADIUS < 1.0
    is_stable[24 : 24 + width, 24 : 24 + width] = False
    # A patch has interior cells without differing neighbors; a single cell has none.
    assert stable_set.agrees([(CIRCLE, False)], AXIS, AXIS, is_stable) is agree


@pytest.mark.parametrize("reverse", [False, True])
def test_holes_are_independent_of_their_orientation(reverse):
    points = 0.5 * (CIRCLE[::-1] if reverse else CIRCLE)
    path = stable_set.to_path([(CIRCLE, False), (points, True)])
    orientations = []
    for part in path.to_polygons():
        x, y = np.asarray(part)[:-1].T
        orientations.append(np.sign(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y)))
    assert orientations[0] == -orientations[1]


def test_outline_is_clipped_for_logarithmic_axes():
    ax = Figure().subplots()
    ax.set(xlim=(0.1, 2.0), ylim=(-2, 2))
    assert stable_set.fit_axes(RING, ax) is RING
    ax.set_xscale("log")
    ((points, _), (hole, _)) = stable_set.fit_axes(RING, ax)
    assert points[:, 0].min() == pytest.approx(0.01, rel=1e-12)
    assert hole[:, 0].min() == pytest.approx(0.01, rel=1e-12)
    seen = points[points[:, 0] > 0.1]
    # The polygon consists of chords of the circle.
    assert np.abs(np.hypot(*seen.T) - 1.0).max() < 1.0 - np.cos(np.pi / 198)
