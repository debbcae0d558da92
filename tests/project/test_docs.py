"""The pages of docs/ show actual output, figures and values, and the reference lists every public name."""

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
# Shown in the project's README only.
README_PICTURES = {"docs-site.png"}
# Limit for the total size of the pictures in a clone.
MAX_PICTURE_BYTES = 6_000_000


@pytest.fixture(autouse=True)
def jax_settings():
    """Restore JAX's precision, which the examples set as a user does."""
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


def test_missing_and_outdated_outputs_are_written(refresh_docs):
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
def test_examples_that_fail_raise(refresh_docs, text, error):
    with pytest.raises(error):
        refresh_docs.refreshed(text)


@pytest.fixture
def hooks(monkeypatch):
    """Hooks of the documentation site as a module."""
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("hooks")


def test_formulas_are_typeset_as_mathml(hooks):
    html = hooks.typeset("T^ <= sqrt(a2) e^(-delta t) phi1, of x''")
    for part in (
        "<mover><mi>T</mi><mo>^</mo></mover>",
        "<mo>≤</mo>",
        "<msqrt><mrow><msub><mi>a</mi><mn>2</mn></msub></mrow></msqrt>",
        "<msup><mi>e</mi><mrow><mo>−</mo><mi>δ</mi>",
        "<msub><mi>φ</mi><mn>1</mn></msub>",
        "<mtext>of</mtext>",
        "<msup><mi>x</mi><mo>′′</mo></msup>",
    ):
        assert part in html
    assert hooks.typeset("a (b < c") == "<code>a (b &lt; c</code>"


def test_prompts_and_output_are_marked_for_the_copy_button(hooks):
    """The copy button omits elements of these classes."""
    assert hooks.on_page_markdown("```python\n>>> 1\n1\n```") == "```pycon\n>>> 1\n1\n```"
    assert hooks.on_page_markdown("```python\nx = 1\n```") == "```python\nx = 1\n```"
    page = SimpleNamespace(file=SimpleNamespace(src_uri="index.md"))
    line = '<span class="gp"># </span>A<span class="w"> </span>first study'
    assert hooks.on_page_content(f"{line}\n", page) == '<span class="go"># A first study</span>\n'
    assert "data-md-copying" in (DOCS / "stylesheets" / "extra.css").read_text(encoding="utf-8")


def test_every_formula_of_the_theory_can_be_typeset(hooks):
    """A formula that cannot be parsed would be shown as code."""
    lines = [
        line
        for page in sorted((DOCS / "theory").glob("*.md"))
        for block in re.findall(r"(?:(?<=\n\n)(?: {4}\S.*\n)+)", page.read_text(encoding="utf-8"))
        for line in block.splitlines()
    ]
    assert len(lines) > 60
    assert not [line for line in lines if "<code>" in hooks.typeset(line.strip())]


def test_included_section_ends_at_the_next_heading(refresh_docs):
    section = refresh_docs.include("benchmarks/results/bench.md#What each question costs")
    assert "| question |" in section
    assert "###" not in section


@pytest.mark.parametrize("module", ["", "plotting"])
def test_every_public_name_is_listed_once_in_the_reference(module):
    stub = (ROOT / "src" / "zwidth" / module / "__init__.pyi").read_text(encoding="utf-8")
    public = re.findall(r"^from .* as (\w+)$", stub, re.MULTILINE)
    text = "\n".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    prefix = f"zwidth.{module}." if module else "zwidth."
    named = re.findall(rf"^::: {re.escape(prefix)}(\w+)$", text, re.MULTILINE)
    if not module:
        # Modules are listed by their full path.
        named += re.findall(r"^::: zwidth\.\w+\.(devices|plot)$", text, re.MULTILINE)
    assert len(public) > 10
    assert sorted(named) == sorted(public)


def test_pictures_are_small_and_all_are_shown():
    pictures = [path for path in (DOCS / "figures").rglob("*") if path.is_file()]
    texts = "\n".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *PAGES])
    shown = {Path(name).as_posix() for name in re.findall(r"figures/([\w./-]+)\)", texts)} | README_PICTURES
    assert [path for path in pictures if path.relative_to(DOCS / "figures").as_posix() not in shown] == []
    assert sum(path.stat().st_size for path in pictures) < MAX_PICTURE_BYTES


def test_docs_script_runs_setup_and_a_strict_build(tmp_path):
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
