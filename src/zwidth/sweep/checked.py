"""Read the store of a sweep, and raise an error for each missing or damaged file.

A *store* is the Zarr group with the results of one sweep (`sweep.store`); `zwidth.open_dataset` reads it through
`CheckedStore`. A *chunk* is one block of the grid of a sweep (`sweep.plan`). Each variable of the store has one file
of values per chunk, which ends with a checksum. A chunk is *finished* once all its files are written. The *description*
of the store is a JSON document; the store contains two copies of it.
"""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

from zarr.core.buffer.core import default_buffer_prototype
from zarr.storage import LocalStore

from zwidth.core.errors import StoreError
from zwidth.sweep.files import read_or_empty
from zwidth.sweep.store import Store

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype


class CheckedStore(LocalStore):
    """Storage backend for Zarr that raises an error for each missing or damaged file of a store.

    Zarr itself would replace a missing file by fill values, and its error for a damaged file would not name that file.
    A chunk that is unfinished when the store is opened stays absent until the store is opened again. So all variables
    of a chunk remain consistent, even if a run completes that chunk in the meantime.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store.path, read_only=True)
        self._checked_store = store
        self._absent = {file for task in store.missing() for file in store.files(task)}

    @property
    def complete(self) -> bool:
        """True if all chunks were finished when the store was opened."""
        return not self._absent

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file; None if the file is absent or belongs to an unfinished chunk.

        Raises:
            StoreError: A file of values is damaged, or a file of a finished chunk is missing.
        """
        assert byte_range is None, "chunks are read as a whole"
        file, is_chunk = self._checked_store.path / key, "c" in key.split("/")
        # For "zarr.json", return the description whose checksum was verified, because the file itself may be damaged.
        data = json.dumps(self._checked_store.description).encode() if key == "zarr.json" else read_or_empty(file)
        if file in self._absent or not (data or is_chunk):
            return None
        if is_chunk and (fault := self._checked_store.find_fault(file, data)):
            raise StoreError(f"{file}: {fault}; 'zwidth run CONFIG --resume' computes it again")
        return (prototype or default_buffer_prototype()).buffer.from_bytes(data)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file by `get_sync`, called in a thread, so that Zarr reads several files at once."""
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)
