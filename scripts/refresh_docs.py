#!/usr/bin/env python3
"""Update the output, figures and included files in the pages of docs/ by running the examples of each page.

A page runs from top to bottom in a temporary folder that contains the project's configs/ and scripts/ and the files of
docs/guides/files. The output of each command in a ``console`` block and of each ``>>>`` in a ``python`` block is
written below it. Figures in docs/figures/guides are the files of the same name written by the page. The text between
``<!-- include: WHAT -->`` and ``<!-- end -->`` is a file of the project, a section of a file (FILE#HEADING), the
gallery or the table of the paper's values. ``--check`` changes nothing and fails if a page is out of date.
"""

from __future__ import annotations

import argparse
import contextlib
import doctest
import io
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import yaml
from reference_pages import TABLES
from refresh_readme import ROOT, show_commands

from zwidth.studies import published as report

DOCS = ROOT / "docs"
FIGURES = DOCS / "figures"
_PART = re.compile(
    r"^```(?P<kind>console|python)\n(?P<block>.*?)^```$|^<!-- include: (?P<what>.+?) -->\n.*?^<!-- end -->$",
    re.DOTALL | re.MULTILINE,
)
_DRAWN = re.compile(r"figures/guides/([\w.-]+)\)")
_LANGUAGES = {".py": "python", ".txt": "text", ".yaml": "yaml"}


def pages() -> list[Path]:
    """Return all pages of the site."""
    return sorted(DOCS.rglob("*.md"))


def refreshed(text: str, figures: Path | None = None) -> str:
    """Return the text of a page with current output; copy its figures to the folder ``figures``."""
    names: dict[str, Any] = {"__name__": "__main__"}

    def fill(part: re.Match[str]) -> str:
        if part["what"]:
            return f"<!-- include: {part['what']} -->\n{include(part['what'])}\n<!-- end -->"
        block = show_commands(part["block"]) if part["kind"] == "console" else run_python(part["block"], names)
        return f"```{part['kind']}\n{block}```"

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for shared in ("configs", "scripts"):
            (folder / shared).symlink_to(ROOT / shared)
        for file in (DOCS / "guides" / "files").iterdir():
            shutil.copy(file, folder)
        with contextlib.chdir(folder):
            new = _PART.sub(fill, text)
        for name in _DRAWN.findall(text):
            if not (folder / name).exists():
                raise SystemExit(f"{name}: shown, but written by no example of the page")
            if figures:
                figures.mkdir(parents=True, exist_ok=True)
                shutil.copy(folder / name, figures)
    return new


def run_python(block: str, names: dict[str, Any]) -> str:
    """Return a block with the output of its examples; a block without prompts is compiled but not run."""
    parts = doctest.DocTestParser().parse(block)
    if len(parts) == 1:
        compile(block, "<page>", "exec")
    return "".join(part if isinstance(part, str) else _show(part, names) for part in parts)


def _show(example: doctest.Example, names: dict[str, Any]) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(example.source, "<page>", "single"), names)
    lines = example.source.splitlines()
    shown = [f">>> {lines[0]}", *(f"... {line}".rstrip() for line in lines[1:])]
    return "\n".join(shown) + "\n" + printed.getvalue()


def include(what: str) -> str:
    """Return the text between the two include comments."""
    if what in MADE:
        return MADE[what]()
    name, _, heading = what.partition("#")
    text = (ROOT / name).read_text(encoding="utf-8").strip()
    if heading:
        found = re.search(rf"^(#+) {re.escape(heading)}\n(.*?)(?=^\1 |\Z)", text, re.DOTALL | re.MULTILINE)
        if not found:
            raise SystemExit(f"{name}: has no heading {heading!r}")
        return found[2].strip()
    language = _LANGUAGES.get(Path(name).suffix)
    return f"```{language}\n{text}\n```" if language else text


def list_gallery() -> str:
    """Return the gallery: all configurations with their text and the figures drawn by scripts/refresh_figures.py."""
    return "\n\n".join(_show_configuration(path) for path in sorted((ROOT / "configs").glob("*.yaml")))


def _show_configuration(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    config = yaml.safe_load(text)
    kinds = {study["name"]: study["kind"] for study in config["studies"]}
    pictures = sorted((FIGURES / path.stem).glob("*.png"))
    if not pictures:
        raise SystemExit(f"{path.name}: has no figures; run scripts/refresh_figures.py {path.stem}")
    shown = []
    for picture in pictures:
        # The study of a figure has the longest name with which the file name begins.
        study = max((name for name in kinds if picture.stem.startswith(name)), key=len)
        shown += [
            f"![{path.stem}: {picture.stem}](figures/{path.stem}/{picture.name})",
            f"*Figure `{picture.stem}` of the study `{study}` (`kind: {kinds[study]}`)*",
        ]
    head = f"## {path.stem.replace('_', ' ')}" + (f"\n\n{config['description']}" if "description" in config else "")
    code = f"```yaml\n{text.strip()}\n```"
    file = f"configs/{path.name}"
    return "\n\n".join(
        [head, *shown, f'<details markdown="1"><summary><code>{file}</code></summary>', code, "</details>"]
    )


def compare_paper() -> str:
    """Return the tables that a run of configs/paper.yaml writes to published.md."""
    text = report.as_markdown(report.published_numbers(), report.sharpened_numbers())
    return text.partition("\n")[2].strip().replace("\n## ", "\n### ")


MADE = {"gallery": list_gallery, "published": compare_paper, **TABLES}


def main() -> None:
    """Update or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pages", nargs="*", type=Path, help="default: all pages")
    parser.add_argument("--check", action="store_true", help="change nothing; fail where a page is out of date")
    options = parser.parse_args()
    stale = []
    for page in options.pages or pages():
        old = page.read_text(encoding="utf-8")
        try:
            new = refreshed(old, None if options.check else FIGURES / "guides")
        except Exception as error:
            error.add_note(f"in {page}")
            raise
        if new != old:
            stale.append(str(page))
            if not options.check:
                page.write_text(new, encoding="utf-8")
    if stale:
        print(*stale, sep="\n")
    sys.exit("out of date: run scripts/refresh_docs.py" if stale and options.check else 0)


if __name__ == "__main__":
    main()
