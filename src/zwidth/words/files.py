"""Files that are whole or absent whatever stops their writing, and what helps where the system refuses one."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

REMEDIES = {
    errno.ENOSPC: "make room on the disk",
    errno.EDQUOT: "make room within your quota",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
    errno.EROFS: "choose a folder that can be written",
    errno.EACCES: "choose a folder that you may write",
    errno.EPERM: "choose a folder that you may write",
    errno.ENOTDIR: "choose a folder whose path holds no file",
    errno.ENOENT: "choose a folder that can be made",
    errno.EEXIST: "choose another name",
}
"""What helps against errors of the system, the first six of them whatever is written."""


@contextmanager
def hidden_beside(path: Path) -> Iterator[Path]:
    """A name beside ``path`` for a file or folder in the making; what is left of it goes when the block ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        yield partial
    except OSError as error:
        # What the system says of it, or of a full disk without any name, is meant of the path.
        if error.filename is None or str(error.filename) == str(partial):
            error.filename = str(path)
        raise
    finally:
        # A folder that cannot be written says so once.
        with suppress(OSError):
            remove_quietly(partial)


def remove_quietly(path: Path) -> None:
    """Remove a file or a folder, as far as the system lets it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under another name and rename it when all of it is on its way to the disk."""
    with hidden_beside(path) as partial:
        if path.exists() and not path.is_file():
            # A pipe or a device takes what is written; a file must not come in its place.
            path.write_bytes(data)
        else:
            partial.write_bytes(data)
            os.replace(partial, path)
