"""Jupyter shows results as tables and figures below their cells, without warnings."""

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
# Results are shown as a table besides the text, figures as images.
TABLES = ("stiffest", "verdict", "recommendation", "margins", "sensitivities", "motion", "bad")
PICTURES = ("region", "bode")


@pytest.fixture(scope="module")
def shown() -> dict[str, list[Any]]:
    """Outputs of every cell."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text.strip()) for text in CELLS.values()])
    # asyncio.run closes the event loop afterwards.
    asyncio.run(NotebookClient(notebook, timeout=LONGEST, kernel_name="python3").async_execute())
    return dict(zip(CELLS, (cell.outputs for cell in notebook.cells), strict=True))


def read_data(outputs: list[Any]) -> dict[str, str]:
    """Output data of a cell by MIME type."""
    return {kind: text for output in outputs for kind, text in output.get("data", {}).items()}


def test_no_cell_prints_warnings(shown):
    printed = {
        name: [output.text for output in outputs if output.output_type == "stream"] for name, outputs in shown.items()
    }
    assert not any(printed.values()), printed


@pytest.mark.parametrize("name", TABLES)
def test_results_have_a_table_and_a_short_text(shown, name):
    data = read_data(shown[name])
    assert data["text/html"].startswith("<table")
    assert len(data["text/plain"]) < 1500
    assert "array([" not in data["text/plain"]


def test_simulation_has_a_figure(shown):
    assert "<svg" in read_data(shown["motion"])["text/html"]


@pytest.mark.parametrize("name", PICTURES)
def test_figures_are_shown_as_images(shown, name):
    assert len(read_data(shown[name])["image/png"]) > 5000


def test_texts_contain_units_and_status_names(shown):
    assert "kN/m" in read_data(shown["stiffest"])["text/plain"]
    assert "degrees" in read_data(shown["margins"])["text/plain"]
    assert "INVALID_INPUT" in read_data(shown["bad"])["text/plain"]
