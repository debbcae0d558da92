"""Compiled kernels kept between runs, in a folder of the user's cache that mends itself.

JAX writes its cache without a safeguard: a program that is killed meanwhile, or finds the disk full, leaves half an
entry behind, which JAX then complains about, compiles again and never replaces.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

_VARIABLE = "JAX_COMPILATION_CACHE_DIR"
# Reading: half an entry. Writing: no room for one, which leaves half an entry.
_COMPLAINTS = ("Error reading persistent compilation cache", "Error writing persistent compilation cache")


def use_compilation_cache() -> None:
    """Let JAX keep compiled kernels in the user's cache folder, unless JAX was told otherwise."""
    if _VARIABLE not in os.environ:
        os.environ[_VARIABLE] = str(_own_folder())
        # Every kernel is worth keeping: the many small ones add up to most of a cold start.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    mend_compilation_cache()


def mend_compilation_cache() -> None:
    """From now on, empty the folder when JAX finds half an entry in it; leave a folder of the user's choice alone."""
    folder = _own_folder()
    if os.environ.get(_VARIABLE) != str(folder):
        return
    show = warnings.showwarning

    def mend_or_show(message: Any, *details: Any, **more: Any) -> None:
        if not str(message).startswith(_COMPLAINTS):
            show(message, *details, **more)
            return
        # Which entry it is, JAX does not say. The folder itself stays, for JAX has made sure of it once and for all.
        for entry in folder.glob("*-cache"):
            entry.unlink(missing_ok=True)

    warnings.showwarning = mend_or_show


def _own_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "zwidth" / "jax"
