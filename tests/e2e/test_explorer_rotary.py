"""The explorer's page with rotary devices: its sliders, axes, texts and address are in their units."""

from __future__ import annotations

import re

import pytest
from browser import open_page
from explorer_server import enter, serve, settle, value_of

import zwidth

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")

LINEAR_UNITS = re.compile(r"(N/m|N s/m|mm/N|in mm|\bk?g\b(?! [cm]+\^2))")


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with serve(tmp_path_factory.mktemp("explore")) as running:
        yield running.address


def labels_of(page):
    return page.evaluate("[...document.querySelectorAll('.row:not([hidden]) label')].map(label => label.textContent)")


def axes_of(page):
    return page.evaluate(
        "Bokeh.documents[0].roots().flatMap(plot => [...plot.below, ...plot.left]).map(axis => axis.axis_label)"
    )


def test_a_rotary_device_is_moved_and_told_in_its_units(browser, address):
    with open_page(browser, viewport={"width": 1280, "height": 900}) as page:
        page.goto(address)
        settle(page)
        page.select_option("#motion", "rotary")
        settle(page)
        page.select_option("#operator", "rigid")
        settle(page)
        labels = labels_of(page)
        assert {"inertia J in g cm^2", "physical damping b in mN m s/rad", "stiffness K in N m/rad"} <= set(labels)
        assert not LINEAR_UNITS.search("; ".join(labels))
        assert {"stiffness K in N m/rad", "damping B in N m s/rad", "position in mrad/(N m)"} <= set(axes_of(page))
        page.select_option("#operator", "none")
        settle(page)
        enter(page, "mass", "4500")
        enter(page, "stiffness", "20")
        settle(page, "document.getElementById('verdict').textContent.includes('what limits it')")
        verdict = page.inner_text("#verdict")
        assert "4500 g cm^2" in verdict
        for text in (verdict, page.input_value("#yaml"), page.input_value("#python"), "; ".join(axes_of(page))):
            assert not LINEAR_UNITS.search(text), text
        scene = zwidth.Scene(zwidth.Device(4.5e-4, 0.01, rotary=True), zwidth.Timing(1e-3, 1e-3))
        radius = float(scene.spectral_radius(20.0, value_of(page, "virtual_damping")))
        assert f"{radius:.6f}" in page.inner_text("#radius")
        link = page.url
        assert "N+m/rad" in link
        page.select_option("#motion", "linear")
        settle(page)
        assert "mass m in g" in labels_of(page)
        page.go_back()
        settle(page, "document.getElementById('motion').value === 'rotary'")
        assert (value_of(page, "mass"), value_of(page, "stiffness")) == (4500, 20)
        assert page.complaints == []
    with open_page(browser) as other:
        other.goto(link)
        settle(other)
        assert value_of(other, "mass") == 4500
        assert "inertia J in g cm^2" in labels_of(other)
