"""The explorer's page without browser and server."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from bokeh.document import Document

from zwidth.app.explorer.controls import Controls
from zwidth.app.explorer.page import Page


class Queue:
    """Replaces the worker: submitted tasks run when the test calls `work`."""

    def __init__(self):
        self.tasks = []

    def submit(self, task, *arguments, **options):
        self.tasks.append(partial(task, *arguments, **options))

    def work(self):
        tasks, self.tasks = self.tasks, []
        for task in tasks:
            task()


def open_page(controls: Controls) -> Any:
    """Return a page with ``texts`` (its messages to the browser) and ``queue`` (its submitted computations)."""
    queue: Any = Queue()
    texts: dict[str, Any] = {}
    page: Any = Page(Document(), controls, queue)
    page.answer.on_change("data", lambda _, __, data: texts.update(json.loads(data["json"][0])))
    # Without an event loop, scheduled updates are applied immediately.
    page._schedule_update = page._apply_update
    page.texts, page.queue = texts, queue
    return page


def send_message(page: Any, **message: Any) -> None:
    """Send a message as a browser would."""
    page.receive({"json": [json.dumps(message)]})
