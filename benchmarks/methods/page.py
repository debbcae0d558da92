"""Command line of the benchmarks that write a page of the documentation."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def write_page(description: str | None, report: Callable[..., str], **options: tuple[int, str]) -> None:
    """Print a page, and write it to the file of the option ``--write``.

    Args:
        description: description of the program.
        report: function that returns the page in Markdown; the values of the options are its arguments, in their order.
        options: default value and description of each further option, an integer, by its name.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the page to write, in Markdown")
    for name, (default, text) in options.items():
        parser.add_argument(f"--{name}", type=int, default=default, help=f"{text} (default: {default})")
    given = parser.parse_args()
    text = report(*(getattr(given, name) for name in options))
    print(text)
    if given.write is not None:
        given.write.write_text(text, encoding="utf-8")
