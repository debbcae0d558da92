"""Files that are whole or absent, whatever kills the program that writes them; and what a store says of its making."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import secrets
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from zwidth import __version__
from zwidth.words.errors import InputError

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
"""What helps against errors of the system; no chunk of a sweep would escape the first six of them."""
_HOPELESS = frozenset(list(REMEDIES)[:6])
# Packages whose release can change the last digit of a result.
_PACKAGES = ("jax", "jaxlib", "numpy")


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
        raise InputError(f"out: {folder} {where}; choose another folder with --out DIR")
    if not os.access(nearest, os.W_OK | os.X_OK):
        where = "is read-only" if nearest == folder.absolute() else f"cannot be made, for {nearest} is read-only"
        raise InputError(f"out: {folder} {where}, at least to you; choose another folder with --out DIR")


def is_plain_name(name: str) -> bool:
    """Whether a name is that of a file in a folder, and leads nowhere else."""
    return Path(name).name == name and name not in ("", "..") and "\0" not in name


def existing(folder: Path) -> Path:
    """The folder itself or the nearest path above it that exists."""
    folder = folder.absolute()
    return next(path for path in (folder, *folder.parents) if path.exists())


@contextmanager
def hidden_beside(path: Path) -> Iterator[Path]:
    """A name beside ``path`` for a file or folder in the making; what is left of it goes when the block ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        yield partial
    finally:
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
        partial.write_bytes(data)
        os.replace(partial, path)


def content(path: Path) -> bytes:
    """What a file holds; nothing where there is none."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return b""


def checksum(path: Path) -> int:
    """The CRC-32 of a file; -1, which is none, where there is no file or nothing in it."""
    total = -1
    with suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError), open(path, "rb") as stream:
        while block := stream.read(1 << 22):
            total = zlib.crc32(block, max(total, 0))
    return total


def digest(value: Any) -> str:
    """The SHA-256 of a JSON value, whatever the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def versions(*more: str) -> dict[str, str]:
    """The releases that results depend on, and those of more packages."""
    found = {"zwidth": __version__, "python": platform.python_version()}
    for name in (*_PACKAGES, *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
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
