#!/usr/bin/env python3
"""Check docstrings, comments, messages and pages against a list of forbidden openings and phrases.

    scripts/check_prose.py [FILE...]      checks the given files; by default src, configs, docs and the root's pages

The list, ``scripts/prose.txt``, has three sections. ``[openings]`` contains words that no docstring and no comment of
Python code may start with. ``[phrases]`` contains one ``PHRASE = REPLACEMENT`` per line; the phrase may occur in no
docstring, comment, string or page, whatever its capitals and line breaks. ``[exceptions]`` contains one
``FILE: PHRASE`` per line. The check finds patterns only: a text without any of them may still be unclear.
"""

from __future__ import annotations

import ast
import itertools
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "scripts" / "prose.txt"
CHECKED = ("*.md", "configs/*.yaml", "docs/**/*.md", "docs/**/*.py", "src/**/*.py", "src/**/*.pyi")


class Rules(NamedTuple):
    """The sections of the list."""

    openings: frozenset[str]
    phrases: dict[str, str]  # replacement by phrase
    exceptions: frozenset[tuple[str, str]]  # path relative to the root, and phrase


class Text(NamedTuple):
    """One text of a file: a docstring, a block of comments, a string, or a whole page."""

    line: int  # number of its first line, counted from 1
    text: str
    opens: bool  # whether its first word is checked


def read_rules(text: str) -> Rules:
    """Read the list; blank lines and lines that start with # are ignored."""
    sections: dict[str, list[str]] = {"openings": [], "phrases": [], "exceptions": []}
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("["):
            lines = sections[line.strip("[]")]
        elif line.strip() and not line.startswith("#"):
            lines.append(line.strip())
    phrases = dict(_split(line, " = ") for line in sections["phrases"])
    exceptions = frozenset(_split(line, ": ") for line in sections["exceptions"])
    return Rules(frozenset(sections["openings"]), phrases, exceptions)


def list_texts(path: Path) -> Iterator[Text]:
    """Yield the texts of a file. A page or a configuration is one text without the number signs of its comments."""
    source = path.read_text(encoding="utf-8")
    if path.suffix not in (".py", ".pyi"):
        yield Text(1, re.sub(r"^ *#+", "", source, flags=re.MULTILINE), False)
        return
    tree = ast.parse(source)
    # Docstrings, also those of fields, are statements that consist of a string.
    documents = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield Text(node.lineno, node.value, node in documents)
    yield from _list_comments(path)


def _list_comments(path: Path) -> Iterator[Text]:
    """Yield the comments of Python code; comments on consecutive lines, at the same column, are one text."""
    with path.open("rb") as file:
        comments = [token for token in tokenize.tokenize(file.readline) if token.type == tokenize.COMMENT]
    # Line minus index is constant within a block.
    keys = ((token.start[0] - index, token.start[1]) for index, token in enumerate(comments))
    for _, group in itertools.groupby(zip(keys, comments, strict=True), key=lambda pair: pair[0]):
        block = [token for _, token in group]
        yield Text(block[0].start[0], "\n".join(token.string.lstrip("#: ") for token in block), True)


def check(paths: Iterable[Path], rules: Rules) -> list[str]:
    """Return one message per violation."""
    patterns = {phrase: _compile_phrase(phrase) for phrase in rules.phrases}
    problems = []
    for path in paths:
        name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name
        for line, text, opens in list_texts(path):
            first = re.match(r"\W*(\w+)", text)
            if opens and first and first[1] in rules.openings:
                problems.append(f"{name}:{line}: starts with {first[1]!r}; start with a verb or a noun")
            for phrase, pattern in patterns.items():
                if (name, phrase) not in rules.exceptions:
                    lines = [line + text.count("\n", 0, match.start()) for match in pattern.finditer(text)]
                    problems += [f"{name}:{number}: {phrase!r}; write {rules.phrases[phrase]}" for number in lines]
    return problems


def _compile_phrase(phrase: str) -> re.Pattern[str]:
    """Return a pattern that matches a phrase as whole words, with any white space between them."""
    return re.compile(r"\b" + r"\s+".join(map(re.escape, phrase.split())) + r"\b", re.IGNORECASE)


def _split(line: str, mark: str) -> tuple[str, str]:
    """Return both sides of a line of the list; raise `ValueError` if the mark is missing."""
    left, found, right = line.partition(mark)
    if not found:
        raise ValueError(f"{LIST.name}: {line!r} has no {mark!r}")
    return left.strip(), right.strip()


def main() -> None:
    """Check the files, print the violations, and exit with 1 if there are any."""
    paths = [Path(name).resolve() for name in sys.argv[1:]]
    paths = paths or sorted(path for pattern in CHECKED for path in ROOT.glob(pattern))
    problems = check(paths, read_rules(LIST.read_text(encoding="utf-8")))
    print(*problems, f"{len(problems)} violations in {len(paths)} files", sep="\n")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
