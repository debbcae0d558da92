"""A store as those see it who only read: what is not what was written is refused, and names itself."""

from __future__ import annotations

import asyncio
import json
import zlib
from typing import TYPE_CHECKING

import numpy as np
from zarr.core.buffer.core import default_buffer_prototype
from zarr.storage import LocalStore

from zwidth.sweep.files import content
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store
from zwidth.words.errors import StoreError

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype


class CheckedStore(LocalStore):
    """The files of a store, each compared with its checksum whenever it is read.

    Which chunks are done is looked up once: the others stay absent, so that all variables of a chunk are of one state
    even where a run computes meanwhile.
    """

    def __init__(self, store: Store) -> None:
        """Raise a `StoreError` where a coordinate or the description of a variable is damaged."""
        super().__init__(store.path, read_only=True)
        self._kept = store
        self._missing = frozenset(store.missing())
        # All of them now: Zarr would not miss a variable whose description is missing.
        for name in store.described:
            self._read(name)

    @property
    def complete(self) -> bool:
        return not self._missing

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """A whole file; a `StoreError` where it is not what was written."""
        assert byte_range is None, "chunks are read as a whole"
        data = self._read(key)
        return None if data is None else (prototype or default_buffer_prototype()).buffer.from_bytes(data)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """The same, several at one time."""
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)

    def _read(self, name: str) -> bytes | None:
        """What was written under a name; None where nothing was."""
        if name == "zarr.json":
            # Where it is damaged, its copy is not.
            return json.dumps({"zarr_format": 3, "node_type": "group", "attributes": self._kept.attributes}).encode()
        expected, task = self._kept.described.get(name), self._task_of(name)
        file = self._kept.path / name
        if task in self._missing:
            return None
        if task is not None:
            expected = self._kept.checksums(task).get(name.split("/")[0])
            file = self._kept.flag(task) if expected is None else file
        elif expected is None:
            return None
        data = content(file)
        if not data or zlib.crc32(data) != expected:
            state = "damaged, its checksum is wrong" if file.exists() else "missing"
            raise StoreError(f"{file}: {state}; 'zwidth run CONFIG --resume' makes it again")
        return data

    def _task_of(self, name: str) -> Task | None:
        variable, *place = name.split("/")
        family = next((one for one in self._kept.plan.families if variable in one.variables), None)
        if family is None or place[:1] != ["c"]:
            return None
        # Without dimensions there is one chunk, of one point.
        at = tuple(map(int, place[1:]))
        return Task(family, int(np.ravel_multi_index(at, family.counts)) if at else 0)
