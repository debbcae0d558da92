"""Create, write, check and repair the store of one sweep: a Zarr group ``<study>.zarr`` that xarray can open.

The *variables* of a store are its outputs and the status of each *family* of outputs. A *task* is one chunk of the plan
(`sweep.plan`); it is one chunk of every variable of its family, each in a separate *file of values*. The file of the
status is written last, and its existence marks the chunk as done. The *description* of a store, a JSON document, is the
metadata of the group and of all its arrays.

Every file appears under its name only when it is complete, even if the program is killed. This is not guaranteed after
a power failure, because writes are not synchronized with the disk. Therefore every file of values ends with a checksum
(Zarr's codec crc32c), and the description contains one. Only this module, which writes, and `dataset` with `checked`,
which read, import zarr or xarray.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.config.sweep import SweepStudy
from zwidth.core.errors import InputError, StoreError, format_install_command
from zwidth.core.status import Status
from zwidth.io.files import remove_quietly, temporary_sibling, write_atomically
from zwidth.sweep.files import hash_json, read_or_empty
from zwidth.sweep.plan import Plan, Task, restore_plan
from zwidth.units.outputs import NOT_COMPUTED, OUTPUTS, STATUS_OF, status_flags

SUFFIX = ".zarr"  # suffix of the name of a store, which is a folder
FORMAT = 2  # format version of new stores
OLD_FORMAT = 1  # format version of earlier releases, whose checksums are in separate arrays and are no longer read
CHECKSUM = "attributes_sha256"  # name of the attribute that contains the checksum of the description
# Files of the description: the one that Zarr reads, and a copy, because without a description the store is lost.
_DESCRIPTIONS = ("zarr.json", "zwidth.json")


@contextmanager
def silence_zarr() -> Iterator[None]:
    """Suppress zarr's warnings about codecs and data types that do not belong to the Zarr 3 core specification."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Zarr", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*Zarr", category=FutureWarning)
        yield


def check_installed() -> None:
    """Raise an `InputError` with the installation command if a library needed for stores is missing."""
    for name in ("dask", "h5netcdf", "h5py", "xarray", "zarr"):
        if find_spec(name) is None:
            raise InputError(
                f"sweep: needs {name}, which is not installed; install it: {format_install_command('store')}"
            )


class Store:
    """An existing store, in a folder ``<study>.zarr``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def description(self) -> dict[str, Any]:
        """The description, read from the first file with a valid checksum; `StoreError` if neither file has one."""
        faults = []
        for name in _DESCRIPTIONS:
            try:
                description = json.loads((self.path / name).read_text(encoding="utf-8"))
                if _compute_checksum(description) == description["attributes"][CHECKSUM]:
                    break
                faults.append(f"{name} is damaged, its checksum is wrong")
            except FileNotFoundError:
                faults.append(f"it has no {name}")
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                faults.append(f"{name} cannot be read ({error})")
        else:
            if not any((self.path / name).exists() for name in _DESCRIPTIONS):
                raise StoreError(f"{self.path}: no store of a sweep ({faults[0]}); check the path")
            raise StoreError(f"{self.path}: {'; '.join(faults)}; start again in a new folder")
        if (version := description["attributes"].get("zwidth_format")) not in (OLD_FORMAT, FORMAT):
            raise StoreError(f"{self.path}: format {version}, this release reads format {FORMAT}; use another release")
        # Drop the key delay_model of earlier releases, which always had the value "held" (exact fractional delay).
        description["attributes"]["study"].pop("delay_model", None)
        return description

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the Zarr group, as contained in the description."""
        return self.description["attributes"]

    @property
    def has_checksums(self) -> bool:
        """True if the files of the store end with checksums; False for the old format."""
        return self.attributes["zwidth_format"] != OLD_FORMAT

    @cached_property
    def study(self) -> SweepStudy:
        """The sweep whose results the store contains."""
        return SweepStudy.model_validate(self.attributes["study"])

    @cached_property
    def plan(self) -> Plan:
        """The plan of the sweep, with the chunks that the store records."""
        return restore_plan(self.study, self.attributes["plan"])

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        """The Zarr arrays of all variables, by name."""
        import zarr

        with silence_zarr():
            group = zarr.open_group(self.path, mode="r+", zarr_format=3, use_consolidated=True)
            arrays: dict[str, Any] = {name: group[name] for family in self.plan.families for name in family.variables}
        # Let Zarr write chunks that contain only the fill value as well, because detecting them takes longer than
        # writing them.
        return {name: array.with_config({"write_empty_chunks": True}) for name, array in arrays.items()}

    def label(self, task: Task) -> str:
        """Return a name of a chunk that includes the study, for messages."""
        return f"{self.study.name}/{task}"

    def files(self, task: Task) -> list[Path]:
        """Return the files of values of a chunk in the order of its variables; the status is the last one."""
        key = "/".join(("c", *map(str, task.position)))
        return [self.path / name / key for name in task.plan.variables]

    def status_file(self, task: Task) -> Path:
        """Return the status file of a chunk, whose existence marks the chunk as done."""
        return self.files(task)[-1]

    def is_done(self, task: Task) -> bool:
        """Return whether a chunk is marked as done."""
        return self.status_file(task).exists()

    def is_visible(self, task: Task) -> bool:
        """Return whether a chunk is marked as done, even if another machine wrote it a moment ago."""
        if not self.is_done(task):
            # List the folders to refresh the cache of a network file system, which may still report a new file as
            # missing.
            for folder in reversed(self.status_file(task).parents[: len(task.position) + 1]):
                with suppress(OSError):
                    os.listdir(folder)
        return self.is_done(task)

    def missing(self) -> list[Task]:
        """Return the chunks that are not marked as done, in the order of computation."""
        return [task for task in self.plan.tasks() if not self.is_done(task)]

    def write(self, task: Task, values: Mapping[str, np.ndarray]) -> None:
        """Write the values of all variables of a chunk, those of the status last."""
        shape = tuple(part.stop - part.start for part in task.slices)
        with silence_zarr():
            for name, file in zip(task.plan.variables, self.files(task), strict=True):
                # Remove an old file first: Zarr would read it before overwriting a chunk that extends beyond the grid,
                # and fail if the file is damaged.
                remove_quietly(file)
                self._arrays[name][task.slices or ...] = np.ascontiguousarray(values[name]).reshape(shape)

    def count_statuses(self) -> dict[str, np.ndarray]:
        """Count the points of each family by their status; damaged and missing chunks are not counted."""
        counts = {family.family: np.zeros(NOT_COMPUTED, int) for family in self.plan.families}
        for task in self.plan.tasks():
            name = STATUS_OF[task.family]
            if self.is_done(task) and not self.find_fault(self.status_file(task)):
                with silence_zarr():
                    status = np.asarray(self._arrays[name][task.slices or ...])
                # Apply bincount only to nonzero statuses, because nearly all statuses are 0, which are counted faster
                # by subtraction.
                failed = status[status.view(bool)]
                counts[task.family][Status.OK] += status.size - failed.size
                counts[task.family] += np.bincount(failed, minlength=NOT_COMPUTED)
        return counts

    def unmark(self, task: Task) -> None:
        """Mark a chunk as not done, by removing its status file."""
        remove_quietly(self.status_file(task))

    def find_task_faults(self, task: Task) -> str:
        """Return the damaged and missing variables of a chunk that is marked as done, as text; "" if there are none."""
        faults = zip(task.plan.variables, map(self.find_fault, self.files(task)), strict=True)
        return ", ".join(f"{name} is {fault}" for name, fault in faults if fault)

    def find_fault(self, file: Path, data: bytes | None = None) -> str:
        """Check a file of values against its checksum.

        Args:
            file: The file.
            data: Content of the file, if it has been read before.

        Returns:
            "missing" or "damaged"; "" if the checksum is correct.
        """
        import google_crc32c

        data = read_or_empty(file) if data is None else data
        if not data:
            return "damaged" if file.exists() else "missing"
        right = google_crc32c.value(data[:-4]).to_bytes(4, "little") == data[-4:]
        return "" if right or not self.has_checksums else "damaged"

    def damaged_files(self) -> list[str]:
        """Return the names of damaged files of coordinates, and of both files of the description if these differ."""
        n_dims = ((name, len(dims)) for name, (dims, *_) in self.plan.grid.coordinates().items())
        names = ["/".join((name, "c", *["0"] * count)) for name, count in n_dims]
        damaged = [name for name in names if self.find_fault(self.path / name)]
        first, second = (read_or_empty(self.path / name) for name in _DESCRIPTIONS)
        return damaged if first == second else [*_DESCRIPTIONS, *damaged]

    def restore(self, names: list[str]) -> None:
        """Write damaged files of coordinates and of the description again, from the attributes of the store."""
        attributes = self.attributes
        with _temporary_store(self.path, attributes) as fresh:
            for name in names:
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                if (self.path / name).is_dir():
                    remove_quietly(self.path / name)
                os.replace(fresh / name, self.path / name)


def create_store(path: Path, attributes: dict[str, Any]) -> Store:
    """Create a store without values; its folder receives its final name only when it is complete."""
    with _temporary_store(path, attributes) as fresh:
        os.rename(fresh, path)
    return Store(path)


@contextmanager
def _temporary_store(path: Path, attributes: dict[str, Any]) -> Iterator[Path]:
    """Create a store without values under a temporary name, next to ``path``; remove it when the block ends."""
    import zarr

    plan = restore_plan(SweepStudy.model_validate(attributes["study"]), attributes["plan"])
    grid = plan.grid
    with temporary_sibling(path) as fresh:
        with silence_zarr():
            _write_arrays(fresh, plan)
            zarr.consolidate_metadata(fresh, zarr_format=3)
        # List the coordinates that are not dimensions in an attribute, as the CF conventions require.
        auxiliary = " ".join(
            name for name in grid.coordinates() if name not in {dim.replace(".", "_") for dim in grid.dims}
        )
        described = {"Conventions": "CF-1.11", "zwidth_format": FORMAT, "coordinates": auxiliary, **attributes}
        document = json.loads((fresh / "zarr.json").read_text(encoding="utf-8")) | {"attributes": described}
        document["attributes"] = described | {CHECKSUM: _compute_checksum(document)}
        for name in _DESCRIPTIONS:
            write_atomically(fresh / name, json.dumps(document, indent=2).encode())
        yield fresh


def _compute_checksum(description: dict[str, Any]) -> str:
    """Return the checksum of a description, computed without the attribute that contains the checksum."""
    attributes = {key: value for key, value in description["attributes"].items() if key != CHECKSUM}
    old = attributes.get("zwidth_format") == OLD_FORMAT
    return hash_json(attributes if old else {**description, "attributes": attributes})


def _write_arrays(path: Path, plan: Plan) -> None:
    """Write the coordinates of a new store, and create its variables without values."""
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
    from zarr.codecs.numcodecs import PackBits

    group = zarr.create_group(path, zarr_format=3)
    for name, (dims, values, attributes) in plan.grid.coordinates().items():
        if values.dtype.kind == "U":
            values = values.astype(np.dtypes.StringDType())
        array = group.create_array(
            name,
            shape=values.shape,
            chunks=values.shape,
            dtype=values.dtype,
            compressors=[ZstdCodec(level=3), Crc32cCodec()],
            # Use a fill value that no coordinate has. Zarr does not write chunks that contain only the fill value, and
            # such chunks would later be reported as missing.
            fill_value="" if values.dtype.kind == "T" else np.nan,
            dimension_names=dims,
            attributes=attributes,
        )
        array[...] = values
    small, blosc = [ZstdCodec(level=3), Crc32cCodec()], BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")
    encodings: dict[str, dict[str, Any]] = {
        "bool": {"filters": [PackBits()], "compressors": small, "fill_value": False},
        "float64": {"compressors": [blosc, Crc32cCodec()], "fill_value": np.nan},
        "uint8": {"compressors": small, "fill_value": NOT_COMPUTED},
    }
    for family in plan.families:
        common: dict[str, Any] = {
            "shape": family.shape,
            "chunks": family.chunks,
            "dimension_names": [name.replace(".", "_") for name in family.dims],
        }
        for name in family.outputs:
            output = OUTPUTS[name]
            attributes = {"long_name": output.long_name, **output.flags}
            if output.dtype == "float64":
                attributes["units"] = plan.grid.unit_system[output.units_in(plan.grid.physical)]
            attributes["ancillary_variables"] = STATUS_OF[family.family]
            group.create_array(name, dtype=output.dtype, attributes=attributes, **common, **encodings[output.dtype])
        status_options = common | encodings["uint8"]
        group.create_array(STATUS_OF[family.family], dtype="uint8", attributes=status_flags(), **status_options)


def list_stores(path: str | os.PathLike[str]) -> list[Path]:
    """Return the path if it is a store, otherwise all stores in the folder; raise `StoreError` if there are none."""
    folder = Path(os.fsdecode(path))
    if (folder / "zarr.json").is_file() or folder.name.endswith(SUFFIX):
        return [folder]
    stores = sorted(store for store in folder.glob(f"*{SUFFIX}") if not store.name.startswith("."))
    if not stores:
        fault = "contains no store of a sweep" if folder.is_dir() else "no such folder"
        raise StoreError(f"{folder}: {fault}; name the folder of a run with a study of kind 'sweep', or a store in it")
    return stores


def find_store(path: str | os.PathLike[str]) -> Store:
    """Return the store at a path, or the only store in a folder; raise `StoreError` if it has none or several."""
    first, *others = list_stores(path)
    if others:
        names = ", ".join(store.name for store in (first, *others))
        raise StoreError(f"{os.fsdecode(path)}: contains several stores; name one of {names}")
    return Store(first)
