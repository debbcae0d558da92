"""State of the explorer page: the scene in the URL, invalid entries and figures saved as files.

With rotary devices, sliders, axes, texts and URL use angular units.
"""

from __future__ import annotations

import csv
import io
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from browser import open_page
from explorer_server import enter, serve, settle, value_of
from waiting import wait_for

import zwidth

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")

LINEAR_UNITS = re.compile(r"(N/m|N s/m|mm/N|in mm|\bk?g\b(?! [cm]+\^2))")


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with serve(tmp_path_factory.mktemp("explore")) as running:
        yield running.address


@pytest.fixture(scope="module")
def shared(browser, address):
    with open_page(browser, viewport={"width": 1280, "height": 900}, accept_downloads=True) as session:
        session.goto(address)
        settle(session)
        yield session


@pytest.fixture
def page(shared):
    """Page showing the initial scene. Opening a page takes 3 s, so it is shared and each test must restore the
    scene.
    """
    start = shared.url
    yield shared
    settle(shared)
    assert shared.url == start
    assert shared.asked == []
    assert shared.complaints == []


def read_data(page, name):
    return page.evaluate(
        "name => Object.fromEntries(Object.entries(Bokeh.documents[0].get_model_by_name(`${name} data`).data)"
        ".map(([column, values]) => [column, Array.from(values)]))",
        name,
    )


def test_one_slider_drag_is_one_history_entry(page):
    before, length = page.url, page.evaluate("history.length")
    page.focus("#damping-slider")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
        settle(page)
    assert page.evaluate("history.length") == length + 1
    page.go_back()
    settle(page, f"location.href === {before!r}")
    assert value_of(page, "damping") == 10


def test_url_and_history_restore_the_scene(page, browser):
    first = page.url
    assert first.endswith(
        "#mass=100+g&damping=10+N+s/m&period=1+ms&delay=1+ms&stiffness=10+kN/m&virtual_damping=40+N+s/m"
    )
    page.select_option("#velocity", "LowPass")
    settle(page)
    enter(page, "velocity.cutoff", "80")
    enter(page, "stiffness", "5000")
    last = page.url
    page.reload()
    settle(page)
    assert (value_of(page, "velocity.cutoff"), value_of(page, "stiffness"), page.url) == (80, 5000, last)
    with open_page(browser) as other:
        other.goto(last)
        settle(other)
        assert other.input_value("#yaml") == page.input_value("#yaml")
        assert other.inner_text("#radius") == page.inner_text("#radius")
    page.go_back()
    settle(page, "document.getElementById('stiffness').valueAsNumber === 10000")
    assert value_of(page, "velocity.cutoff") == 80
    for _ in range(2):
        page.go_back()
    settle(page, "document.getElementById('velocity').value === 'BackwardDifference'")
    assert page.url == first
    page.go_forward()
    settle(page, "document.getElementById('velocity').value === 'LowPass'")
    page.go_back()
    settle(page, "document.getElementById('velocity').value === 'BackwardDifference'")


@pytest.mark.parametrize(
    "entry, message", [("-5", "mass m: got -5 g; it must be greater than 0 g"), ("", "not a number")]
)
def test_verdict_is_marked_stale_while_an_entry_is_invalid(page, entry, message):
    badge = page.inner_text("#word")
    page.fill("#mass", entry)
    # Stale as soon as the text differs.
    assert page.is_visible("#stale")
    page.press("#mass", "Tab")
    wait_for(lambda: message in page.inner_text("#error"), lambda: page.inner_text("header"))
    assert page.get_attribute("#mass", "aria-invalid") == "true"
    assert (page.input_value("#mass"), page.inner_text("#word"), page.is_visible("#stale")) == (entry, badge, True)
    page.click("[data-save=png]")
    assert page.inner_text("#copied") == "not saved: an input is invalid; correct it, or press Escape in its field"
    page.press("#mass", "Escape")
    settle(page, "document.getElementById('mass').value === '100'")
    with page.expect_download() as saved:
        page.click("[data-save=png]")
    assert saved.value.suggested_filename == "zwidth-plane.png"
    assert (page.is_visible("#stale"), page.inner_text("#error")) == (False, "")
    assert page.get_attribute("#mass", "aria-invalid") is None


def test_figures_are_saved_as_shown(page, tmp_path):
    files = {}
    for kind in ("png", "svg", "csv"):
        with page.expect_download() as download:
            page.focus(f"[data-save={kind}]")
            page.keyboard.press("Enter")
        files[kind] = tmp_path / download.value.suggested_filename
        download.value.save_as(files[kind])
    assert [file.name for file in files.values()] == ["zwidth-plane.png", "zwidth-plane.svg", "zwidth-plane.csv"]
    assert files["png"].read_bytes()[:4] == b"\x89PNG"
    texts = list(ET.parse(files["svg"]).getroot().itertext())
    assert "stiffness K in N/m" in texts
    rows = list(csv.DictReader(io.StringIO(files["csv"].read_text(encoding="utf-8"))))
    edge = [
        (float(row["stiffness K in N/m"]), float(row["damping B in N s/m"])) for row in rows if row["curve"] == "stable"
    ]
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    region, units = zwidth.stable_region(scene.delta, scene.d), scene.units
    outline = np.stack([region.alpha * units.stiffness, region.beta * units.virtual_damping], -1)
    np.testing.assert_allclose(edge, [*outline, outline[0]], rtol=1e-7, atol=1e-7)
    # A figure without data cannot be saved.
    selected_figure = page.input_value("#figure")
    page.select_option("#figure", "force")
    page.click("[data-save=png]")
    assert page.inner_text("#copied") == "simulate a hit first"
    page.select_option("#figure", selected_figure)


def test_arrow_points_at_a_wall_outside_the_chart(page):
    assert read_data(page, "away")["x"] == []
    enter(page, "stiffness", "1e6")
    x_range = page.evaluate(
        "(() => { const r = Bokeh.documents[0].get_model_by_name('plane').x_range; return [r.start, r.end] })()"
    )
    (x,) = read_data(page, "away")["x"]
    assert x_range[0] + 0.9 * (x_range[1] - x_range[0]) < x < x_range[1] < 1e6
    # The same after panning the chart.
    enter(page, "stiffness", "10000")
    settle(page)
    assert read_data(page, "away")["x"] == []
    page.evaluate("Bokeh.documents[0].get_model_by_name('plane').x_range.setv({start: 15000, end: 20000})")
    wait_for(
        lambda: read_data(page, "away")["angle"] == [pytest.approx(np.pi / 2)], lambda: str(read_data(page, "away"))
    )


def read_labels(page):
    return page.evaluate("[...document.querySelectorAll('.row:not([hidden]) label')].map(label => label.textContent)")


def read_axis_labels(page):
    return page.evaluate(
        "Bokeh.documents[0].roots().flatMap(plot => [...plot.below, ...plot.left]).map(axis => axis.axis_label)"
    )


def test_rotary_device_is_shown_in_angular_units(page, browser):
    start = page.url
    page.select_option("#motion", "rotary")
    settle(page)
    page.select_option("#operator", "rigid")
    settle(page)
    labels = read_labels(page)
    assert {"inertia J in g cm^2", "physical damping b in mN m s/rad", "stiffness K in N m/rad"} <= set(labels)
    assert not LINEAR_UNITS.search("; ".join(labels))
    assert {"stiffness K in N m/rad", "damping B in N m s/rad", "angle in mrad/(N m)"} <= set(read_axis_labels(page))
    page.select_option("#operator", "none")
    settle(page)
    enter(page, "mass", "4500")
    enter(page, "stiffness", "20")
    settle(page, "document.getElementById('verdict').textContent.includes('To gain K_max')")
    verdict = page.inner_text("#verdict")
    assert "4500 g cm^2" in verdict
    for text in (verdict, page.input_value("#yaml"), page.input_value("#python"), "; ".join(read_axis_labels(page))):
        assert not LINEAR_UNITS.search(text), text
    scene = zwidth.Scene(zwidth.Device(4.5e-4, 0.01, rotary=True), zwidth.Timing(1e-3, 1e-3))
    radius = float(scene.spectral_radius(20.0, value_of(page, "virtual_damping")))
    assert f"{radius:.6f}" in page.inner_text("#radius")
    link = page.url
    assert "N+m/rad" in link
    page.select_option("#motion", "linear")
    settle(page)
    assert "mass m in g" in read_labels(page)
    page.go_back()
    settle(page, "document.getElementById('motion').value === 'rotary'")
    assert (value_of(page, "mass"), value_of(page, "stiffness")) == (4500, 20)
    page.goto(start)
    settle(page, "document.getElementById('motion').value === 'linear'")
    with open_page(browser) as other:
        other.goto(link)
        settle(other)
        assert value_of(other, "mass") == 4500
        assert "inertia J in g cm^2" in read_labels(other)
