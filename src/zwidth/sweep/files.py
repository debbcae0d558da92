"""Files and folders of results: whole or absent whatever kills a program, knowing their making, and held by one run.

The locks are the system's own (flock), on files in ``DIR/.locks``: the kernel takes them back when their holder ends,
however it ends, so that a killed run never stands in the way of the next. A library for file locks would keep shared
locks in a database, or fall back on files that stay behind. NFS carries these locks to the other machines (from Linux
2.6.12 on); on a file system that knows none, runs go on without one, as the files of a store stay whole even then.

``run`` is held alone by a run without shards, and shared by all shards; each shard holds ``shard-i`` beside it. The
files stay when a run ends: to remove one could give two runs a lock each, on the old file and on a new one.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import platform
import socket
import stat
import time
import zlib
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

# As long as a killed program may take to vanish, and a shard to write down who it is.
_PATIENCE = 1.0
_PAUSE = 0.02
_UNKNOWN_TO_FILE_SYSTEM = frozenset({errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF})


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


def checksum(path: Path) -> int:
    """The CRC-32 of a file; -1, which is none, where there is no file or nothing in it."""
    data = content(path)
    return zlib.crc32(data) if data else -1


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
def holding(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Hold a folder of results, made where it is missing, within the block; a shard (i, n) shares it with others."""
    # A `StoreBusyError` says which other run holds it.
    check_folder(folder)
    with _opened(folder / LOCKS / "run") as run:
        if shard is None:
            if not _lock(run, fcntl.LOCK_EX):
                raise _busy(folder, "another run computes in this folder")
            _write_holder(run, _this_process())
            yield
            return
        number, count = shard
        # The first shard to come says how many there are to be.
        if _lock(run, fcntl.LOCK_EX, patience=0.0):
            _write_holder(run, f"{count} shards")
        # From alone to shared the kernel may let another in between: what is written counts only from here on.
        if not _lock(run, fcntl.LOCK_SH):
            raise _busy(folder, "another run computes in this folder")
        said = _read_holder(run)
        if said.endswith(" shards") and said != f"{count} shards":
            raise _busy(folder, f"{said} compute in this folder, not {count}")
        with _opened(folder / LOCKS / f"shard-{number}") as own:
            if not _lock(own, fcntl.LOCK_EX):
                raise _busy(folder, f"shard {number} computes in this folder already")
            _write_holder(own, f"shard {number}/{count}, {_this_process()}")
            yield


@contextmanager
def held_briefly(folder: Path, name: str) -> Iterator[None]:
    """Hold a lock of that name in a folder for as long as it takes to write a small file."""
    with _opened(folder / LOCKS / name) as file:
        # Where another holds it for so long, it hangs: the file is written whole in any case.
        _lock(file, fcntl.LOCK_EX, patience=10.0)
        yield


def _busy(folder: Path, what: str) -> StoreBusyError:
    """Why a folder cannot be had, who has it, and what to do."""
    holders = []
    for path in sorted((folder / LOCKS).glob("*")):
        with suppress(OSError, InputError), _opened(path) as file:
            held = not _lock(file, fcntl.LOCK_SH, patience=0.0)
            holders += [_read_holder(file)] if held and "process" in _read_holder(file) else []
    more = f", and {len(holders) - 1} more" if len(holders) > 1 else ""
    who = f" ({holders[0]}{more})" if holders else ""
    return StoreBusyError(f"out: {folder}: {what}{who}; wait until it ends, stop that process, or {ELSEWHERE}")


def _this_process() -> str:
    since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
    return f"process {os.getpid()} on {socket.gethostname()}, since {since} UTC"


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """A file to lock, made where it is missing; closed, and so freed, when the block ends."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except PermissionError:
        # Another user's: to lock it, local file systems want no more than this.
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.EEXIST, errno.ENOTDIR):
            raise
        raise _foreign(path) from error
    try:
        found = os.fstat(file)
        if path.parent.is_symlink() or not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
            raise _foreign(path)
        yield file
    finally:
        os.close(file)


def _foreign(path: Path) -> InputError:
    place = path.parent if path.parent.is_symlink() else path
    return InputError(f"out: {place} is a link or no file of a run's own; remove it, or choose another folder")


def _lock(file: int, how: int, patience: float | None = None) -> bool:
    """Take or change the lock; False where another holds it all the time."""
    deadline = time.monotonic() + (_PATIENCE if patience is None else patience)
    while True:
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
            return True
        except OSError as error:
            if error.errno in _UNKNOWN_TO_FILE_SYSTEM:
                return True
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
        if time.monotonic() > deadline:
            return False
        time.sleep(_PAUSE)


def _write_holder(file: int, text: str) -> None:
    # It is for messages alone: neither a full disk nor a file of another user's may end a run here.
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, text.encode(), 0)


def _read_holder(file: int) -> str:
    return os.pread(file, 200, 0).decode(errors="replace")
