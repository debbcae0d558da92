"""Local HTTP server of the explorer: it accepts connections from this machine only, at an address with a random token.

The address http://127.0.0.1:PORT/TOKEN/ serves the explorer page, its scripts and the websocket of Bokeh. Any other
address, host name or origin gets status 403, so that no other page in the browser can reach the server.
"""

from __future__ import annotations

import hmac
import json
import logging
import secrets
import signal
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.session_handler import SessionHandler
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import ErrorHandler, RedirectHandler, RequestHandler, StaticFileHandler

from zwidth.app.explorer.controls import CHOICES, ROTARY_SLIDERS, SLIDERS, Controls
from zwidth.app.explorer.page import Page
from zwidth.core.errors import InputError

HOST = "127.0.0.1"
_ASSETS = Path(__file__).parent / "assets"
_MOST_PAGES = 16  # largest number of open pages
_LONGEST_MESSAGE = 1 << 18  # bytes of a message from the browser
_UNUSED = 10  # seconds until a session without a connection is discarded
# First parts of the served paths: page, websocket, scripts of Bokeh, files in assets/. All others are refused, because
# Bokeh would serve more.
_SERVED = ("", "ws", "static", "assets")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class GuardedServer(BokehTornado):
    """Bokeh application that answers requests without the token with status 403, before it parses them further."""

    def __init__(self, make: Callable[[Document], None], token: str, port: int) -> None:
        self.token, self.host = token, f"{HOST}:{port}"
        super().__init__(
            {"/": Application(FunctionHandler(make))},
            prefix=token,
            extra_websocket_origins=[self.host],
            secret_key=secrets.token_bytes(32),
            sign_sessions=True,
            use_index=False,
            ico_path="none",
            websocket_max_message_size_bytes=_LONGEST_MESSAGE,
            check_unused_sessions_milliseconds=_UNUSED * 500,
            unused_session_lifetime_milliseconds=_UNUSED * 1000,
            include_headers=[],
            include_cookies=[],
        )
        context = {"application_context": self.applications["/"], "bokeh_websocket_path": f"/{token}/ws"}
        pages = [
            (rf"/{token}", RedirectHandler, {"url": f"/{token}/", "permanent": False}),
            (rf"/{token}/", PageHandler, context),
            (rf"/{token}/assets/(.*)", AssetHandler, {"path": str(_ASSETS)}),
        ]
        self.add_handlers(".*", pages)

    def find_handler(self, request: HTTPServerRequest, **keywords: Any) -> Any:
        """Return the handler of a request: one that answers with status 403 if token, path, host or origin is wrong."""
        first, _, rest = request.path.lstrip("/").partition("/")
        valid = hmac.compare_digest(first.encode("utf-8", "replace"), self.token.encode())
        # Refuse paths with unprintable characters, which the page never requests. Accept the token without a slash
        # after it, because such a request is redirected to the page.
        valid = valid and rest.partition("/")[0] in _SERVED and unquote(rest).isprintable()
        origin = request.headers.get("Origin", f"http://{self.host}")
        # Also compare the host, because a page of another host name that resolves to this address (DNS rebinding) must
        # have no access.
        if not valid or request.host != self.host or origin != f"http://{self.host}":
            return self.get_handler_delegate(request, ErrorHandler, {"status_code": 403})
        return super().find_handler(request, **keywords)


class _SecureHandler(RequestHandler):
    """Request handler that sends headers for security and caching with every file of the explorer."""

    def set_default_headers(self) -> None:
        self.set_header("Content-Security-Policy", _POLICY.format(host=self.application.host))  # pyright: ignore[reportAttributeAccessIssue]
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cache-Control", "no-store")


class AssetHandler(_SecureHandler, StaticFileHandler):
    """Handler of the scripts and styles in assets/."""


class PageHandler(_SecureHandler, SessionHandler):
    """Handler of the page, which returns its static HTML and a Bokeh session with its figures."""

    async def get(self) -> None:
        """Send a new page; status 503 if too many pages are open."""
        if len(list(self.application_context.sessions)) >= _MOST_PAGES:
            self.set_status(503)
            self.set_header("Content-Type", "text/plain")
            self.finish(f"{_MOST_PAGES} pages are open; close one, or wait {_UNUSED} s\n")
            return
        session: Any = await self.get_session()  # pyright: ignore[reportGeneralTypeIssues]
        roots = {root.id: root.name for root in session.document.roots}
        item = {"token": session.token, "roots": roots, "root_ids": list(roots), "use_for_title": False}
        kinds = {"linear": SLIDERS, "rotary": ROTARY_SLIDERS}
        sliders = {
            kind: {name: each._asdict() for name, each in sliders_of_kind.items()}
            for kind, sliders_of_kind in kinds.items()
        }
        start = {"items": [item], "sliders": sliders, "choices": CHOICES}
        resources: Resources = self.application.resources()
        page = (_ASSETS / "page.html").read_text(encoding="utf-8")
        script = next(file for file in resources.js_files if file.partition("?")[0].endswith("/bokeh.min.js"))
        # Escape "<" in the JSON, because "</script>" would end the script element.
        page = page.replace("{{ bokeh }}", script).replace("{{ start }}", json.dumps(start).replace("<", "\\u003c"))
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(page)


class Explorer:
    """Server of the explorer on a port of this machine; `run` serves until SIGINT or SIGTERM."""

    def __init__(self, controls: Controls, port: int = 0) -> None:
        try:
            listening = socket.create_server((HOST, port), backlog=256)
        except OSError as error:
            raise InputError(
                f"--port: {port} is not available ({error.strerror}); choose another port, or 0 for any free one"
            ) from error
        # Silence the logs of Bokeh and Tornado, because refused requests need no attention, and the page shows its
        # errors.
        for name in ("bokeh", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        listening.setblocking(False)
        token, self.port = secrets.token_urlsafe(24), listening.getsockname()[1]
        self.address = f"http://{HOST}:{self.port}/{token}/"
        self.loop = IOLoop.current()
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="explorer")

        def make(document: Document) -> None:
            """Create the page of a new session."""
            document.title = "zwidth explore"
            page = Page(document, controls, self._executor)
            document.on_session_destroyed(lambda _: page.close())

        application = GuardedServer(make, token, self.port)
        http = HTTPServer(application, max_header_size=1 << 14, max_body_size=1 << 16, idle_connection_timeout=60)
        http.add_sockets([listening])
        self._server = BaseServer(self.loop, application, http)

    def run(self) -> None:
        """Serve pages until SIGINT or SIGTERM."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: self.loop.add_callback_from_signal(self.loop.stop))
        self._server.start()
        try:
            self.loop.start()
        finally:
            self._server.stop(wait=False)
            # Wait for the worker, which stops after the current part of its computation.
            self._executor.shutdown(wait=True, cancel_futures=True)
