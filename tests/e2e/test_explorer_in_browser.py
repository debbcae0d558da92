"""`zwidth explore` in a real browser, operated by keyboard and mouse; results are compared with the library."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from browser import open_page
from click.testing import CliRunner
from explorer_server import serve
from waiting import wait_for

import zwidth
from zwidth.cli.commands import cli

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve(tmp_path_factory.mktemp("explore")) as running:
        yield running


@pytest.fixture(scope="module")
def shared(server, browser):
    permissions = ["clipboard-read", "clipboard-write"]
    with open_page(browser, viewport={"width": 1280, "height": 1000}, permissions=permissions) as session:
        session.sockets = []
        session.on("websocket", lambda socket: session.sockets.append(socket.url))
        session.goto(server.address)
        settle(session)
        yield session


@pytest.fixture
def page(shared):
    """Page showing a rigid scene in whatever state the previous tests left it."""
    yield shared
    settle(shared)
    assert shared.asked == []
    assert shared.complaints == []


def wait_until(page, condition):
    # Polled from Python because the page's content security policy forbids evaluating strings in it.
    wait_for(
        lambda: page.evaluate(condition),
        lambda: f"not {condition}; {page.complaints}; {page.inner_text('header')}",
    )


def settle(page):
    """Wait until everything shown belongs to the current inputs."""
    wait_until(
        page,
        "inputs !== null && !scheduled && !rests && Object.keys(waiting).length === 0 && answered === serial"
        " && !document.body.classList.contains('busy')"
        " && document.getElementById('verdict').dataset.text !== undefined",
    )


def read_data(page, name):
    columns = page.evaluate(
        "name => Object.fromEntries(Object.entries(Bokeh.documents[0].get_model_by_name(`${name} data`).data)"
        ".map(([column, values]) => [column, Array.from(values)]))",
        name,
    )
    return {column: np.array([np.nan if v is None else v for v in values]) for column, values in columns.items()}


def read_value(page, name):
    return float(page.input_value(f"[id='{name}']"))


def read_scene(page):
    """Scene described by the input fields, in SI units."""
    numbers = {name: read_value(page, name) for name in ("mass", "damping", "period", "delay")}
    device = zwidth.Device(numbers["mass"] / 1e3, numbers["damping"])
    wall = zwidth.VirtualWall(read_value(page, "stiffness"), read_value(page, "virtual_damping"))
    return zwidth.Scene(device, zwidth.Timing(numbers["period"] / 1e3, numbers["delay"] / 1e3), wall)


def run_check(scene):
    options = {"mass": scene.mass, "damping": scene.damping, "period": scene.timing.period, "delay": scene.timing.delay}
    options |= {"stiffness": scene.wall.stiffness, "virtual-damping": scene.wall.virtual_damping}
    arguments = [f"--{name}={value!r}" for name, value in options.items()]
    result = CliRunner().invoke(cli, ["check", *arguments])
    assert result.exit_code == 0, result.output
    return result.stdout.rstrip("\n")


def assert_edge_matches(page, scene):
    region, units = zwidth.stable_region(scene.delta, scene.d), scene.units
    edge = read_data(page, "edge")
    # The curve is closed and followed by a gap.
    np.testing.assert_array_equal(edge["x"][:-2], region.alpha * units.stiffness)
    np.testing.assert_array_equal(edge["y"][:-2], region.beta * units.virtual_damping)


def test_page_opens_only_its_own_websocket(page, server):
    # The `page` fixture checks requests and console messages after each test.
    assert page.sockets == [f"ws://{server.host}{server.address.partition(server.host)[2]}ws"]
    assert_edge_matches(page, read_scene(page))


def test_moving_a_slider_by_keyboard_updates_the_boundary(page):
    before = read_value(page, "damping")
    page.focus("#damping-slider")
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    settle(page)
    assert read_value(page, "damping") > before
    assert_edge_matches(page, read_scene(page))


def test_every_control_is_labeled_and_reachable_by_keyboard(page):
    expected = page.evaluate(
        "[...document.querySelectorAll('#controls input, #controls select, button, #plane, input[type=checkbox]')]"
        ".filter(e => e.offsetParent !== null).map(e => e.id || e.dataset.copy)"
    )
    reached = set()
    page.focus("#mode")
    for _ in range(3 * len(expected)):
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.dataset.copy"))
        page.keyboard.press("Tab")
    assert set(expected) - reached == set()
    unlabeled = page.evaluate(
        "[...document.querySelectorAll('input, select, textarea')]"
        ".filter(e => !e.labels.length && !e.getAttribute('aria-label')).map(e => e.id)"
    )
    assert unlabeled == []


@pytest.mark.parametrize("position", [(0.4, 0.5), (0.85, 0.25)])
def test_click_shows_the_verdict_of_the_check_command(page, position):
    plane = page.locator("#plane").bounding_box()
    before = read_value(page, "stiffness")
    page.mouse.click(plane["x"] + position[0] * plane["width"], plane["y"] + position[1] * plane["height"])
    wait_until(page, f"document.getElementById('stiffness').valueAsNumber !== {before!r}")
    settle(page)
    assert page.get_attribute("#verdict", "data-text") == run_check(read_scene(page))
    labels = page.evaluate("[...document.querySelectorAll('#verdict div > :first-child')].map(e => e.textContent)")
    assert {"device", "passive", "K_max"} <= set(labels)
    assert page.inner_text("#word") == ("stable" if zwidth.assess(read_scene(page)).stable else "UNSTABLE")


@pytest.mark.parametrize("slow", [False, True], ids=["immediate", "long-press"])
def test_no_click_is_lost(page, slow):
    plane = page.locator("#plane").bounding_box()
    first, last = ((plane["x"] + x * plane["width"], plane["y"] + 0.5 * plane["height"]) for x in (0.3, 0.6))
    page.mouse.click(*first)
    # The plot interprets clicks longer than 0.3 s as presses.
    page.mouse.click(*last, delay=600 if slow else 0)
    x_range = page.evaluate(
        "(() => { const r = Bokeh.documents[0].get_model_by_name('plane').x_range; return [r.start, r.end] })()"
    )
    wait_until(
        page, f"document.getElementById('stiffness').valueAsNumber > {x_range[0] + 0.4 * (x_range[1] - x_range[0])!r}"
    )


def test_arrow_keys_move_the_wall(page):
    before = read_scene(page).wall
    page.focus("#plane")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowUp")
    settle(page)
    after = read_scene(page).wall
    assert after.stiffness > before.stiffness
    assert after.virtual_damping > before.virtual_damping
    wall = read_data(page, "wall")
    assert (wall["x"][0], wall["y"][0]) == (after.stiffness, after.virtual_damping)


def test_copied_configuration_runs(page, tmp_path, unpainted):
    page.fill("#damping", "7.5")
    page.press("#damping", "Enter")
    page.select_option("#velocity", "LowPass")
    settle(page)
    page.click("[data-copy=yaml]")
    wait_until(page, "document.getElementById('copied').textContent === 'copied'")
    text, cutoff = page.evaluate("navigator.clipboard.readText()"), read_value(page, "velocity.cutoff")
    page.select_option("#velocity", "BackwardDifference")
    file = tmp_path / "copied.yaml"
    file.write_text(text, encoding="utf-8")
    assert zwidth.run(file, out=tmp_path / "run").ok
    section: Any = zwidth.load_config(file).scene
    scene = section.to_scene()
    assert scene.device.damping == 7.5
    assert scene.velocity == zwidth.LowPass(cutoff=cutoff, order=1)


def test_contact_is_simulated_on_demand(page):
    assert read_data(page, "contact")["x"].size == 0
    page.check("#contact-wanted")
    wait_until(page, "document.getElementById('contact_words').textContent !== ''")
    settle(page)
    scene, data = read_scene(page), read_data(page, "contact")
    page.uncheck("#contact-wanted")
    start = -0.5 * scene.timing.period / max(1.0, 10.0 * scene.delta)
    contact = scene.simulate(start_position=start, start_velocity=0.1, contact="unilateral", periods=data["x"].size)
    np.testing.assert_array_equal(data["force"], contact.wall_force)


def test_invalid_value_is_reported_and_page_stays_usable(page):
    page.fill("#mass", "-5")
    page.press("#mass", "Enter")
    wait_until(page, "document.getElementById('error').textContent.startsWith('mass m: got -5 g')")
    page.fill("#mass", "200")
    page.press("#mass", "Enter")
    settle(page)
    assert page.inner_text("#error") == ""
    assert_edge_matches(page, read_scene(page))


def test_sampling_rate_sets_period_and_invalid_rate_is_refused(page):
    before = read_value(page, "period")
    for text in ("0", "-3", ""):
        page.fill("#rate", text)
        page.press("#rate", "Enter")
        wait_until(
            page, "document.getElementById('error').textContent.startsWith('rate 1/T in Hz: not a number above 0')"
        )
        page.press("#rate", "Escape")
        settle(page)
        assert page.inner_text("#error") == ""
        assert read_value(page, "rate") == pytest.approx(1e3 / before, rel=1e-5)
    page.fill("#rate", "800")
    assert "before this input" in page.inner_text("#verdict-line")
    page.press("#rate", "Enter")
    settle(page)
    assert read_value(page, "period") == 1.25


def test_page_fits_the_window_with_enough_contrast(page):
    for width, scheme in ((390, "dark"), (390, "light"), (900, "light"), (1280, "light"), (1280, "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        settle(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        # No control extends beyond the edge of its card.
        assert page.evaluate(OVERFLOWING) == []
        # WCAG 2, level AA, requires a contrast of 4.5.
        assert page.evaluate(CONTRAST) >= 4.5


def test_page_reports_when_the_server_ends(shared, server):
    """Must be the last test of this module, because it stops the shared server."""
    assert server.end() == ("stopped\n", "", 0)
    wait_until(shared, "document.getElementById('error').textContent.includes('has ended')")


OVERFLOWING = """(() => {
  const edge = document.getElementById("controls").getBoundingClientRect().right;
  const parts = [...document.querySelectorAll("#controls .row > *")];
  return parts.filter(e => e.getBoundingClientRect().right > edge).map(e => e.id);
})()"""
CONTRAST = """(() => {
  const light = color => color.match(/[\\d.]+/g).slice(0, 3).map(Number).map(v => v / 255)
    .map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = element => {
    const color = getComputedStyle(element).backgroundColor;
    return color === "rgba(0, 0, 0, 0)" && element.parentElement ? behind(element.parentElement) : color;
  };
  const texts = [...document.querySelectorAll("h1, h2, p, label, span, strong, button, select, input, textarea")];
  return Math.min(...texts.filter(e => e.offsetParent !== null).map(e => {
    const pair = [light(getComputedStyle(e).color), light(behind(e))].sort((a, b) => b - a);
    return (pair[0] + 0.05) / (pair[1] + 0.05);
  }));
})()"""
