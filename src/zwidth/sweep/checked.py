"""Reading a store: what is missing or damaged is refused and named."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

from zarr.core.buffer.core import default_buffer_prototype
from zarr.storage import LocalStore

from zwidth.sweep.files import content
from zwidth.sweep.store import Store
from zwidth.words.errors import StoreError

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype


class CheckedStore(LocalStore):
    """The files of a store for Zarr, which would read a missing file as fill values and not name a damaged one.

    Unfinished chunks are listed once and stay absent, so that all variables of a chunk have the same state even if a
    run computes meanwhile.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store.path, read_only=True)
        self._kept = store
        self._absent = {file for task in store.missing() for file in store.files(task)}

    @property
    def complete(self) -> bool:
        return not self._absent

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file; raise a `StoreError` if values are missing or damaged."""
        assert byte_range is None, "chunks are read as a whole"
        file, is_chunk = self._kept.path / key, "c" in key.split("/")
        # If the group's description is damaged, its copy is not.
        data = json.dumps(self._kept.description).encode() if key == "zarr.json" else content(file)
        if file in self._absent or not (data or is_chunk):
            return None
        if is_chunk and (fault := self._kept.find_fault(file, data)):
            raise StoreError(f"{file}: {fault}; 'zwidth run CONFIG --resume' makes it again")
        return (prototype or default_buffer_prototype()).buffer.from_bytes(data)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the same, several at one time."""
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)
