"""The output folder of a run: never overwritten by accident, never half finished under its own name."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from zwidth.errors import StoreExistsError
from zwidth.sweep.files import check_folder
from zwidth.sweep.lock import FOLDER as LOCKS
from zwidth.sweep.lock import holding_if_used
from zwidth.sweep.store import SUFFIX

RUN_FILE = "run.json"
"""The file that marks a folder as a finished run."""

# What sweeps of the same configuration, in a shard that was faster, leave beside their stores.
_OF_SWEEPS = ("config.yaml", "figures", LOCKS)


def check_free(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that holds something, unless it is a run that may be overwritten, or sweeps alone."""
    if not (folder.exists() or folder.is_symlink()):
        check_folder(folder)
        return
    if not folder.is_dir():
        raise StoreExistsError(f"out: {folder} is a file, a folder is needed; choose another with --out DIR")
    if holds_only_sweeps(folder):
        check_folder(folder)
        return
    if not (folder / RUN_FILE).is_file():
        # Whatever it is, it was not written by a run: not ours to remove.
        raise StoreExistsError(
            f"out: {folder} is not empty and holds no run (no {RUN_FILE}); choose another folder with --out DIR"
        )
    if not overwrite:
        raise StoreExistsError(
            f"out: {folder} already holds a run; choose another folder with --out DIR, remove it, or replace it with "
            "--overwrite"
        )


def holds_only_sweeps(folder: Path) -> bool:
    """Whether nothing but sweeps, finished or not, is in a folder."""
    names = (path.name for path in folder.iterdir())
    return all(name.endswith(SUFFIX) or name in _OF_SWEEPS or name.endswith(".partial") for name in names)


@contextmanager
def staged(folder: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder beside ``folder``, which takes its place when the block ends well and vanishes when it does not.

    Its name ends in ``.partial``: what is left of a killed run is recognized, and never taken for a finished one.
    """
    # What is overwritten goes with all that is in it, sweeps that somebody still computes there included.
    with holding_if_used(folder) if overwrite else nullcontext():
        check_free(folder, overwrite)
        partial = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.partial")
        partial.mkdir(parents=True)
        try:
            yield partial
            _replace(folder, partial, overwrite)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


def _replace(folder: Path, partial: Path, overwrite: bool) -> None:
    """Give the finished folder its name; another run may have taken it in the meantime."""
    check_free(folder, overwrite)
    if folder.exists() and holds_only_sweeps(folder):
        # The file that says that all is there comes last.
        for path in sorted(partial.iterdir(), key=lambda path: path.name == RUN_FILE):
            os.replace(path, folder / path.name)
        partial.rmdir()
        return
    old = partial.with_suffix(".old")
    if folder.exists():
        os.rename(folder, old)
    os.rename(partial, folder)
    shutil.rmtree(old, ignore_errors=True)
