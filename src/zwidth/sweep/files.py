"""Files and folders of results: checks, checksums, versions, and the lock that limits a folder to one writing run.

The lock is an operating system lock on ``DIR/.locks/run``. It ends with its process, even if the process is killed, so
that the remaining file blocks no later run. On NFS it also excludes runs on other machines.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from zwidth import __version__
from zwidth.words.errors import InputError, StoreBusyError
from zwidth.words.files import REMEDIES

# No chunk of a sweep would escape these.
_HOPELESS = frozenset(list(REMEDIES)[:6])
# Packages whose release can change the last digit of a result.
_PACKAGES = ("jax", "jaxlib", "numpy")
LOCKS = ".locks"
"""Name of the folder of locks in a folder of results."""
ELSEWHERE = "choose another folder with --out DIR"
"""What helps in every case."""

PATIENCE = 1.0  # s; waiting time for the lock, because a killed run needs some time to end
# Error codes of file systems that do not support locks.
_NO_LOCKS = frozenset({errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK})


def hopeless(error: BaseException | None) -> bool:
    """Whether an exception comes from an error of the system that everything else would meet as well."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error.errno in _HOPELESS
        error = error.__cause__ or error.__context__
    return False


def check_folder(folder: Path) -> None:
    """Refuse a folder for results that cannot be made or written, as far as can be told without writing."""
    nearest = existing(folder)
    if not nearest.is_dir():
        where = "is a file" if nearest == folder.absolute() else f"cannot be made, for {nearest} is a file"
        raise InputError(f"out: {folder} {where}; {ELSEWHERE}")
    if not os.access(nearest, os.W_OK | os.X_OK):
        where = "is read-only" if nearest == folder.absolute() else f"cannot be made, for {nearest} is read-only"
        raise InputError(f"out: {folder} {where}, at least to you; {ELSEWHERE}")


def is_plain_name(name: str) -> bool:
    """Whether a name is that of a file in a folder, and leads nowhere else."""
    return Path(name).name == name and name not in ("", "..") and "\0" not in name


def existing(folder: Path) -> Path:
    """The folder itself or the nearest path above it that exists."""
    folder = folder.absolute()
    return next(path for path in (folder, *folder.parents) if path.exists())


def content(path: Path) -> bytes:
    """What a file holds; nothing where there is none."""
    with suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return path.read_bytes()
    return b""


def digest(value: Any) -> str:
    """The SHA-256 of a JSON value, whatever the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def versions(*more: str) -> dict[str, str]:
    """The releases that results depend on, and those of more packages."""
    found = {"zwidth": __version__, "python": platform.python_version()}
    for name in (*_PACKAGES, *more):
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def differences(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: the dotted path, the old and the new value; None for one that is absent."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (before, after) in enumerate(zip(old, new, strict=True)):
            yield from differences(before, after, f"{path}[{index}]")
    elif old != new:
        yield path, old, new


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create a folder of results if missing and lock it; raise `StoreBusyError` if another run holds the lock."""
    # Import here, because loading filelock takes longer than many commands that import this module.
    from filelock import FileLock, Timeout

    check_folder(folder)
    place = folder / LOCKS
    if place.is_symlink():
        raise InputError(f"out: {place} is a link; remove it, or {ELSEWHERE}")
    place.mkdir(parents=True, exist_ok=True)
    holder = place / "holder"
    # Writable by all, because other users of the folder lock it too. No fallback to lock files, because the lock file
    # of a killed run would block later runs.
    lock = FileLock(place / "run", timeout=PATIENCE, mode=0o666, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        who = content(holder).decode(errors="replace")
        fault = f"another run is writing to this folder{who and f' ({who})'}"
        raise StoreBusyError(f"out: {folder}: {fault}; wait until it ends, stop that process, or {ELSEWHERE}") from None
    except OSError as error:
        # Continue without a lock if the file system has none: each file of a store is still either complete or absent.
        if error.errno not in _NO_LOCKS:
            raise
    try:
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        who = f"process {os.getpid()} on {socket.gethostname()}, since {since} UTC"
        # Ignore errors, because this file only serves messages. Remove it first, because it may be a link.
        with suppress(OSError):
            holder.unlink(missing_ok=True)
            holder.write_text(who, encoding="utf-8")
        yield
    finally:
        lock.release()
