"""`zwidth explore` and strangers who knock: without its token, from elsewhere, with no messages, in crowds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import urllib.error
import urllib.request

import pytest
from explorer_server import serve
from waiting import LONGEST, wait_for

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve(tmp_path_factory.mktemp("explore")) as running:
        yield running


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
        asyncio.run(converse(server, [], origin="http://example.invalid"))
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
    asyncio.run(converse(server, messages))
    assert server.get("assets/page.js")[0] == 200


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

    codes = asyncio.run(crowd())
    assert set(codes[::2]) == {403}
    # Some get a page, the others are told that too many are open; later there is room again.
    assert set(codes[1::2]) <= {200, 503}
    wait_for(lambda: server.get()[0] == 200, pause=0.2)
