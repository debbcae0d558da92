"""HTTP responses of the explorer's server, including to malformed and malicious requests."""

import asyncio
import http.client
import threading

import pytest

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")

from zwidth.app.explorer.controls import Controls
from zwidth.app.explorer.server import Explorer


@pytest.fixture(scope="module")
def explorer():
    """Yield a server running in its own thread, which ends with the tests."""
    servers, ready = [], threading.Event()

    def serve():
        loop = asyncio.new_event_loop()
        asyncio.set_event_loop(loop)
        servers.append(Explorer(Controls()))
        ready.set()
        servers[0].run()
        servers[0].loop.close(all_fds=True)

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(60)
    yield servers[0]
    servers[0].loop.add_callback(servers[0].loop.stop)
    thread.join(60)
    assert not thread.is_alive()


def request(explorer, path):
    """Return status, content security policy and redirect location of a path below the token."""
    token = explorer.address.rstrip("/").rpartition("/")[2]
    connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=60)
    try:
        connection.request("GET", f"/{token}{path}")
        response = connection.getresponse()
        response.read()
        return response.status, response.getheader("Content-Security-Policy"), response.getheader("Location", "")
    finally:
        connection.close()


def test_page_has_a_policy_and_redirects_without_a_slash(explorer):
    status, policy, _ = request(explorer, "/")
    assert status == 200
    assert str(policy).startswith("default-src 'none'")
    status, _, location = request(explorer, "")
    assert status == 302
    assert explorer.address.endswith(location)


def test_html_assets_have_a_policy(explorer):
    status, policy, _ = request(explorer, "/assets/page.html")
    assert (status, policy is None) == (200, False)


@pytest.mark.parametrize(
    "path",
    ["/assets/%00", "/static/%00", "/assets/%0a", "/static/js/%7f", "/assets/%ff", "/assets/..%2fserver.py", "//",
     "/assets/" + "a" * 300, "/static/%2e%2e/%2e%2e/server.py", "/assets/", "/ws", "/%2f", "/autoload.js", "/assets"],
)  # fmt: skip
def test_invalid_paths_have_client_error_status(explorer, path):
    assert 400 <= request(explorer, path)[0] < 500
