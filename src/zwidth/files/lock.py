"""Who computes in a folder: one run at a time, or the shards of one run together.

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
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zwidth.errors import StoreBusyError
from zwidth.files.whole import check_folder

FOLDER = ".locks"
"""Name of the folder of locks in a folder of results."""

# As long as a killed program may take to vanish, and a shard to write down who it is.
_PATIENCE = 1.0
_PAUSE = 0.02
_UNKNOWN_TO_FILE_SYSTEM = frozenset({errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF})


@dataclass(frozen=True)
class Holder:
    """Who holds a lock: process, machine, since when (UTC), and which shard where it is one."""

    process: int
    host: str
    since: str
    shard: str = ""

    def __str__(self) -> str:
        shard = f"shard {self.shard}, " if self.shard else ""
        return f"{shard}process {self.process} on {self.host}, since {self.since} UTC"


@contextmanager
def holding(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Hold a folder of results while the block runs; the folder is made where it is missing.

    Args:
        folder: the folder.
        shard: (i, n), which shares the folder with the other shards of n.

    Raises:
        StoreBusyError: another run holds it; the message has the folder, the holder and the remedy.
        InputError: the folder cannot be made or written.
    """
    check_folder(folder)
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    common = _File(folder / FOLDER / "run")
    own = common if shard is None else _File(folder / FOLDER / f"shard-{shard[0]}")
    try:
        if shard is not None:
            _join(common, folder, shard)
        if not own.lock(fcntl.LOCK_EX):
            raise StoreBusyError(_told(folder, shard))
        own.write(asdict(_this_process(shard)))
        yield
    finally:
        own.close()
        common.close()


@contextmanager
def held_briefly(folder: Path, name: str) -> Iterator[None]:
    """Hold a lock of that name in a folder for as long as it takes to write a small file."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    file = _File(folder / FOLDER / name)
    try:
        # Where another holds it for so long, it hangs: the file is written whole in any case.
        file.lock(fcntl.LOCK_EX, patience=10.0)
        yield
    finally:
        file.close()


def _join(common: _File, folder: Path, shard: tuple[int, int]) -> None:
    """Share the folder with the other shards; the first to come says how many there are to be."""
    if common.lock(fcntl.LOCK_EX, patience=0.0):
        common.write({"shards": shard[1]})
    # From alone to shared the kernel may let another in between, so what is written counts only from here on.
    if not common.lock(fcntl.LOCK_SH):
        raise StoreBusyError(_told(folder, None))
    count = common.read().get("shards", shard[1])
    if count != shard[1]:
        raise StoreBusyError(
            f"out: {folder}: {count} shards compute in this folder, not {shard[1]}{_of(_holders(folder))}; give "
            f"--shard i/{count}, wait until they end, or choose another folder with --out DIR"
        )


def _told(folder: Path, shard: tuple[int, int] | None) -> str:
    """Why a folder cannot be had, and what to do."""
    if shard is not None:
        found = _File.holder_of(folder / FOLDER / f"shard-{shard[0]}")
        holders = [found] if found else []
        what = f"shard {shard[0]} computes in this folder already"
    else:
        holders = _holders(folder)
        what = "another run computes in this folder"
    remedy = "wait until it ends, or stop it"
    if len(holders) == 1:
        remedy += f" with 'kill {holders[0].process}'"
        if holders[0].host != socket.gethostname():
            remedy += f" on {holders[0].host}"
    return f"out: {folder}: {what}{_of(holders)}; {remedy}, or choose another folder with --out DIR"


def _of(holders: list[Holder]) -> str:
    more = f", and {len(holders) - 1} more" if len(holders) > 1 else ""
    return f" ({holders[0]}{more})" if holders else ""


def _holders(folder: Path) -> list[Holder]:
    """Who holds a folder: the run, or each shard that runs."""
    files = [folder / FOLDER / "run", *sorted((folder / FOLDER).glob("shard-*"))]
    return [holder for file in files if (holder := _File.holder_of(file))]


def _this_process(shard: tuple[int, int] | None) -> Holder:
    since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
    return Holder(os.getpid(), socket.gethostname(), since, f"{shard[0]}/{shard[1]}" if shard else "")


class _File:
    """A file that is locked, and says who did it.

    Args:
        path: the file; made where it is missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = self._open()

    def _open(self) -> int:
        try:
            return os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
        except PermissionError:
            # Another user's: to lock it, local file systems want no more than this.
            return os.open(self.path, os.O_RDONLY)

    def lock(self, how: int, patience: float = _PATIENCE) -> bool:
        """Take or change the lock; False where another holds it all the time."""
        deadline = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(self.file, how | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in _UNKNOWN_TO_FILE_SYSTEM:
                    return True
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    raise
            else:
                if self._is_in_place():
                    return True
                os.close(self.file)
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.file = self._open()
                continue
            if time.monotonic() > deadline:
                return False
            time.sleep(_PAUSE)

    def _is_in_place(self) -> bool:
        """Whether the file has not been replaced, with its folder, by a run that overwrites."""
        try:
            return os.path.samestat(os.fstat(self.file), os.stat(self.path))
        except FileNotFoundError:
            return False

    def write(self, content: dict[str, Any]) -> None:
        """Say something; where the file is another user's, nothing."""
        try:
            os.ftruncate(self.file, 0)
            os.pwrite(self.file, json.dumps(content).encode(), 0)
        except OSError:
            # It is for messages alone: neither a full disk nor a foreign file may end a run here.
            return

    def read(self) -> dict[str, Any]:
        """What the file says; nothing where that is not to be read."""
        try:
            content = json.loads(os.pread(self.file, 4096, 0))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def close(self) -> None:
        """Let go."""
        if self.file >= 0:
            os.close(self.file)
            self.file = -1

    @classmethod
    def holder_of(cls, path: Path) -> Holder | None:
        """Who holds a file, if anyone does and has said who it is."""
        try:
            file = cls(path)
        except OSError:
            return None
        try:
            return None if file.lock(fcntl.LOCK_SH, patience=0.0) else Holder(**file.read())
        except TypeError:
            return None
        finally:
            file.close()
