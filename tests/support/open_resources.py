"""Sockets, processes and threads that the tests of a file must not leave open."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import NamedTuple

# Inherited by every program that a test starts, and by its children, even after their parent has been killed.
os.environ["ZWIDTH_TESTED_BY"] = str(os.getpid())
_MARK = f"\0ZWIDTH_TESTED_BY={os.getpid()}\0".encode()

# Resources that libraries keep for the life of the process, by the start of a thread's name. Event loops, each with two
# sockets: of zarr, and of a distributed client that found no scheduler.
_KEPT_LOOPS = ("zarr_io", "IO loop")
# Threads to which zarr's loop and distributed delegate work.
_KEPT_THREADS = ("asyncio_", "zarr_pool", "Dask-Offload", "Dask-Callback-Thread")
# Identified by its command line: Python's resource tracker, started with the first worker.
_KEPT_PROCESS = "multiprocessing.resource_tracker"


class Open(NamedTuple):
    """The number of open sockets, and the names of processes and threads."""

    sockets: int
    processes: frozenset[str]
    threads: frozenset[str]

    def list_new(self, before: Open) -> str:
        """Return a description of newly opened resources, or an empty string."""
        new = [f"{self.sockets - before.sockets} sockets"] if self.sockets > before.sockets else []
        return "; ".join([*new, *sorted(self.processes - before.processes), *sorted(self.threads - before.threads)])


def list_open() -> Open:
    """Return the open resources, without those that libraries keep."""
    threads = threading.enumerate()
    loops = sum(thread.name.startswith(_KEPT_LOOPS) for thread in threads)
    excluded = (*_KEPT_LOOPS, *_KEPT_THREADS, *_names_of_dask())
    threads_open = (
        f"thread {thread.name}, {thread.ident}" for thread in threads if not thread.name.startswith(excluded)
    )
    return Open(_count_sockets() - 2 * loops, frozenset(_name_processes()), frozenset(threads_open))


def _names_of_dask() -> tuple[str, ...]:
    """Return the name prefix of the threads of dask's pool."""
    pool = getattr(sys.modules.get("dask.threaded"), "default_pool", None)
    return () if pool is None else (f"{pool._thread_name_prefix}_",)


def _count_sockets() -> int:
    count = 0
    for entry in Path("/proc/self/fd").iterdir():
        try:
            count += os.readlink(entry).startswith("socket:")
        except FileNotFoundError:
            # The descriptor of the directory itself.
            continue
    return count


def _name_processes() -> list[str]:
    """Return the processes started by this one or by its descendants."""
    names = []
    for number in filter(str.isdigit, os.listdir("/proc")):
        try:
            parent, start_time = _read_stat(number)
            # Most processes started earlier and need no further check.
            if parent != os.getpid() and (start_time < _START_TIME or _MARK not in b"\0" + _read(number, "environ")):
                continue
            command_line = _read(number, "cmdline").replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            # The process belongs to another user or has ended.
            continue
        if _KEPT_PROCESS not in command_line:
            names.append(f"process {number}, {command_line[:200] or 'not waited for'}")
    return names


def _read(process: str, file: str) -> bytes:
    with open(f"/proc/{process}/{file}", "rb") as opened:
        return opened.read()


def _read_stat(process: str) -> tuple[int, int]:
    """Return the parent of a process, and its start time in clock ticks since boot."""
    fields = _read(process, "stat").rpartition(b")")[2].split()
    return int(fields[1]), int(fields[19])


_START_TIME = _read_stat("self")[1]
