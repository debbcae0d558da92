"""Read access to a store that reports missing and damaged files."""

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
    """Files of a store for Zarr, with an error for each missing or damaged file.

    Zarr itself would replace a missing file by fill values and would not name a damaged one. Unfinished chunks are
    listed once and then stay absent, so that all variables of a chunk are consistent even if a run adds chunks.
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
        """Return the content of a file; raise `StoreError` if a file of values is missing or damaged."""
        assert byte_range is None, "chunks are read as a whole"
        file, is_chunk = self._kept.path / key, "c" in key.split("/")
        # Take the checked description of the group, because one of the two files with it may be damaged.
        data = json.dumps(self._kept.description).encode() if key == "zarr.json" else content(file)
        if file in self._absent or not (data or is_chunk):
            return None
        if is_chunk and (fault := self._kept.find_fault(file, data)):
            raise StoreError(f"{file}: {fault}; 'zwidth run CONFIG --resume' computes it again")
        return (prototype or default_buffer_prototype()).buffer.from_bytes(data)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file as `get_sync` does, in a thread, so that Zarr reads several files at once."""
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)
