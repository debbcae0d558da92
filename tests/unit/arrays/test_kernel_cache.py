"""The folder of compiled kernels mends itself after a program was killed that wrote to it."""

import os
import subprocess
import sys
import warnings

import pytest
from waiting import LONGEST

from zwidth.arrays.kernel_cache import mend_compilation_cache, use_compilation_cache

PROGRAM = """
from zwidth.arrays.kernel_cache import use_compilation_cache
use_compilation_cache()
import jax
print(float(jax.jit(lambda x: x * 3 + 1)(2.0)))
"""
LATE = """
import jax
from zwidth.arrays.kernel_cache import use_compilation_cache
empty = use_compilation_cache()
jax.jit(lambda x: x * 3 + 1)(2.0)
full = use_compilation_cache()
print(empty.nbytes, full.nbytes > 1000, full.folder == empty.folder)
"""


def run(program, folder):
    """What a program says whose user's cache is there, and the entries behind it."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment["XDG_CACHE_HOME"] = str(folder)
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=LONGEST, env=environment
    )
    assert result.stderr == ""
    return result.stdout, sorted((folder / "zwidth" / "jax").glob("*-cache"))


def test_it_may_be_asked_for_after_jax_was_imported_and_half_an_entry_is_removed_without_a_word(tmp_path):
    said, entries = run(LATE, tmp_path)
    assert said == "0 True True\n"
    assert entries
    whole = [entry.read_bytes() for entry in entries]
    for entry, data in zip(entries, whole, strict=True):
        entry.write_bytes(data[: len(data) // 2])
    assert run(PROGRAM, tmp_path) == ("7.0\n", entries)
    assert all(entry.stat().st_size > len(data) // 2 for entry, data in zip(entries, whole, strict=True))


@pytest.fixture
def restored(monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)


@pytest.mark.usefixtures("restored")
def test_a_folder_of_the_users_choice_is_left_alone(monkeypatch, tmp_path):
    before = warnings.showwarning
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    use_compilation_cache()
    assert warnings.showwarning is before
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path)


@pytest.mark.usefixtures("restored")
def test_other_warnings_are_shown(monkeypatch, tmp_path):
    shown = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *rest, **more: shown.append(str(message)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "zwidth" / "jax"))
    mend_compilation_cache()
    warnings.showwarning(UserWarning("something else"), UserWarning, "file", 1)
    warnings.showwarning(UserWarning("Error writing persistent compilation cache entry"), UserWarning, "file", 1)
    assert shown == ["something else"]
