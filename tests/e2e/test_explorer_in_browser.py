"""`zwidth explore` as somebody uses it: a browser, a keyboard, a mouse, and strangers who knock."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from browser import open_page
from click.testing import CliRunner
from waiting import LONGEST, wait_for

import zwidth
from zwidth.cli.commands import cli

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")


class Server:
    """A running command."""

    def __init__(self, folder, *arguments):
        command = [sys.executable, "-m", "zwidth", "explore", "--no-browser", *arguments]
        self.process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        out: Any = self.process.stdout
        line = out.readline()
        if not line.startswith("http://127.0.0.1:"):
            self.process.kill()
            pytest.fail(f"{line}{self.process.communicate()}")
        self.address = line.split()[0]
        self.host = self.address.split("/")[2]

    def end(self):
        self.process.send_signal(signal.SIGINT)
        try:
            return (*self.process.communicate(timeout=LONGEST), self.process.returncode)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise

    def get(self, path="", **headers):
        request = urllib.request.Request(f"{self.address}{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=LONGEST) as answer:
                return answer.status, answer.headers, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers, error.read().decode()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explore")
    running = Server(folder)
    yield running
    out, err, code = running.end()
    assert (out, err, code) == ("stopped\n", "", 0)
    assert list(folder.iterdir()) == []


@contextlib.contextmanager
def visit(server, browser):
    permissions = ["clipboard-read", "clipboard-write"]
    with open_page(browser, viewport={"width": 1280, "height": 1000}, permissions=permissions) as opened:
        opened.sockets = []
        opened.on("websocket", lambda socket: opened.sockets.append(socket.url))
        opened.goto(server.address)
        settle(opened)
        yield opened


@pytest.fixture(scope="module")
def shared(server, browser):
    with visit(server, browser) as opened:
        yield opened


@pytest.fixture
def page(shared):
    """A rigid scene, wherever the tests before have moved it."""
    yield shared
    settle(shared)
    assert shared.asked == []
    assert shared.complaints == []


@pytest.fixture
def fresh(server, browser):
    """A page of its own, as it opens."""
    with visit(server, browser) as opened:
        yield opened
        assert opened.asked == []
        assert opened.complaints == []


def wait(page, condition):
    # Asked from here: the page's own policy lets nobody evaluate texts in it.
    wait_for(
        lambda: page.evaluate(condition),
        lambda: f"not {condition}; {page.complaints}; {page.inner_text('header')}",
    )


def settle(page):
    """Until everything that is shown belongs to what is set."""
    wait(page, "inputs !== null && !scheduled && !rests && Object.keys(waiting).length === 0 && answered === serial"
               " && !document.body.classList.contains('busy')"
               " && document.getElementById('verdict').dataset.text !== undefined")  # fmt: skip


def data_of(page, name):
    columns = page.evaluate(
        "name => Object.fromEntries(Object.entries(Bokeh.documents[0].get_model_by_name(`${name} data`).data)"
        ".map(([column, values]) => [column, Array.from(values)]))",
        name,
    )
    return {column: np.array([np.nan if v is None else v for v in values]) for column, values in columns.items()}


def value_of(page, name):
    return float(page.input_value(f"[id='{name}']"))


def shown_scene(page):
    """The scene of the fields, in SI units."""
    numbers = {name: value_of(page, name) for name in ("mass", "damping", "period", "delay")}
    device = zwidth.Device(numbers["mass"] / 1e3, numbers["damping"])
    wall = zwidth.VirtualWall(value_of(page, "stiffness"), value_of(page, "virtual_damping"))
    return zwidth.Scene(device, zwidth.Timing(numbers["period"] / 1e3, numbers["delay"] / 1e3), wall)


def words_of_check(scene):
    options = {"mass": scene.mass, "damping": scene.damping, "period": scene.timing.period, "delay": scene.timing.delay}
    options |= {"stiffness": scene.wall.stiffness, "virtual-damping": scene.wall.virtual_damping}
    words = [f"--{name}={value!r}" for name, value in options.items()]
    done = CliRunner().invoke(cli, ["check", *words])
    assert done.exit_code == 0, done.output
    return done.stdout.rstrip("\n")


def assert_edge_is_of(page, scene):
    region, units = zwidth.stable_region(scene.delta, scene.d), scene.units
    edge = data_of(page, "edge")
    # Closed, and with a gap behind it.
    np.testing.assert_array_equal(edge["x"][:-2], region.alpha * units.stiffness)
    np.testing.assert_array_equal(edge["y"][:-2], region.beta * units.virtual_damping)


def test_the_page_asks_nobody_else_and_complains_of_nothing(page, server):
    # What it asked for and complained of is looked at when every one of these tests ends.
    assert page.sockets == [f"ws://{server.host}{server.address.partition(server.host)[2]}ws"]
    assert_edge_is_of(page, shown_scene(page))


def test_a_slider_moved_by_the_keyboard_changes_the_boundary(page):
    before = value_of(page, "damping")
    page.focus("#damping-slider")
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    settle(page)
    assert value_of(page, "damping") > before
    assert_edge_is_of(page, shown_scene(page))


def test_every_control_is_reached_by_the_keyboard(page):
    wanted = page.evaluate(
        "[...document.querySelectorAll('#controls input, #controls select, button, #plane, input[type=checkbox]')]"
        ".filter(e => e.offsetParent !== null).map(e => e.id || e.dataset.copy)"
    )
    reached = set()
    page.focus("#mode")
    for _ in range(3 * len(wanted)):
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.dataset.copy"))
        page.keyboard.press("Tab")
    assert set(wanted) - reached == set()
    unlabelled = page.evaluate(
        "[...document.querySelectorAll('input, select, textarea')]"
        ".filter(e => !e.labels.length && !e.getAttribute('aria-label')).map(e => e.id)"
    )
    assert unlabelled == []


@pytest.mark.parametrize("place", [(0.4, 0.5), (0.85, 0.25)])
def test_a_click_gives_the_verdict_of_check(page, place):
    plane = page.locator("#plane").bounding_box()
    before = value_of(page, "stiffness")
    page.mouse.click(plane["x"] + place[0] * plane["width"], plane["y"] + place[1] * plane["height"])
    wait(page, f"document.getElementById('stiffness').valueAsNumber !== {before!r}")
    settle(page)
    assert page.get_attribute("#verdict", "data-text") == words_of_check(shown_scene(page))
    assert page.inner_text("#word") == ("stable" if zwidth.assess(shown_scene(page)).stable else "UNSTABLE")


@pytest.mark.parametrize("slow", [False, True], ids=["at once after another", "held"])
def test_no_click_is_lost(page, slow):
    plane = page.locator("#plane").bounding_box()
    first, last = ((plane["x"] + x * plane["width"], plane["y"] + 0.5 * plane["height"]) for x in (0.3, 0.6))
    page.mouse.click(*first)
    # From 0.3 s on the plot takes it for a press.
    page.mouse.click(*last, delay=600 if slow else 0)
    frame = page.evaluate(
        "(() => { const r = Bokeh.documents[0].get_model_by_name('plane').x_range; return [r.start, r.end] })()"
    )
    wait(page, f"document.getElementById('stiffness').valueAsNumber > {frame[0] + 0.4 * (frame[1] - frame[0])!r}")


def test_arrow_keys_move_the_wall(page):
    before = shown_scene(page).wall
    page.focus("#plane")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowUp")
    settle(page)
    after = shown_scene(page).wall
    assert after.stiffness > before.stiffness
    assert after.virtual_damping > before.virtual_damping
    wall = data_of(page, "wall")
    assert (wall["x"][0], wall["y"][0]) == (after.stiffness, after.virtual_damping)


def test_what_is_copied_runs(fresh, tmp_path):
    fresh.fill("#damping", "7.5")
    fresh.press("#damping", "Enter")
    fresh.select_option("#velocity", "LowPass")
    settle(fresh)
    fresh.click("[data-copy=yaml]")
    wait(fresh, "document.getElementById('copied').textContent === 'copied'")
    text = fresh.evaluate("navigator.clipboard.readText()")
    file = tmp_path / "copied.yaml"
    file.write_text(text, encoding="utf-8")
    assert zwidth.run(file, out=tmp_path / "run").ok
    given: Any = zwidth.load_config(file).scene
    scene = given.to_scene()
    assert scene.device.damping == 7.5
    assert scene.velocity == zwidth.LowPass(cutoff=value_of(fresh, "velocity.cutoff"), order=1)


def test_a_contact_is_simulated_on_demand(fresh):
    assert data_of(fresh, "contact")["x"].size == 0
    fresh.check("#contact-wanted")
    wait(fresh, "document.getElementById('contact_words').textContent !== ''")
    settle(fresh)
    scene, shown = shown_scene(fresh), data_of(fresh, "contact")
    start = -0.5 * scene.timing.period
    hit = scene.simulate(start_position=start, start_velocity=0.1, contact="unilateral", periods=shown["x"].size)
    np.testing.assert_array_equal(shown["force"], hit.wall_force)


def test_a_refused_value_is_said_and_the_page_goes_on(page):
    page.fill("#mass", "-5")
    page.press("#mass", "Enter")
    wait(page, "document.getElementById('error').textContent.startsWith('mass: got -0.005')")
    page.fill("#mass", "200")
    page.press("#mass", "Enter")
    settle(page)
    assert page.inner_text("#error") == ""
    assert_edge_is_of(page, shown_scene(page))


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_and_can_be_read(server, browser, width, scheme):
    with open_page(browser, viewport={"width": width, "height": 900}, color_scheme=scheme) as opened:
        opened.goto(server.address)
        settle(opened)
        assert opened.evaluate("document.documentElement.scrollWidth") <= width
        # WCAG's contrast of the text on what it stands on: 4.5 for AA.
        assert opened.evaluate(CONTRAST) >= 4.5
        assert opened.complaints == []


def test_when_the_server_ends_the_page_says_so(browser, tmp_path):
    ending = Server(tmp_path)
    with open_page(browser) as opened:
        opened.goto(ending.address)
        settle(opened)
        out, err, code = ending.end()
        wait(opened, "document.getElementById('error').textContent.includes('has ended')")
    assert (out, err, code) == ("stopped\n", "", 0)


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


def test_the_page_forbids_what_it_does_not_need(server):
    status, headers, text = server.get()
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert re.findall(r"(?:src|href)=\"(?:https?:)?//", text) == []


@pytest.mark.parametrize(
    "address", ["/", "/wrong/", "/%ff%fe/", "/ws", "/wrong/ws", "/static/js/bokeh.min.js", "/../../etc/passwd"]
)
def test_who_does_not_know_the_token_is_refused(server, address):
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(f"http://{server.host}{address}", timeout=LONGEST)
    with refusal.value:
        assert refusal.value.code == 403


@pytest.mark.parametrize("headers", [{"Origin": "http://example.invalid"}, {"Host": "example.invalid"}])
def test_another_origin_is_refused(server, headers):
    assert server.get(**headers)[0] == 403


@pytest.mark.parametrize(
    "path", ["assets/../server.py", "assets/%2e%2e/server.py", "assets//etc/passwd", "metadata", "autoload.js"]
)
def test_nothing_else_is_served(server, path):
    assert server.get(path)[0] in (403, 404)


def run_apart(function, *arguments, **keywords):
    """A coroutine in a thread of its own: the browser's driver has a loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(lambda: asyncio.run(function(*arguments, **keywords))).result()


async def converse(server, messages, origin=None):
    """Open the page's socket with its own ticket, say something, and wait until it is closed."""
    from tornado.httpclient import HTTPRequest
    from tornado.websocket import WebSocketClosedError, websocket_connect

    text = server.get()[2]
    ticket = json.loads(re.findall(r'id="start">(.*?)</script>', text)[0])["items"][0]["token"]
    headers = {"Origin": origin or f"http://{server.host}"}
    request = HTTPRequest(server.address.replace("http:", "ws:") + "ws", headers=headers)
    socket = await websocket_connect(request, subprotocols=["bokeh", ticket])
    try:
        assert await asyncio.wait_for(socket.read_message(), LONGEST) is not None
        # It may be closed before the last of them is sent.
        with contextlib.suppress(WebSocketClosedError):
            for message in messages:
                await socket.write_message(message, binary=isinstance(message, bytes))
        while await asyncio.wait_for(socket.read_message(), LONGEST) is not None:
            pass
    finally:
        socket.close()


def test_a_socket_of_another_origin_is_refused(server):
    from tornado.httpclient import HTTPClientError

    with pytest.raises(HTTPClientError) as refusal:
        run_apart(converse, server, [], origin="http://example.invalid")
    assert refusal.value.code == 403


@pytest.mark.parametrize(
    "messages",
    [
        ["no JSON"] * 3,
        [b"\x00\xff" * 100],
        ["{}", "{}", "{}"],
        ["x" * (1 << 19)],
        ["[" * 80_000] * 3,
    ],
    ids=["text", "bytes", "empty", "oversized", "deep"],
)
def test_a_malformed_message_ends_its_own_connection_alone(server, messages):
    # One that stays open is waited for in vain, which is an error. One that is dropped in the middle of a message has
    # no closing code.
    run_apart(converse, server, messages)
    assert server.get()[0] == 200


def test_two_hundred_at_a_time_are_survived(server):
    async def knock(k, all_there):
        reader, writer = await asyncio.open_connection(*server.host.split(":"))
        try:
            await all_there.wait()
            path = server.address.partition(server.host)[2] if k % 2 else "/nobody/"
            writer.write(f"GET {path} HTTP/1.1\r\nHost: {server.host}\r\nConnection: close\r\n\r\n".encode())
            answer = await reader.read()
            return int(answer.split()[1])
        finally:
            writer.close()
            await writer.wait_closed()

    async def crowd():
        all_there = asyncio.Barrier(200)
        async with asyncio.timeout(LONGEST), asyncio.TaskGroup() as group:
            knocks = [group.create_task(knock(k, all_there)) for k in range(200)]
        return [task.result() for task in knocks]

    codes = run_apart(crowd)
    assert set(codes[::2]) == {403}
    # Some get a page, the others are told that too many are open; later there is room again.
    assert set(codes[1::2]) <= {200, 503}
    wait_for(lambda: server.get()[0] == 200)
