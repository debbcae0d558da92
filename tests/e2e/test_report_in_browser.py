"""The HTML report of a run in a real browser: opens from disk, requests nothing, and its slices respond to keys."""

from __future__ import annotations

import pytest
from browser import open_page
from sweeping import PLANES, study

import zwidth

STUDY = study("plane", PLANES, ("spectral_radius",))


@pytest.mark.parametrize("width, scheme", [(1280, "light"), (390, "dark")])
def test_report_opens_from_disk_and_responds_to_keys(browser, tmp_path, width, scheme):
    zwidth.run({"version": 1, "name": "example", "studies": [STUDY]}, out=tmp_path / "run")
    file = zwidth.write_report(tmp_path / "run")
    with open_page(browser, viewport={"width": width, "height": 900}, color_scheme=scheme) as page:
        page.goto(file.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        readout, slider = page.locator("output"), page.locator("input[type=range]")
        before = readout.inner_text()
        slider.focus()
        page.keyboard.press("ArrowRight")
        assert slider.get_attribute("aria-valuetext") == "0.5"
        assert readout.inner_text() != before
        page.locator("canvas").focus()
        for _ in range(40):
            page.keyboard.press("ArrowLeft")
            page.keyboard.press("ArrowDown")
        expected = zwidth.spectral_radius(0.01, -0.2, 0.5, 1.0)
        assert float(readout.inner_text().split(":")[1]) == pytest.approx(float(expected), rel=1e-4)
        # The corner of the map lies inside the axes: first column, top row.
        page.locator("canvas").hover(position={"x": 72, "y": 14})
        assert readout.inner_text().startswith("normalized stiffness = 0.01, normalized virtual damping = 1: ")
        page.locator("canvas").hover(position={"x": 4, "y": 4})
        assert page.evaluate("document.querySelector('canvas').width") > 250
        assert page.asked == []
        assert page.complaints == []


RECORD_TEXTS = """window.written = [];
const fillText = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...more) {
  written.push(text);
  return fillText.call(this, text, ...more);
};"""


def test_decimated_map_has_round_tick_labels(browser, tmp_path):
    axes = {
        "alpha": {"log": {"start": 0.002, "stop": 8, "num": 301}},
        "beta": {"linear": {"start": -2, "stop": 2, "num": 170}},
        "delta": 0.1,
        "d": 1,
    }
    fine = study("fine", axes, ("stable",))
    zwidth.run({"version": 1, "name": "example", "studies": [fine]}, out=tmp_path / "run")
    file = zwidth.write_report(tmp_path / "run")
    with open_page(browser, viewport={"width": 1280, "height": 900}) as page:
        page.add_init_script(RECORD_TEXTS)
        page.goto(file.as_uri())
        texts = set(page.evaluate("written"))
    assert {"0.01", "0.1", "1", "-1.5", "0", "0.5", "2", "yes", "no"} <= texts
    assert max(len(text) for text in texts if not text.startswith("normalized")) <= 4
