"""Atomic writing of files and folders, and remedies for errors of the operating system.

A file is written under a temporary name and renamed when it is complete. An interruption therefore never leaves an
incomplete file under the final name.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

REMEDIES = {
    errno.ENOSPC: "free space on the disk",
    errno.EDQUOT: "free space within your quota",
    errno.EFBIG: "raise the limit on file sizes (ulimit -f)",
    errno.EROFS: "choose a folder on a writable file system",
    errno.EACCES: "choose a folder with write permission",
    errno.EPERM: "choose a folder with write permission",
    errno.ENOTDIR: "choose a path without files among its folders",
    errno.ENOENT: "choose a folder that can be created",
    errno.EEXIST: "choose another name",
}
"""Remedies for messages, by error number of the operating system.

The first six errors do not depend on the name of the file: they would also occur for all further files in the folder.
"""


@contextmanager
def temporary_sibling(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, for a file or folder that is renamed to ``path`` when complete.

    At the end of the context, a file or folder that still has the temporary name is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        yield partial
    except OSError as error:
        # Report the final name instead of the temporary one, also if the error has no name, as for a full disk.
        if error.filename is None or str(error.filename) == str(partial):
            error.filename = str(path)
        raise
    finally:
        # Ignore errors of the removal, because a folder without write permission has raised an error already.
        with suppress(OSError):
            remove_quietly(partial)


def remove_quietly(path: Path) -> None:
    """Remove a file or a folder; ignore files of the folder that cannot be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write bytes to a file under a temporary name, and rename the file when it is complete."""
    with temporary_sibling(path) as partial:
        if path.exists() and not path.is_file():
            # Write directly to a pipe or a device such as /dev/stdout, because a file must not replace it.
            path.write_bytes(data)
        else:
            partial.write_bytes(data)
            os.replace(partial, path)
