"""Rows with several stable intervals, against ends bisected in 80 digits (tests/reference/islands.json)."""

from __future__ import annotations

import json
from pathlib import Path

import any_loop
import numpy as np
import pytest

ROWS = json.loads((Path(__file__).parents[3] / "reference" / "islands.json").read_text())
# The ends in float64: alpha is a difference of numbers some thousand times larger at worst.
END = 1e-9


def test_there_are_enough_of_several_kinds():
    assert len(ROWS) >= 30
    kinds = {
        (row["scene"]["device"].get("coupling", {}).get("sensor"), row["scene"]["velocity"]["kind"]) for row in ROWS
    }
    assert len(kinds) >= 5
    assert all(len(row["stiffness"]) >= 2 for row in ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["scene"]["velocity"]["kind"])
def test_every_interval_is_found_and_none_besides(row):
    scene, damping = any_loop.scene_of(row["scene"]), row["virtual_damping"]
    expected = np.array(row["stiffness"], float)
    found = scene.stable_stiffness(damping)
    found = found[np.isfinite(found[:, 0])]
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=END * np.max(np.abs(expected)))
    low, high = expected.T
    beside = 1e-6 * np.max(np.abs(expected))
    assert scene.is_stable([*(low + beside), *(high - beside)], damping).all()
    assert not scene.is_stable([*(low - beside), *(high + beside)], damping).any()
