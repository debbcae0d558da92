"""Test the directory of compiled kernels: set after the import of JAX, and chosen by the user."""

import os
import subprocess
import sys

from waiting import LONGEST

from zwidth.numerics.kernel_cache import use_compilation_cache

PROGRAM = """
import jax
from zwidth.numerics.kernel_cache import use_compilation_cache
empty = use_compilation_cache()
jax.jit(lambda x: x * 3 + 1)(2.0)
full = use_compilation_cache()
print(empty.nbytes, full.nbytes > 1000, full.folder == empty.folder)
"""


def test_cache_may_be_enabled_after_the_import_of_jax(tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=LONGEST, env=environment
    )
    assert result.stderr == ""
    assert result.stdout == "0 True True\n"
    assert list((tmp_path / "zwidth" / "jax").glob("*-cache"))


def test_directory_chosen_by_the_user_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert use_compilation_cache().folder == tmp_path
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path)
