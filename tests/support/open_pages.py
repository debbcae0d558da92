"""The explorer's page without a browser and without a server."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from bokeh.document import Document

from zwidth.app.explorer.controls import Controls
from zwidth.app.explorer.page import Page


class Queue:
    """Takes the place of the worker: what is submitted runs when the test says so."""

    def __init__(self):
        self.tasks = []

    def submit(self, task, *arguments, **options):
        self.tasks.append(partial(task, *arguments, **options))

    def work(self):
        tasks, self.tasks = self.tasks, []
        for task in tasks:
            task()


def open_page(controls: Controls) -> Any:
    """A page whose ``texts`` hold what it has told, and whose ``queue`` what it wants computed."""
    queue: Any = Queue()
    texts: dict[str, Any] = {}
    opened: Any = Page(Document(), controls, queue)
    opened.answer.on_change("data", lambda _, __, data: texts.update(json.loads(data["json"][0])))
    # There is no loop: what is handed over is taken at once.
    opened._schedule_update = opened._apply_update
    opened.texts, opened.queue = texts, queue
    return opened


def say(page: Any, **message: Any) -> None:
    """What a browser would send."""
    page.receive({"json": [json.dumps(message)]})
