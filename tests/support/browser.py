"""Chromium, driven by Playwright, with a record of each page's requests and errors."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from waiting import LONGEST

FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")


@contextmanager
def open_browser() -> Iterator[Any]:
    """Yield a browser, whose start takes about a second; while it runs, this thread has an event loop."""
    path = shutil.which("chromium")
    if path is None:
        if os.environ.get("CI"):
            pytest.fail("chromium is not installed: apt-get install chromium")
        pytest.skip("chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as player:
        browser = player.chromium.launch(executable_path=path, args=[*FLAGS, "--disable-sync", "--no-first-run"])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def open_page(browser: Any, **context: Any) -> Iterator[Any]:
    """Yield a page in a separate context; ``page.asked`` lists requests to other machines, ``page.complaints``
    errors.
    """
    separate = browser.new_context(**context)
    page: Any = separate.new_page()
    page.set_default_timeout(1e3 * LONGEST)
    page.asked, page.complaints = [], []
    local_schemes = ("http://127.0.0.1", "ws://127.0.0.1", "file:", "data:", "blob:")
    page.on(
        "request", lambda request: page.asked.append(request.url) if not request.url.startswith(local_schemes) else None
    )
    page.on("console", lambda message: page.complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    try:
        yield page
    finally:
        separate.close()
