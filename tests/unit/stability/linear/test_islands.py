"""Lines of constant B with several stable intervals, against ends bisected in 80 digits
(tests/reference/islands.json).
"""

from __future__ import annotations

import json
from pathlib import Path

import any_loop
import numpy as np
import pytest

ROWS = json.loads((Path(__file__).parents[3] / "reference" / "islands.json").read_text())
END = 1e-9  # relative error of the ends in float64, because alpha is a difference of terms up to 1000 times larger


def test_reference_contains_enough_scenes_of_several_kinds():
    assert len(ROWS) >= 30
    kinds = {
        (row["scene"]["device"].get("coupling", {}).get("sensor"), row["scene"]["velocity"]["kind"]) for row in ROWS
    }
    assert len(kinds) >= 5
    assert all(len(row["stiffness"]) >= 2 for row in ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["scene"]["velocity"]["kind"])
def test_stable_intervals_agree_with_80_digits(row):
    scene, damping = any_loop.scene_of(row["scene"]), row["virtual_damping"]
    expected = np.array(row["stiffness"], float)
    intervals = scene.stable_stiffness(damping)
    intervals = intervals[np.isfinite(intervals[:, 0])]
    assert intervals.shape == expected.shape
    np.testing.assert_allclose(intervals, expected, rtol=0, atol=END * np.max(np.abs(expected)))
    low, high = expected.T
    offset = 1e-6 * np.max(np.abs(expected))
    assert scene.is_stable([*(low + offset), *(high - offset)], damping).all()
    assert not scene.is_stable([*(low - offset), *(high + offset)], damping).any()
