"""What scripts that make a page of tables share: the option that names it, and where the text goes."""

from __future__ import annotations

import argparse
from pathlib import Path


def page_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser of a script's options, with the page to write."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the page to write, in Markdown")
    return parser


def hand_out(text: str, page: Path | None) -> None:
    """Print a text, and write it where a page is named."""
    print(text)
    if page is not None:
        page.write_text(text, encoding="utf-8")
