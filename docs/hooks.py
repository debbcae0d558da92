"""What the site does beyond mkdocs: names of the library become links, and examples in docstrings become code."""

from __future__ import annotations

import re
from typing import Any

import griffe

# Names that are links already, or of modules, are left alone.
_NAME = re.compile(r'(?<!">)<code>(zwidth\.[\w.]+)</code>')


def on_page_content(html: str, **_: Any) -> str:
    """Link `zwidth.name` to its place in the reference; autorefs leaves alone what has none."""
    return _NAME.sub(r'<autoref identifier="\1" optional>\g<0></autoref>', html)


class Docstrings(griffe.Extension):
    """Says in Markdown what the docstrings say in plain text."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Name the section "Example:" as mkdocstrings does, and keep "> 0" at the start of a line from quoting it."""
        if obj.docstring:
            text = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r"^( *)>(?!>)", r"\1\\>", text, flags=re.MULTILINE)
