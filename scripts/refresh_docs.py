#!/usr/bin/env python3
"""Write into the pages of docs/ what their examples print, draw and include, so that nothing there is typed by hand.

A page is run from top to bottom in a folder of its own, which has the project's configs/ and scripts/ and the files of
docs/guides/files. Each command of a ``console`` block and each ``>>>`` of a ``python`` block is followed by what it
prints. A figure that the page shows from docs/figures/guides is the file of that name that the page has written.
Between ``<!-- include: WHAT -->`` and ``<!-- end -->`` stands a file of the project, a section of one (FILE#HEADING),
the gallery or the table of the paper's numbers. ``--check`` changes nothing and fails where a page is out of date.
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
    """Every page of the site."""
    return sorted(DOCS.rglob("*.md"))


def refreshed(text: str, figures: Path | None = None) -> str:
    """The text of a page with what its blocks print; what it draws goes to the folder ``figures``."""
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
    """The block with the output of each of its examples; without prompts it must be Python, and is not run."""
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
    """What stands between the two marks."""
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
    """Every configuration with its figures, which scripts/refresh_figures.py draws, and its text."""
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
        # The longest name that a figure's begins with is that of its study.
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
    """The tables that a run of configs/paper.yaml writes into published.md."""
    text = report.as_markdown(report.published_numbers(), report.sharpened_numbers())
    return text.partition("\n")[2].strip().replace("\n## ", "\n### ")


MADE = {"gallery": list_gallery, "published": compare_paper, **TABLES}


def main() -> None:
    """Refresh the pages, or check them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pages", nargs="*", type=Path, help="all of them where left out")
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
