"""Security of the `zwidth explore` server: missing tokens, foreign origins, malformed messages, many connections."""

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


def test_content_security_policy_forbids_external_sources(server):
    status, headers, text = server.get()
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert re.findall(r"(?:src|href)=\"(?:https?:)?//", text) == []


@pytest.mark.parametrize(
    "address", ["/", "/wrong/", "/%ff%fe/", "/ws", "/wrong/ws", "/static/js/bokeh.min.js", "/../../etc/passwd"]
)
def test_requests_without_the_token_are_refused(server, address):
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(f"http://{server.host}{address}", timeout=LONGEST)
    with refusal.value:
        assert refusal.value.code == 403


@pytest.mark.parametrize("headers", [{"Origin": "http://example.invalid"}, {"Host": "example.invalid"}])
def test_requests_from_another_origin_are_refused(server, headers):
    assert server.get(**headers)[0] == 403


@pytest.mark.parametrize(
    "path", ["assets/../server.py", "assets/%2e%2e/server.py", "assets//etc/passwd", "metadata", "autoload.js"]
)
def test_other_paths_are_not_served(server, path):
    assert server.get(path)[0] in (403, 404)


async def send_until_closed(server, messages, origin=None):
    """Open the page's WebSocket with its session token, send the messages and wait until the server closes it."""
    from tornado.httpclient import HTTPRequest
    from tornado.websocket import WebSocketClosedError, websocket_connect

    text = server.get()[2]
    token = json.loads(re.findall(r'id="start">(.*?)</script>', text)[0])["items"][0]["token"]
    headers = {"Origin": origin or f"http://{server.host}"}
    request = HTTPRequest(server.address.replace("http:", "ws:") + "ws", headers=headers)
    socket = await websocket_connect(request, subprotocols=["bokeh", token])
    try:
        assert await asyncio.wait_for(socket.read_message(), LONGEST) is not None
        # The server may close the socket before the last message is sent.
        with contextlib.suppress(WebSocketClosedError):
            for message in messages:
                await socket.write_message(message, binary=isinstance(message, bytes))
        while await asyncio.wait_for(socket.read_message(), LONGEST) is not None:
            pass
    finally:
        socket.close()


def test_websocket_from_another_origin_is_refused(server):
    from tornado.httpclient import HTTPClientError

    with pytest.raises(HTTPClientError) as refusal:
        asyncio.run(send_until_closed(server, [], origin="http://example.invalid"))
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
def test_malformed_message_closes_only_its_own_connection(server, messages):
    # If the server kept the socket open, the wait would time out. A connection dropped within a message has no close
    # code.
    asyncio.run(send_until_closed(server, messages))
    assert server.get("assets/page.js")[0] == 200


def test_two_hundred_simultaneous_requests_are_survived(server):
    async def request_page(k, all_connected):
        reader, writer = await asyncio.open_connection(*server.host.split(":"))
        try:
            await all_connected.wait()
            path = server.address.partition(server.host)[2] if k % 2 else "/nobody/"
            writer.write(f"GET {path} HTTP/1.1\r\nHost: {server.host}\r\nConnection: close\r\n\r\n".encode())
            answer = await reader.read()
            return int(answer.split()[1])
        finally:
            writer.close()
            await writer.wait_closed()

    async def request_pages():
        all_connected = asyncio.Barrier(200)
        async with asyncio.timeout(LONGEST), asyncio.TaskGroup() as group:
            requests = [group.create_task(request_page(k, all_connected)) for k in range(200)]
        return [task.result() for task in requests]

    codes = asyncio.run(request_pages())
    assert set(codes[::2]) == {403}
    # Some get a page, the others 503 for too many open sessions; later there is room again.
    assert set(codes[1::2]) <= {200, 503}
    wait_for(lambda: server.get()[0] == 200, pause=0.2)
