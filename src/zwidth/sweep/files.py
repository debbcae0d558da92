"""Files that are whole or absent, whatever kills the program that writes them."""

from __future__ import annotations

import os
import secrets
import zlib
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under another name and rename it when all of it is on its way to the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with open(partial, "wb") as stream:
            stream.write(data)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def checksum(path: Path) -> int:
    """The CRC-32 of a file; 0 where there is none."""
    total = 0
    try:
        with open(path, "rb") as stream:
            while block := stream.read(1 << 22):
                total = zlib.crc32(block, total)
    except FileNotFoundError:
        return 0
    return total
