"""Persistent cache of compiled JAX kernels, a folder in the user's cache directory."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NamedTuple

FOLDER_VARIABLE = "JAX_COMPILATION_CACHE_DIR"  # environment variable of JAX


class KernelCache(NamedTuple):
    """Folder of the cache of compiled kernels, and its size in bytes."""

    folder: Path
    nbytes: int  # total size of its files


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
    if folder is not None or FOLDER_VARIABLE not in os.environ:
        os.environ[FOLDER_VARIABLE] = str(_get_default_folder() if folder is None else Path(folder).absolute())
        # Also store kernels that compile fast, because together these take most of the time of a first call.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
        # If JAX is already imported, also set its options, because it reads environment variables only at import.
        if "jax" in sys.modules:
            import jax

            jax.config.update("jax_compilation_cache_dir", os.environ[FOLDER_VARIABLE])
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
            jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    path = Path(os.environ[FOLDER_VARIABLE])
    return KernelCache(path, sum(entry.stat().st_size for entry in path.glob("*") if entry.is_file()))


def _get_default_folder() -> Path:
    """Return the default folder of the cache: ``zwidth/jax`` in the user's cache directory."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "zwidth" / "jax"
