"""Files and folders of results: checks, checksums, versions, and the lock of the one run that writes a folder.

The lock is the system's own, on ``DIR/.locks/run``: it ends with its process, even a killed one, so that the file that
stays behind blocks no later run. NFS extends it to other machines.
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

PATIENCE = 1.0  # s; a killed program needs some time to end
# Reported by file systems without locks.
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
    """Lock a folder of results, created if missing, for this run; raise `StoreBusyError` if another run holds it."""
    # Loading it takes longer than many commands that import this module.
    from filelock import FileLock, Timeout

    check_folder(folder)
    place = folder / LOCKS
    if place.is_symlink():
        raise InputError(f"out: {place} is a link; remove it, or {ELSEWHERE}")
    place.mkdir(parents=True, exist_ok=True)
    holder = place / "holder"
    # Writable by all, because other users of the folder lock it too. No fallback to files in place of flock: they
    # would block later runs after a kill.
    lock = FileLock(place / "run", timeout=PATIENCE, mode=0o666, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        who = content(holder).decode(errors="replace")
        what = f"another run computes in this folder{who and f' ({who})'}"
        raise StoreBusyError(f"out: {folder}: {what}; wait until it ends, stop that process, or {ELSEWHERE}") from None
    except OSError as error:
        # Without locks nothing keeps two runs apart, but every file of a store is still complete or absent.
        if error.errno not in _NO_LOCKS:
            raise
    try:
        since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        who = f"process {os.getpid()} on {socket.gethostname()}, since {since} UTC"
        # For messages only: a full disk must not end a run here. Removed first, because it may be a link.
        with suppress(OSError):
            holder.unlink(missing_ok=True)
            holder.write_text(who, encoding="utf-8")
        yield
    finally:
        lock.release()
