"""Project-wide checks: documented paths, pinned dependencies, script permissions and side effects of imports."""

import ast
import itertools
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from waiting import LONGEST

import zwidth

ROOT = Path(__file__).resolve().parents[2]

# A path that begins with a folder of the project, or one of the files next to the README.
NAMED_PATH = re.compile(
    r"(?<![\w./:-])(?:\./)?("
    r"(?:src|tests|benchmarks|configs|scripts|docs|\.ci)/[\w./*-]*[\w*/]"
    r"|(?:[A-Z]{4,}\.md|LICENSE|pyproject\.toml|constraints\.txt)(?![\w/])"
    r")"
)
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)")
# The groups prevent these patterns from matching their own source.
FOREIGN_TEXT = {
    "a registry's host": re.compile(r"(?:pypi|pythonhosted|npmjs|debian)\.(?:org|com|net)"),
    "a machine's path": re.compile(r"(?<![\w.~)/-])/(?:home|root|Users|mnt|opt|srv|tmp|work)/"),
}


def list_documents():
    names = ["README.md", "CONTRIBUTING.md", "configs/*.yaml"]
    return [path for name in names for path in sorted(ROOT.glob(name))]


def list_project_files():
    """All tracked and untracked files that Git does not ignore; without a checkout, all files."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode == 0:
        paths = [ROOT / name for name in listing.stdout.split("\0") if name]
    else:
        hidden = {".venv", ".venv-oldest", ".venv-newest", ".git", "__pycache__", "runs"}
        paths = [path for path in ROOT.rglob("*") if not hidden & set(path.relative_to(ROOT).parts)]
    return [path for path in paths if path.is_file()]


def run_python(code):
    """Run code in a new interpreter, because this one has imported everything already."""
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False, timeout=LONGEST
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("document", list_documents(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_path_in_documents_exists(document):
    text = document.read_text(encoding="utf-8")
    if document.suffix == ".yaml":
        text = "\n".join(re.findall(r"(?:^|\s)#(.*)", text))
    named = set(NAMED_PATH.findall(text))
    missing = {name for name in named if not any(ROOT.glob(name.rstrip("/")))}
    missing |= {link for link in LINK.findall(text) if not (document.parent / link).exists()}
    assert not missing


def test_constraints_contain_only_sorted_pins():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pin = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*==[0-9][0-9a-z.]*")
    assert [line for line in lines if not pin.fullmatch(line)] == []
    names = [line.partition("==")[0] for line in lines]
    assert names == sorted(set(names))


def test_every_dependency_is_pinned_within_its_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines)
    texts = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    requirements = [Requirement(text) for text in texts]
    outside = [
        str(requirement)
        for requirement in requirements
        if requirement.name != project["name"] and not requirement.specifier.contains(pins[requirement.name])
    ]
    assert outside == []


def test_citation_matches_the_project_metadata():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == project["version"] == zwidth.__version__
    assert citation["license"] == project["license"]
    assert citation["keywords"] == project["keywords"]
    # Keys required by CFF 1.2.0.
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    for work in (citation, *citation["references"]):
        assert work["title"]
        assert all({"name"} <= author.keys() or {"family-names"} <= author.keys() for author in work["authors"])
    (paper,) = citation["references"]
    assert (paper["type"], paper["year"]) == ("conference-paper", 2006)
    assert [author["family-names"] for author in paper["authors"]] == ["Hulin", "Preusche", "Hirzinger"]


@pytest.mark.parametrize("kind", FOREIGN_TEXT)
def test_no_file_contains(kind):
    matches = []
    for path in list_project_files():
        data = path.read_bytes()
        if b"\0" in data:
            continue
        match = FOREIGN_TEXT[kind].search(data.decode("utf-8", errors="replace"))
        if match:
            matches.append(f"{path.relative_to(ROOT)}: {match.group()}")
    assert matches == []


def test_scripts_are_executable():
    scripts = [*(path for path in (ROOT / "scripts").iterdir() if path.suffix != ".txt"), ROOT / ".ci" / "run"]
    assert [path.name for path in scripts if path.is_file() and not os.access(path, os.X_OK)] == []


def test_import_changes_no_global_setting():
    output = run_python("""
import importlib, logging, os, pkgutil, warnings

# What these do to each other's settings when they are imported is no doing of ours.
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import click, jax, jaxopt, lineax, matplotlib.pyplot, numpy, optimistix
    import pydantic, scipy.linalg, scipy.optimize, yaml
    for name in ("bokeh.server.server", "dask", "distributed", "flint", "xarray", "zarr"):
        try:
            importlib.import_module(name)
        except ImportError:
            pass

def settings():
    root = logging.getLogger()
    return {
        "jax": dict(jax.config.values),
        "numpy errors": numpy.geterr(),
        "numpy printing": numpy.get_printoptions(),
        "matplotlib": matplotlib.rcParams.copy(),
        "logging": (root.level, root.handlers[:], root.filters[:], logging.root.manager.disable),
        "warnings": warnings.filters[:],
        "environment": dict(os.environ),
    }

before = settings()
import zwidth

for module in pkgutil.walk_packages(zwidth.__path__, "zwidth."):
    if module.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(module.name)
    except ImportError as error:
        # An extra that is not installed.
        if (error.name or "zwidth").partition(".")[0] == "zwidth":
            raise
for name in getattr(zwidth, "__all__", []):
    getattr(zwidth, name)

after = settings()
print([name for name in before if before[name] != after[name]])
""")
    assert output.strip() == "[]"


def test_help_loads_no_heavy_modules():
    output = run_python("""
import sys

from zwidth.cli import main

sys.argv = ["zwidth", "--help"]
try:
    main()
except SystemExit as end:
    assert not end.code
print("heavy:", sorted({"bokeh", "jax", "jaxlib", "matplotlib", "scipy", "tornado", "zarr"} & set(sys.modules)))
""")
    assert "Usage" in output
    assert output.splitlines()[-1] == "heavy: []"


def test_plotting_and_configuration_schema_load_no_jax():
    output = run_python("""
import sys

import zwidth.plotting
import zwidth.studies.document

print("jax" in sys.modules)
""")
    assert output.strip() == "False"


def test_class_names_are_unique():
    files_by_name = {}
    for path in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                files_by_name.setdefault(node.name.strip("_"), []).append(path.name)
    assert {name: files for name, files in files_by_name.items() if len(files) > 1} == {}
