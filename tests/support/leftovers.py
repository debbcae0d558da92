"""What is open beside the tests of a file, of which nothing may be left when they end: sockets, processes, threads."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import NamedTuple

# Every program that a test starts inherits it, and so does what that starts, even when its parent has been killed.
os.environ["ZWIDTH_TESTED_BY"] = str(os.getpid())
_MARK = f"\0ZWIDTH_TESTED_BY={os.getpid()}\0".encode()

# What libraries start once and keep as long as the process lives, by the first letters of a thread's name.
# Event loops, each with two sockets that wake it: zarr's, and that of a client of distributed which found no scheduler.
_KEPT_LOOPS = ("zarr_io", "IO loop")
# What zarr's loop and distributed hand their work and their answers to.
_KEPT_THREADS = ("asyncio_", "zarr_pool", "Dask-Offload", "Dask-Callback-Thread")
# By the words of its command line: Python's own, started with the first worker.
_KEPT_PROCESS = "multiprocessing.resource_tracker"


class Open(NamedTuple):
    """How many sockets are open, and which threads and processes."""

    sockets: int
    processes: frozenset[str]
    threads: frozenset[str]

    def beyond(self, before: Open) -> str:
        """What was not open before; nothing where there is no such thing."""
        more = [f"{self.sockets - before.sockets} sockets"] if self.sockets > before.sockets else []
        return "; ".join([*more, *sorted(self.processes - before.processes), *sorted(self.threads - before.threads)])


def what_is_open() -> Open:
    """What is open at this moment, without what libraries keep."""
    threads = threading.enumerate()
    loops = sum(thread.name.startswith(_KEPT_LOOPS) for thread in threads)
    kept = (*_KEPT_LOOPS, *_KEPT_THREADS, *_names_of_dask())
    others = (f"thread {thread.name}, {thread.ident}" for thread in threads if not thread.name.startswith(kept))
    return Open(_count_sockets() - 2 * loops, frozenset(_name_processes()), frozenset(others))


def _names_of_dask() -> tuple[str, ...]:
    """The names of the threads of dask's pool, which are Python's own."""
    pool = getattr(sys.modules.get("dask.threaded"), "default_pool", None)
    return () if pool is None else (f"{pool._thread_name_prefix}_",)


def _count_sockets() -> int:
    count = 0
    for entry in Path("/proc/self/fd").iterdir():
        try:
            count += os.readlink(entry).startswith("socket:")
        except FileNotFoundError:
            # That of the folder itself.
            continue
    return count


def _name_processes() -> list[str]:
    """Those that this one has started, and whatever these have started."""
    found = []
    for number in filter(str.isdigit, os.listdir("/proc")):
        try:
            parent, begun = _read_stat(number)
            # Most of a machine's have begun before, and need no further look.
            if parent != os.getpid() and (begun < _BEGUN or _MARK not in b"\0" + _read(number, "environ")):
                continue
            words = _read(number, "cmdline").replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            # Somebody else's, or it has ended in the meantime.
            continue
        if _KEPT_PROCESS not in words:
            found.append(f"process {number}, {words[:200] or 'not waited for'}")
    return found


def _read(process: str, file: str) -> bytes:
    with open(f"/proc/{process}/{file}", "rb") as opened:
        return opened.read()


def _read_stat(process: str) -> tuple[int, int]:
    """A process's parent, and when it began, in ticks since the machine did."""
    fields = _read(process, "stat").rpartition(b")")[2].split()
    return int(fields[1]), int(fields[19])


_BEGUN = _read_stat("self")[1]
