"""What the scripts hand on to pytest and uv: they run for real, beside stand-ins that write their arguments down."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from pathlib import Path

import pytest
from waiting import LONGEST

ROOT = Path(__file__).resolve().parents[2]
QUICK = ROOT / "tests" / "quick.txt"
LISTS = sorted((ROOT / "tests").glob("*.txt"))
ON_EVERY_CORE = ["--numprocesses", "auto", "--dist", "loadfile"]
# What the quick tests must hold something of.
ROOMS = sorted(path.name for path in (ROOT / "tests" / "unit").iterdir() if path.is_dir() and path.name[0] != "_")

# Every call becomes a line in the file "calls"; uv makes an environment whose pytest does the same.
NOTE = """#!/usr/bin/env bash
printf '%s\\n' "{name} $*" >> "{calls}"
"""
MAKE = """if [ "$1" = venv ]; then
    for folder in "$@"; do :; done
    rm -rf "$folder" && mkdir -p "$folder/bin" && cp .venv/bin/pytest "$folder/bin/pytest"
fi
"""


def stand_in(path, calls, more=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(NOTE.format(name=path.name, calls=calls) + more, encoding="utf-8")
    path.chmod(0o755)


@pytest.fixture
def project(tmp_path):
    """A project with the real scripts, whose programs only write down how they are called."""
    root = tmp_path / "project"
    for name in ("test", "test-versions", "test-processors"):
        (root / "scripts").mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "scripts" / name, root / "scripts")
    (root / "pyproject.toml").write_text("# as at first\n", encoding="utf-8")
    for name in ("tests/unit/test_one.py", "tests/unit/test_other.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    calls = tmp_path / "calls"
    stand_in(root / "scripts" / "setup", calls)
    stand_in(root / ".venv" / "bin" / "pytest", calls)
    stand_in(root / ".venv" / "bin" / "uv", calls, MAKE)
    stand_in(root / ".venv" / "bin" / "python", os.devnull, "echo Python 3.11.7\n")
    return root


def calls_of(root, script, *arguments):
    """What a script calls, a list of words for each call."""
    calls = root.parent / "calls"
    calls.unlink(missing_ok=True)
    command = [root / "scripts" / script, *arguments]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, timeout=LONGEST)
    lines = calls.read_text(encoding="utf-8").splitlines() if calls.exists() else []
    return done.returncode, [line.split() for line in lines]


@pytest.mark.parametrize("listed", LISTS, ids=lambda path: path.stem)
def test_every_listed_test_exists(listed):
    lines = listed.read_text(encoding="utf-8").splitlines()
    for line in lines:
        # Of a test that has cases one may be listed, and one of a file may be left out.
        file, _, test = line.removeprefix("--deselect=").partition("[")[0].partition("::")
        assert (ROOT / file).exists(), line
        assert not test or f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), line
    assert len(lines) == len(set(lines)) > 0


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_has_a_quick_test(room):
    lines = QUICK.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if f"{line}/".startswith(f"tests/unit/{room}/")]


@pytest.mark.parametrize(
    "given, handed_on",
    [
        ([], ON_EVERY_CORE),
        (["--quick"], [*ON_EVERY_CORE, "@tests/quick.txt"]),
        (["-k", "scene"], [*ON_EVERY_CORE, "-k", "scene"]),
        (["{tests}/unit"], [*ON_EVERY_CORE, "{root}/{tests}/unit"]),
        (["{tests}/unit/test_one.py::test_derivatives"], ["{root}/{tests}/unit/test_one.py::test_derivatives"]),
        (
            ["{tests}/unit/test_one.py", "{tests}/unit/test_other.py"],
            [*ON_EVERY_CORE, "{root}/{tests}/unit/test_one.py", "{root}/{tests}/unit/test_other.py"],
        ),
        (["-n", "3"], ["-n", "3"]),
        (["-n0", "--quick"], ["-n0", "@tests/quick.txt"]),
        (["--pdb"], ["--pdb"]),
    ],
)
def test_the_tests_run_on_every_core_unless_told_otherwise(project, given, handed_on):
    given = [word.format(tests="tests") for word in given]
    handed_on = [word.format(tests="tests", root=project) for word in handed_on]
    code, calls = calls_of(project, "test", *given)
    assert code == 0
    assert calls == [["setup", "test"], ["pytest", *handed_on]]


@pytest.mark.parametrize("which, resolution", [("oldest", "lowest-direct"), ("newest", "highest")])
def test_versions_are_installed_once_and_tested_every_time(project, which, resolution):
    venv = f".venv-{which}"
    tested = ["pytest", *ON_EVERY_CORE, "@tests/versions.txt", "-x"]
    made = ["uv", "venv", "--quiet", "--clear", "--python", ".venv/bin/python", venv]
    code, calls = calls_of(project, "test-versions", which, "-x")
    assert code == 0
    assert calls[:2] == [["setup", "dev"], made]
    assert calls[2][:3] == ["uv", "pip", "install"]
    assert calls[2][-4:] == ["--resolution", resolution, "-e", ".[test]"]
    assert f"{venv}/bin/python" in calls[2]
    assert calls[3:] == [tested]
    assert calls_of(project, "test-versions", which, "-x") == (0, [["setup", "dev"], tested])
    (project / "pyproject.toml").write_text("# another bound\n", encoding="utf-8")
    assert made in calls_of(project, "test-versions", which, "-x")[1]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the script tries processors of one family")
def test_every_processor_is_tried_even_when_one_fails(project):
    calls = project.parent / "calls"
    held = f"echo ${{XLA_FLAGS##*=}} $OPENBLAS_CORETYPE >> '{calls}'; [ $OPENBLAS_CORETYPE != Haswell ]\n"
    stand_in(project / ".venv" / "bin" / "pytest", calls, held)
    code, called = calls_of(project, "test-processors", "-x")
    assert (code, called[0]) == (1, ["setup", "test"])
    numbers = "@tests/numbers.txt"
    assert called[1] == ["pytest", *ON_EVERY_CORE, numbers, "-x"]
    assert called[3] == ["pytest", *ON_EVERY_CORE, "@tests/printed.txt", numbers, "-x"]
    assert called[2::2] == [["AVX2", "Haswell"], ["SSE4_2", "Nehalem"]]
    # One that has no AVX-512 stands in for itself in all other tests.
    stand_in(project / ".venv" / "bin" / "python", os.devnull)
    code, called = calls_of(project, "test-processors")
    assert (code, called[2::2]) == (0, [["SSE4_2", "Nehalem"]])


STEPS = ("scripts/setup", "scripts/test", "scripts/test-processors", "scripts/test-package", "scripts/test-versions")
TOOLS = tuple(f".venv/bin/{name}" for name in ("codespell", "lint-imports", "pyright", "python", "ruff"))


@pytest.mark.parametrize("failing", [(), ("pyright",), ("codespell",), ("test", "test-versions")])
def test_every_step_of_the_checks_runs_even_when_others_fail(tmp_path, failing):
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci")
    calls = tmp_path / "calls"
    for name in (*STEPS, *TOOLS, "bin/chromium"):
        last = Path(name).name
        stand_in(tmp_path / name, calls, f"echo 'this is {last}'\n{'exit 3' if last in failing else ''}\n")
    done = subprocess.run(
        [tmp_path / ".ci" / "run"],
        env={**os.environ, "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST,
    )
    called = calls.read_text(encoding="utf-8").splitlines()
    assert called[0] == "setup test dev"
    tools = ["lint-imports ", "pyright ", "python scripts/check_prose.py", "ruff check", "ruff format --check"]
    tests = ["test ", "test-package ", "test-processors ", "test-versions oldest"]
    spelling = "codespell README.md CONTRIBUTING.md CHANGELOG.md benchmarks configs docs scripts src tests"
    assert sorted(called[1:]) == [spelling, *tools, *tests]
    # What runs beside the tests is told as well.
    assert all(f"this is {Path(name).name}" in done.stdout for name in (*STEPS, *TOOLS))
    assert done.returncode == (1 if failing else 0)
    assert done.stdout.count("FAILED (exit ") == len(failing)
    last = done.stdout.splitlines()[-1]
    names = {"codespell": "prose", "pyright": "types", "test": "tests", "test-versions": "oldest versions"}
    told = set(last.removeprefix("==> failed: ").split(",")) if failing else last
    assert told == ({names[name] for name in failing} if failing else "==> all steps passed")
