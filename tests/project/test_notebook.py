"""What Jupyter shows: every result as a table, pictures under their cells, and no warning."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from waiting import LONGEST

CELLS = {
    "scene": """
%matplotlib inline
import numpy as np, zwidth
device = zwidth.Device(mass="100 g", damping=10)
scene = zwidth.Scene(device, zwidth.Timing(period="1 ms", delay="1 ms"), zwidth.VirtualWall("10 kN/m", 40))
scene""",
    "stiffest": "scene.max_stiffness()",
    "verdict": "zwidth.assess(scene)",
    "recommendation": "scene.recommend(phase_margin=30)",
    "margins": "scene.margins()",
    "sensitivities": "scene.sensitivities()",
    "motion": "scene.simulate(start_position=1e-3, periods=300)",
    "many": "scene.max_stiffness(), scene.stable_stiffness([10.0, 40.0])",
    "bad": "zwidth.decide_stability([0.1, np.nan], 0.3, 0.1, 1)",
    "region": "zwidth.plot.region(scene)",
    "bode": "zwidth.plot.bode(scene);",
}
# Of a result, a table beside its text; of a picture, an image.
TABLES = ("stiffest", "verdict", "recommendation", "margins", "sensitivities", "motion", "bad")
PICTURES = ("region", "bode")


@pytest.fixture(scope="module")
def shown() -> dict[str, list[Any]]:
    """The outputs of every cell."""
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text.strip()) for text in CELLS.values()])
    # In a loop that is closed afterwards.
    asyncio.run(NotebookClient(book, timeout=LONGEST, kernel_name="python3").async_execute())
    return dict(zip(CELLS, (cell.outputs for cell in book.cells), strict=True))


def _data(outputs: list[Any]) -> dict[str, str]:
    """What stands below a cell, by its kind."""
    return {kind: text for output in outputs for kind, text in output.get("data", {}).items()}


def test_nothing_is_warned_of(shown):
    said = {name: [each.text for each in outputs if each.output_type == "stream"] for name, outputs in shown.items()}
    assert not any(said.values()), said


@pytest.mark.parametrize("name", TABLES)
def test_results_are_tables_beside_their_texts(shown, name):
    data = _data(shown[name])
    assert data["text/html"].startswith("<table")
    assert len(data["text/plain"]) < 1500
    assert "array([" not in data["text/plain"]


def test_a_motion_has_its_picture(shown):
    assert "<svg" in _data(shown["motion"])["text/html"]


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_stand_below_their_cells(shown, name):
    assert len(_data(shown[name])["image/png"]) > 5000


def test_units_and_names_of_codes_are_said(shown):
    assert "kN/m" in _data(shown["stiffest"])["text/plain"]
    assert "degrees" in _data(shown["margins"])["text/plain"]
    assert "INVALID_INPUT" in _data(shown["bad"])["text/plain"]
