"""Arguments that the scripts pass to pytest and uv, recorded by fake programs."""

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
# Packages for which the quick tests must contain at least one test.
PACKAGES = sorted(path.name for path in (ROOT / "tests" / "unit").iterdir() if path.is_dir() and path.name[0] != "_")

# Fake programs append each call to the file "calls"; the fake uv also creates an environment with a fake pytest.
RECORD = """#!/usr/bin/env bash
printf '%s\\n' "{name} $*" >> "{calls}"
"""
CREATE_VENV = """if [ "$1" = venv ]; then
    for folder in "$@"; do :; done
    rm -rf "$folder" && mkdir -p "$folder/bin" && cp .venv/bin/pytest "$folder/bin/pytest"
fi
"""


def write_fake(path, calls, extra_lines=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(RECORD.format(name=path.name, calls=calls) + extra_lines, encoding="utf-8")
    path.chmod(0o755)


@pytest.fixture
def project(tmp_path):
    """A project with the real scripts and fake programs that record their calls."""
    root = tmp_path / "project"
    for name in ("test", "test-versions", "test-processors"):
        (root / "scripts").mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "scripts" / name, root / "scripts")
    (root / "pyproject.toml").write_text("# as at first\n", encoding="utf-8")
    for name in ("tests/unit/test_one.py", "tests/unit/test_other.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    calls = tmp_path / "calls"
    write_fake(root / "scripts" / "setup", calls)
    write_fake(root / ".venv" / "bin" / "pytest", calls)
    write_fake(root / ".venv" / "bin" / "uv", calls, CREATE_VENV)
    write_fake(root / ".venv" / "bin" / "python", os.devnull, "echo Python 3.11.7\n")
    return root


def record_calls(root, script, *arguments):
    """Run a script and return its exit code and the words of each recorded call."""
    calls = root.parent / "calls"
    calls.unlink(missing_ok=True)
    command = [root / "scripts" / script, *arguments]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, timeout=LONGEST)
    lines = calls.read_text(encoding="utf-8").splitlines() if calls.exists() else []
    return result.returncode, [line.split() for line in lines]


@pytest.mark.parametrize("list_file", LISTS, ids=lambda path: path.stem)
def test_every_listed_test_exists(list_file):
    lines = list_file.read_text(encoding="utf-8").splitlines()
    for line in lines:
        # Lines may name one case of a test, or deselect tests.
        file, _, test = line.removeprefix("--deselect=").partition("[")[0].partition("::")
        assert (ROOT / file).exists(), line
        assert not test or f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), line
    assert len(lines) == len(set(lines)) > 0


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_a_quick_test(package):
    lines = QUICK.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if f"{line}/".startswith(f"tests/unit/{package}/")]


@pytest.mark.parametrize(
    "arguments, expected",
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
def test_test_script_runs_on_every_core_by_default(project, arguments, expected):
    arguments = [word.format(tests="tests") for word in arguments]
    expected = [word.format(tests="tests", root=project) for word in expected]
    code, calls = record_calls(project, "test", *arguments)
    assert code == 0
    assert calls == [["setup", "test"], ["pytest", *expected]]


@pytest.mark.parametrize("which, resolution", [("oldest", "lowest-direct"), ("newest", "highest")])
def test_test_versions_installs_once_and_tests_every_time(project, which, resolution):
    venv = f".venv-{which}"
    pytest_call = ["pytest", *ON_EVERY_CORE, "@tests/versions.txt", "-x"]
    venv_call = ["uv", "venv", "--quiet", "--clear", "--python", ".venv/bin/python", venv]
    code, calls = record_calls(project, "test-versions", which, "-x")
    assert code == 0
    assert calls[:2] == [["setup", "dev"], venv_call]
    assert calls[2][:3] == ["uv", "pip", "install"]
    assert calls[2][-4:] == ["--resolution", resolution, "-e", ".[test]"]
    assert f"{venv}/bin/python" in calls[2]
    assert calls[3:] == [pytest_call]
    assert record_calls(project, "test-versions", which, "-x") == (0, [["setup", "dev"], pytest_call])
    (project / "pyproject.toml").write_text("# another bound\n", encoding="utf-8")
    assert venv_call in record_calls(project, "test-versions", which, "-x")[1]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the script tries processors of one family")
def test_test_processors_tries_every_type_even_if_one_fails(project):
    calls = project.parent / "calls"
    fake_commands = f"echo ${{XLA_FLAGS##*=}} $OPENBLAS_CORETYPE >> '{calls}'; [ $OPENBLAS_CORETYPE != Haswell ]\n"
    write_fake(project / ".venv" / "bin" / "pytest", calls, fake_commands)
    code, recorded = record_calls(project, "test-processors", "-x")
    assert (code, recorded[0]) == (1, ["setup", "test"])
    numbers = "@tests/numbers.txt"
    assert recorded[1] == ["pytest", *ON_EVERY_CORE, numbers, "-x"]
    assert recorded[3] == ["pytest", *ON_EVERY_CORE, "@tests/printed.txt", numbers, "-x"]
    assert recorded[2::2] == [["AVX2", "Haswell"], ["SSE4_2", "Nehalem"]]
    # Without AVX-512, the processor itself represents the other types.
    write_fake(project / ".venv" / "bin" / "python", os.devnull)
    code, recorded = record_calls(project, "test-processors")
    assert (code, recorded[2::2]) == (0, [["SSE4_2", "Nehalem"]])


STEPS = ("scripts/setup", "scripts/test", "scripts/test-processors", "scripts/test-package", "scripts/test-versions")
TOOLS = tuple(f".venv/bin/{name}" for name in ("codespell", "lint-imports", "pyright", "python", "ruff"))


@pytest.mark.parametrize("failing", [(), ("pyright",), ("codespell",), ("test", "test-versions")])
def test_every_ci_step_runs_even_if_others_fail(tmp_path, failing):
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci")
    calls = tmp_path / "calls"
    for name in (*STEPS, *TOOLS, "bin/chromium"):
        tool = Path(name).name
        write_fake(tmp_path / name, calls, f"echo 'this is {tool}'\n{'exit 3' if tool in failing else ''}\n")
    result = subprocess.run(
        [tmp_path / ".ci" / "run"],
        env={**os.environ, "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST,
    )
    recorded = calls.read_text(encoding="utf-8").splitlines()
    assert recorded[0] == "setup test dev"
    tools = ["lint-imports ", "pyright ", "python scripts/check_prose.py", "ruff check", "ruff format --check"]
    tests = ["test ", "test-package ", "test-processors ", "test-versions oldest"]
    spelling = "codespell README.md CONTRIBUTING.md CHANGELOG.md benchmarks configs docs scripts src tests"
    assert sorted(recorded[1:]) == [spelling, *tools, *tests]
    # The output of steps that run in parallel with the tests is printed, too.
    assert all(f"this is {Path(name).name}" in result.stdout for name in (*STEPS, *TOOLS))
    assert result.returncode == (1 if failing else 0)
    assert result.stdout.count("FAILED (exit ") == len(failing)
    last = result.stdout.splitlines()[-1]
    names = {"codespell": "prose", "pyright": "types", "test": "tests", "test-versions": "oldest versions"}
    printed = set(last.removeprefix("==> failed: ").split(",")) if failing else last
    assert printed == ({names[name] for name in failing} if failing else "==> all steps passed")
