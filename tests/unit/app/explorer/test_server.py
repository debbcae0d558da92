"""What the explorer's server answers, asked as by a browser that means no good."""

import asyncio
import http.client
import threading

import pytest

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")

from zwidth.app.explorer.controls import Controls
from zwidth.app.explorer.server import Explorer


@pytest.fixture(scope="module")
def explorer():
    """A server in a thread of its own, which ends with the tests."""
    made, ready = [], threading.Event()

    def serve():
        loop = asyncio.new_event_loop()
        asyncio.set_event_loop(loop)
        made.append(Explorer(Controls()))
        ready.set()
        made[0].run()
        made[0].loop.close(all_fds=True)

    thread = threading.Thread(target=serve)
    thread.start()
    assert ready.wait(60)
    yield made[0]
    made[0].loop.add_callback(made[0].loop.stop)
    thread.join(60)
    assert not thread.is_alive()


def ask(explorer, path):
    """Status, policy, and where it leads, of an address below the token."""
    token = explorer.address.rstrip("/").rpartition("/")[2]
    connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=60)
    try:
        connection.request("GET", f"/{token}{path}")
        answer = connection.getresponse()
        answer.read()
        return answer.status, answer.getheader("Content-Security-Policy"), answer.getheader("Location", "")
    finally:
        connection.close()


def test_the_page_has_its_policy_and_its_address_without_a_slash_leads_to_it(explorer):
    status, policy, _ = ask(explorer, "/")
    assert status == 200
    assert str(policy).startswith("default-src 'none'")
    status, _, place = ask(explorer, "")
    assert status == 302
    assert explorer.address.endswith(place)


def test_no_html_of_ours_goes_without_a_policy(explorer):
    status, policy, _ = ask(explorer, "/assets/page.html")
    assert (status, policy is None) == (200, False)


@pytest.mark.parametrize(
    "path",
    ["/assets/%00", "/static/%00", "/assets/%0a", "/static/js/%7f", "/assets/%ff", "/assets/..%2fserver.py", "//",
     "/assets/" + "a" * 300, "/static/%2e%2e/%2e%2e/server.py", "/assets/", "/ws", "/%2f", "/autoload.js", "/assets"],
)  # fmt: skip
def test_what_is_not_served_is_refused_and_breaks_nothing(explorer, path):
    assert 400 <= ask(explorer, path)[0] < 500
