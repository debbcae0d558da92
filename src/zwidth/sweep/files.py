"""Check, hash and lock files and folders of results, and list the versions of packages.

A lock ensures that only one run at a time writes to a folder. It is an operating system lock on ``DIR/.locks/run``. The
operating system releases it when its process ends, even if the process is killed, so that the remaining file does not
block later runs. On NFS the lock also excludes runs on other machines.
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
from zwidth.core.errors import InputError, StoreBusyError
from zwidth.io.files import REMEDIES

_FATAL_ERRORS = frozenset(list(REMEDIES)[:6])  # system error codes that would also affect every further write
_PACKAGES = ("jax", "jaxlib", "numpy")  # packages whose version can change the last digit of a result
LOCKS = ".locks"  # name of the folder of the locks, within a folder of results
ELSEWHERE = "choose another folder with --out DIR"  # remedy in error messages that always works
LOCK_TIMEOUT = 1.0  # longest time to wait for the lock, in s; a killed run needs some time to end
# Error codes by which file systems report that they do not support locks.
_NO_LOCKS = frozenset({errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK})


def is_fatal(error: BaseException | None) -> bool:
    """Return whether an exception was caused by a system error that affects every later write, such as a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error.errno in _FATAL_ERRORS
        error = error.__cause__ or error.__context__
    return False


def check_folder(folder: Path) -> None:
    """Raise `InputError` if a folder for results cannot be created or written; the check itself writes nothing."""
    nearest = find_existing(folder)
    if not nearest.is_dir():
        where = "is a file" if nearest == folder.absolute() else f"cannot be created because {nearest} is a file"
        raise InputError(f"out: {folder} {where}; {ELSEWHERE}")
    if not os.access(nearest, os.W_OK | os.X_OK):
        where = "is" if nearest == folder.absolute() else f"cannot be created because {nearest} is"
        raise InputError(f"out: {folder} {where} not writable for you; {ELSEWHERE}")


def is_plain_name(name: str) -> bool:
    """Return whether a string is the name of a file in a folder, without any path to another folder."""
    return Path(name).name == name and name not in ("", "..") and "\0" not in name


def find_existing(folder: Path) -> Path:
    """Return the folder itself if it exists, otherwise its nearest existing parent."""
    folder = folder.absolute()
    return next(path for path in (folder, *folder.parents) if path.exists())


def read_or_empty(path: Path) -> bytes:
    """Return the content of a file, or empty bytes if the file does not exist."""
    with suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return path.read_bytes()
    return b""


def hash_json(value: Any) -> str:
    """Return the SHA-256 of a JSON value, independent of the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def list_versions(*more: str) -> dict[str, str]:
    """Return the versions of Python, zwidth, the packages that results depend on, and ``more`` packages, by name."""
    versions = {"zwidth": __version__, "python": platform.python_version()}
    for name in (*_PACKAGES, *more):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def list_differences(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield each difference between two JSON values as dotted path, old value and new value (None if absent)."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from list_differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (before, after) in enumerate(zip(old, new, strict=True)):
            yield from list_differences(before, after, f"{path}[{index}]")
    elif old != new:
        yield path, old, new


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create a folder of results if missing and lock it; raise `StoreBusyError` if another run holds the lock."""
    # Import filelock only here, because loading it takes longer than many commands that import this module.
    from filelock import FileLock, Timeout

    check_folder(folder)
    lock_dir = folder / LOCKS
    if lock_dir.is_symlink():
        raise InputError(f"out: {lock_dir} is a link; remove it, or {ELSEWHERE}")
    lock_dir.mkdir(parents=True, exist_ok=True)
    holder = lock_dir / "holder"
    # Make the lock file writable by all users, because other users of the folder lock it, too. Do not fall back to
    # plain lock files, whose existence is the lock, because the file of a killed run would block later runs.
    lock = FileLock(lock_dir / "run", timeout=LOCK_TIMEOUT, mode=0o666, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        who = read_or_empty(holder).decode(errors="replace")
        fault = f"another run is writing to this folder{who and f' ({who})'}"
        raise StoreBusyError(f"out: {folder}: {fault}; wait until it ends, stop it, or {ELSEWHERE}") from None
    except OSError as error:
        # Continue without a lock if the file system does not support locks. Two runs may then compute the same chunk,
        # but each file of a store is still either complete or absent.
        if error.errno not in _NO_LOCKS:
            raise
    try:
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        who = f"process {os.getpid()} on {socket.gethostname()}, since {since} UTC"
        # Ignore errors, because the file that names the holder of the lock is used only in messages. Remove an existing
        # file first, because it may be a link.
        with suppress(OSError):
            holder.unlink(missing_ok=True)
            holder.write_text(who, encoding="utf-8")
        yield
    finally:
        lock.release()
