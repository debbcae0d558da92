"""The local server: one address with a random token, for this machine alone."""

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

from zwidth.pages.explorer.controls import CHOICES, ROTARY_SLIDERS, SLIDERS, Controls
from zwidth.pages.explorer.page import Page
from zwidth.words.errors import InputError

HOST = "127.0.0.1"
_ASSETS = Path(__file__).parent / "assets"
# Pages open at one time, bytes of a message, seconds until a page that never connected is forgotten.
_MOST_PAGES, _LONGEST_MESSAGE, _UNUSED = 16, 1 << 18, 10
# The page, its socket, Bokeh's scripts and our own; Bokeh would serve more.
_SERVED = ("", "ws", "static", "assets")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class GuardedServer(BokehTornado):
    """Bokeh's application behind a token: whatever asks under another address is refused before it is looked at."""

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
        """The handler of an address, that of errors for whoever does not know the token."""
        first, _, rest = request.path.lstrip("/").partition("/")
        known = hmac.compare_digest(first.encode("utf-8", "replace"), self.token.encode())
        # No name of ours has other characters; the token alone, without a slash, leads to the page.
        known = known and rest.partition("/")[0] in _SERVED and unquote(rest).isprintable()
        origin = request.headers.get("Origin", f"http://{self.host}")
        # Another host's name that leads here is another origin, too.
        if not known or request.host != self.host or origin != f"http://{self.host}":
            return self.get_handler_delegate(request, ErrorHandler, {"status_code": 403})
        return super().find_handler(request, **keywords)


class _Closed(RequestHandler):
    """What the browser is told of everything of ours."""

    def set_default_headers(self) -> None:
        self.set_header("Content-Security-Policy", _POLICY.format(host=self.application.host))  # pyright: ignore[reportAttributeAccessIssue]
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Cache-Control", "no-store")


class AssetHandler(_Closed, StaticFileHandler):
    """Our own scripts and styles."""


class PageHandler(_Closed, SessionHandler):
    """The page itself: static text, and a session for its figures."""

    async def get(self) -> None:
        """Open a page, unless too many are open."""
        if len(list(self.application_context.sessions)) >= _MOST_PAGES:
            self.set_status(503)
            self.set_header("Content-Type", "text/plain")
            self.finish(f"{_MOST_PAGES} pages are open; close one, or wait {_UNUSED} s\n")
            return
        session: Any = await self.get_session()  # pyright: ignore[reportGeneralTypeIssues]
        roots = {root.id: root.name for root in session.document.roots}
        item = {"token": session.token, "roots": roots, "root_ids": list(roots), "use_for_title": False}
        kinds = {"linear": SLIDERS, "rotary": ROTARY_SLIDERS}
        sliders = {kind: {name: each._asdict() for name, each in known.items()} for kind, known in kinds.items()}
        start = {"items": [item], "sliders": sliders, "choices": CHOICES}
        resources: Resources = self.application.resources()
        page = (_ASSETS / "page.html").read_text(encoding="utf-8")
        script = next(file for file in resources.js_files if file.partition("?")[0].endswith("/bokeh.min.js"))
        # As JSON in a script element: "<" could end it.
        page = page.replace("{{ bokeh }}", script).replace("{{ start }}", json.dumps(start).replace("<", "\\u003c"))
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(page)


class Explorer:
    """A server that listens; `run` serves until it is told to stop."""

    def __init__(self, controls: Controls, port: int = 0) -> None:
        try:
            listening = socket.create_server((HOST, port), backlog=256)
        except OSError as error:
            raise InputError(
                f"--port: {port} cannot be had ({error.strerror}); choose another, or 0 for any"
            ) from error
        # What a stranger sends is no news, and what goes wrong in the page is said there.
        for name in ("bokeh", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        listening.setblocking(False)
        token, self.port = secrets.token_urlsafe(24), listening.getsockname()[1]
        self.address = f"http://{HOST}:{self.port}/{token}/"
        self.loop = IOLoop.current()
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="explorer")

        def make(document: Document) -> None:
            document.title = "zwidth explore"
            page = Page(document, controls, self._executor)
            document.on_session_destroyed(lambda _: page.close())

        application = GuardedServer(make, token, self.port)
        http = HTTPServer(application, max_header_size=1 << 14, max_body_size=1 << 16, idle_connection_timeout=60)
        http.add_sockets([listening])
        self._server = BaseServer(self.loop, application, http)

    def run(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: self.loop.add_callback_from_signal(self.loop.stop))
        self._server.start()
        try:
            self.loop.start()
        finally:
            self._server.stop(wait=False)
            # What is being computed ends with its part.
            self._executor.shutdown(wait=True, cancel_futures=True)
