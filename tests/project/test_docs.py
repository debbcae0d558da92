"""The pages of docs/ show what the program really prints, draws and computes, and name everything that is public."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest
from waiting import LONGEST

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
# For the project's README.
PORTRAITS = {"docs-site.png"}
# What all pictures together may take in a clone.
MOST_BYTES = 6_000_000


@pytest.fixture(autouse=True)
def jax_settings():
    """Pages set JAX's precision as a user does; other tests keep their own."""
    config: Any = jax.config
    before = config.jax_enable_x64
    yield
    config.update("jax_enable_x64", before)


@pytest.fixture
def refresh_docs(monkeypatch):
    """The script as a module."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("refresh_docs")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_every_page_is_up_to_date(page, refresh_docs, fitted_once, unpainted):
    text = page.read_text(encoding="utf-8")
    assert refresh_docs.refreshed(text) == text


def test_outputs_are_written_where_they_are_missing_or_old(refresh_docs):
    old = "```python\n>>> x = 2\n>>> x + 1\n4\n>>> for k in range(2):\n...     print(k)\n```\n"
    new = "```python\n>>> x = 2\n>>> x + 1\n3\n>>> for k in range(2):\n...     print(k)\n0\n1\n```\n"
    assert refresh_docs.refreshed(old) == new
    assert refresh_docs.refreshed("```console\n$ zwidth --version\n```") == (
        f"```console\n$ zwidth --version\n{refresh_docs.show_commands('$ zwidth --version').splitlines()[1]}\n```"
    )


@pytest.mark.parametrize(
    "text, error",
    [
        ("```python\n>>> 1 / 0\n```", ZeroDivisionError),
        ("```python\nno python\n```", SyntaxError),
        ("```console\n$ zwidth check --stiffness 1\n```", subprocess.CalledProcessError),
        ("```console\n$ ls\n```", SystemExit),
        ("![a figure](figures/guides/nobody.svg)", SystemExit),
        ("<!-- include: docs/scenes.md#No such heading -->\n<!-- end -->", SystemExit),
        ("<!-- include: docs/no_such_file.md -->\n<!-- end -->", FileNotFoundError),
    ],
)
def test_what_cannot_be_run_is_an_error(refresh_docs, text, error):
    with pytest.raises(error):
        refresh_docs.refreshed(text)


@pytest.fixture
def hooks(monkeypatch):
    """What the site does beyond mkdocs, as a module."""
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("hooks")


def test_formulas_are_typeset(hooks):
    shown = hooks.typeset("T^ <= sqrt(a2) e^(-delta t) phi1, of x''")
    for part in (
        "<mover><mi>T</mi><mo>^</mo></mover>",
        "<mo>≤</mo>",
        "<msqrt><mrow><msub><mi>a</mi><mn>2</mn></msub></mrow></msqrt>",
        "<msup><mi>e</mi><mrow><mo>−</mo><mi>δ</mi>",
        "<msub><mi>φ</mi><mn>1</mn></msub>",
        "<mtext>of</mtext>",
        "<msup><mi>x</mi><mo>′′</mo></msup>",
    ):
        assert part in shown
    assert hooks.typeset("a (b < c") == "<code>a (b &lt; c</code>"


def test_prompts_and_output_have_classes_of_their_own(hooks):
    """The copy button leaves both out."""
    assert hooks.on_page_markdown("```python\n>>> 1\n1\n```") == "```pycon\n>>> 1\n1\n```"
    assert hooks.on_page_markdown("```python\nx = 1\n```") == "```python\nx = 1\n```"
    page = SimpleNamespace(file=SimpleNamespace(src_uri="index.md"))
    line = '<span class="gp"># </span>A<span class="w"> </span>first study'
    assert hooks.on_page_content(f"{line}\n", page) == '<span class="go"># A first study</span>\n'
    assert "data-md-copying" in (DOCS / "stylesheets" / "extra.css").read_text(encoding="utf-8")


def test_every_formula_of_the_theory_can_be_typeset(hooks):
    """None is shown as it is typed, for want of a bracket."""
    lines = [
        line
        for page in sorted((DOCS / "theory").glob("*.md"))
        for block in re.findall(r"(?:(?<=\n\n)(?: {4}\S.*\n)+)", page.read_text(encoding="utf-8"))
        for line in block.splitlines()
    ]
    assert len(lines) > 60
    assert not [line for line in lines if "<code>" in hooks.typeset(line.strip())]


def test_a_section_ends_where_the_next_one_begins(refresh_docs):
    found = refresh_docs.include("benchmarks/results/bench.md#What each question costs")
    assert "| question |" in found
    assert "###" not in found


@pytest.mark.parametrize("module", ["", "plotting"])
def test_every_public_name_stands_once_in_the_reference(module):
    stub = (ROOT / "src" / "zwidth" / module / "__init__.pyi").read_text(encoding="utf-8")
    public = re.findall(r"^from .* as (\w+)$", stub, re.MULTILINE)
    text = "\n".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    prefix = f"zwidth.{module}." if module else "zwidth."
    named = re.findall(rf"^::: {re.escape(prefix)}(\w+)$", text, re.MULTILINE)
    if not module:
        # Modules stand there by their place.
        named += re.findall(r"^::: zwidth\.\w+\.(devices|plot)$", text, re.MULTILINE)
    assert len(public) > 10
    assert sorted(named) == sorted(public)


def test_pictures_are_few_and_all_are_shown():
    pictures = [path for path in (DOCS / "figures").rglob("*") if path.is_file()]
    texts = "\n".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *PAGES])
    shown = {Path(name).as_posix() for name in re.findall(r"figures/([\w./-]+)\)", texts)} | PORTRAITS
    assert [path for path in pictures if path.relative_to(DOCS / "figures").as_posix() not in shown] == []
    assert sum(path.stat().st_size for path in pictures) < MOST_BYTES


def test_the_script_sets_up_and_builds_strictly(tmp_path):
    (tmp_path / "scripts").mkdir()
    (tmp_path / "docs").mkdir()
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "docs", tmp_path / "scripts")
    (tmp_path / "docs" / "mkdocs.yml").write_text("site_name: here\n", encoding="utf-8")
    calls = tmp_path / "calls"
    for program in (tmp_path / "scripts" / "setup", tmp_path / ".venv" / "bin" / "mkdocs"):
        program.write_text(f'#!/bin/sh\necho "{program.name} $*" >> "{calls}"\ncat >> "{calls}"\n', encoding="utf-8")
        program.chmod(0o755)
    command = [tmp_path / "scripts" / "docs", "--site-dir", "elsewhere"]
    subprocess.run(command, cwd=os.sep, check=True, stdin=subprocess.DEVNULL, timeout=LONGEST)
    assert calls.read_text(encoding="utf-8").splitlines() == [
        "setup docs",
        "mkdocs build --strict --config-file - --site-dir elsewhere",
        "site_name: here",
    ]
