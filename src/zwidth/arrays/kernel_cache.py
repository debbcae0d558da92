"""The persistent cache of compiled kernels, a folder in the user's cache directory."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NamedTuple

_VARIABLE = "JAX_COMPILATION_CACHE_DIR"


class KernelCache(NamedTuple):
    """Where compiled kernels are kept, and how many bytes they take."""

    folder: Path
    nbytes: int


def use_compilation_cache(folder: str | Path | None = None) -> KernelCache:
    """Store compiled kernels on disk, so that later processes load them instead of compiling them again.

    Commands use the cache by default. In Python call this function once, before or after importing JAX.

    To empty the cache, delete the folder. Also delete it if JAX warns of an error while reading the cache: a killed
    process or a full disk can leave an incomplete entry, which JAX neither uses nor replaces.

    Args:
        folder: folder of the cache. Default: the value of JAX's environment variable JAX_COMPILATION_CACHE_DIR, or
            ``zwidth/jax`` in the user's cache directory ($XDG_CACHE_HOME or ~/.cache).

    Returns:
        KernelCache: ``folder``; ``nbytes``, its current size. A kernel takes 10 to 500 kB. Entries are never removed.

    Example:
        >>> import zwidth
        >>> cache = zwidth.use_compilation_cache()
        >>> cache.folder.is_absolute(), cache.nbytes >= 0
        (True, True)
    """
    if folder is not None or _VARIABLE not in os.environ:
        os.environ[_VARIABLE] = str(_own_folder() if folder is None else Path(folder).absolute())
        # Every kernel is worth keeping: the many small ones add up to most of a cold start.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
        # JAX reads its variables when it is imported; later it must be told.
        if "jax" in sys.modules:
            import jax

            jax.config.update("jax_compilation_cache_dir", os.environ[_VARIABLE])
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
            jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    used = Path(os.environ[_VARIABLE])
    return KernelCache(used, sum(entry.stat().st_size for entry in used.glob("*") if entry.is_file()))


def _own_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "zwidth" / "jax"
