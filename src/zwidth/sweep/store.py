"""The store of one sweep: a Zarr group that xarray opens, which knows what is in it and whether that is whole.

A chunk of the plan is a chunk of every variable of its family, so that no two tasks write the same file. The status
file is written last: its existence marks the chunk as done. Every file appears under its name only when it is complete,
even if the program is killed. After a power failure this is not guaranteed, because writes are not synchronized with
the disk. Therefore every file of values ends with a checksum (Zarr's codec crc32c). The description of the group
contains the descriptions of all arrays and has a checksum as well.

Only this module, which writes, and `dataset` with `checked`, which read, import zarr or xarray.
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
from zwidth.sweep.files import content, digest
from zwidth.sweep.plan import Plan, Task, kept_plan
from zwidth.words.errors import InputError, StoreError, how_to_install
from zwidth.words.files import hidden_beside, remove_quietly, write_whole
from zwidth.words.quantities import NOT_COMPUTED, OUTPUTS, STATUS_OF, status_flags
from zwidth.words.status import Status

SUFFIX = ".zarr"
FORMAT = 2  # format version of new stores
OLD_FORMAT = 1  # format of earlier releases, whose checksums are kept in separate arrays and no longer read
SEAL = "attributes_sha256"  # attribute with the checksum of the description
# Zarr reads the first file; the second is a copy, because one flipped bit in a single file would lose the whole store.
_DESCRIPTIONS = ("zarr.json", "zwidth.json")


@contextmanager
def silence_zarr() -> Iterator[None]:
    """Keep back what zarr says about every codec and type that is not in its core specification."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Zarr", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*Zarr", category=FutureWarning)
        yield


def check_installed() -> None:
    """Raise an `InputError` that says what to install where a library that stores are made with is missing."""
    for name in ("dask", "h5netcdf", "h5py", "xarray", "zarr"):
        if find_spec(name) is None:
            raise InputError(f"sweep: needs {name}, which is not installed; install it: {how_to_install('store')}")


class Store:
    """A store on the disk, in a folder ``<study>.zarr``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def description(self) -> dict[str, Any]:
        """Description of the group and its arrays; `StoreError` if neither copy has a valid checksum."""
        faults = []
        for name in _DESCRIPTIONS:
            try:
                description = json.loads((self.path / name).read_text(encoding="utf-8"))
                if _seal(description) == description["attributes"][SEAL]:
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
        # Earlier releases wrote delay_model, which was always "held", the exact delay.
        description["attributes"]["study"].pop("delay_model", None)
        return description

    @property
    def attributes(self) -> dict[str, Any]:
        return self.description["attributes"]

    @property
    def has_checksums(self) -> bool:
        return self.attributes["zwidth_format"] != OLD_FORMAT

    @cached_property
    def study(self) -> SweepStudy:
        return SweepStudy.model_validate(self.attributes["study"])

    @cached_property
    def plan(self) -> Plan:
        return kept_plan(self.study, self.attributes["plan"])

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        import zarr

        with silence_zarr():
            group = zarr.open_group(self.path, mode="r+", zarr_format=3, use_consolidated=True)
            arrays: dict[str, Any] = {name: group[name] for family in self.plan.families for name in family.variables}
        # To look whether a chunk holds its fill value alone takes Zarr longer than to write it.
        return {name: array.with_config({"write_empty_chunks": True}) for name, array in arrays.items()}

    def name(self, task: Task) -> str:
        """A chunk by its study, for messages."""
        return f"{self.study.name}/{task}"

    def files(self, task: Task) -> list[Path]:
        """Return the files of a chunk in the order of its variables; the status is the last one."""
        key = "/".join(("c", *map(str, task.position)))
        return [self.path / name / key for name in task.plan.variables]

    def flag(self, task: Task) -> Path:
        """Return the file whose existence marks a chunk as done, which is the status file."""
        return self.files(task)[-1]

    def is_done(self, task: Task) -> bool:
        return self.flag(task).exists()

    def holds(self, task: Task) -> bool:
        """The same of a chunk that another machine may have done just now."""
        if not self.is_done(task):
            # A network file system remembers for a while that a file was not there, unless its folder is read again.
            for folder in reversed(self.flag(task).parents[: len(task.position) + 1]):
                with suppress(OSError):
                    os.listdir(folder)
        return self.is_done(task)

    def missing(self) -> list[Task]:
        """The chunks that are not marked as done, in the order of the work."""
        return [task for task in self.plan.tasks() if not self.is_done(task)]

    def write(self, task: Task, values: Mapping[str, np.ndarray]) -> None:
        """Write all variables of a chunk, the status last."""
        shape = tuple(part.stop - part.start for part in task.place)
        with silence_zarr():
            for name, file in zip(task.plan.variables, self.files(task), strict=True):
                # Zarr would read what is left of a damaged chunk at the edge of the grid before it replaces it.
                remove_quietly(file)
                self._arrays[name][task.place or ...] = np.ascontiguousarray(values[name]).reshape(shape)

    def count_statuses(self) -> dict[str, np.ndarray]:
        """How many points of each family have each status; those of damaged chunks are not counted."""
        counts = {family.family: np.zeros(NOT_COMPUTED, int) for family in self.plan.families}
        for task in self.plan.tasks():
            name = STATUS_OF[task.family]
            if self.is_done(task) and not self.find_fault(self.flag(task)):
                with silence_zarr():
                    status = np.asarray(self._arrays[name][task.place or ...])
                # Nearly all are 0.
                failed = status[status.view(bool)]
                counts[task.family][Status.OK] += status.size - failed.size
                counts[task.family] += np.bincount(failed, minlength=NOT_COMPUTED)
        return counts

    def forget(self, task: Task) -> None:
        """Take back that a chunk is done."""
        remove_quietly(self.flag(task))

    def fault_of(self, task: Task) -> str:
        """Return the names of the damaged and missing variables of a chunk that is marked as done; "" if none."""
        faults = zip(task.plan.variables, map(self.find_fault, self.files(task)), strict=True)
        return ", ".join(f"{name} is {fault}" for name, fault in faults if fault)

    def find_fault(self, file: Path, data: bytes | None = None) -> str:
        """Return "missing" or "damaged" for a file of values with content ``data``; "" if its checksum is correct."""
        import google_crc32c

        data = content(file) if data is None else data
        if not data:
            return "damaged" if file.exists() else "missing"
        right = google_crc32c.value(data[:-4]).to_bytes(4, "little") == data[-4:]
        return "" if right or not self.has_checksums else "damaged"

    def damaged_files(self) -> list[str]:
        """Return the names of damaged coordinate files, and those of the description if its two copies differ."""
        places = ((name, len(dims)) for name, (dims, *_) in self.plan.grid.coordinates().items())
        names = ["/".join((name, "c", *["0"] * count)) for name, count in places]
        damaged = [name for name in names if self.find_fault(self.path / name)]
        first, second = (content(self.path / name) for name in _DESCRIPTIONS)
        return damaged if first == second else [*_DESCRIPTIONS, *damaged]

    def restore(self, names: list[str]) -> None:
        """Write such files again; they follow from the store's attributes."""
        attributes = self.attributes
        with _build_beside(self.path, attributes) as fresh:
            for name in names:
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                if (self.path / name).is_dir():
                    remove_quietly(self.path / name)
                os.replace(fresh / name, self.path / name)


def create(path: Path, attributes: dict[str, Any]) -> Store:
    """Create an empty store, which appears under its name only when it is complete."""
    with _build_beside(path, attributes) as fresh:
        os.rename(fresh, path)
    return Store(path)


@contextmanager
def _build_beside(path: Path, attributes: dict[str, Any]) -> Iterator[Path]:
    """A complete store without chunks, beside ``path``; what is left of it goes when the block ends."""
    import zarr

    plan = kept_plan(SweepStudy.model_validate(attributes["study"]), attributes["plan"])
    grid = plan.grid
    with hidden_beside(path) as fresh:
        with silence_zarr():
            _build(fresh, plan)
            zarr.consolidate_metadata(fresh, zarr_format=3)
        # The coordinates that are no dimension, as CF lists them.
        auxiliary = " ".join(
            name for name in grid.coordinates() if name not in {dim.replace(".", "_") for dim in grid.dims}
        )
        described = {"Conventions": "CF-1.11", "zwidth_format": FORMAT, "coordinates": auxiliary, **attributes}
        document = json.loads((fresh / "zarr.json").read_text(encoding="utf-8")) | {"attributes": described}
        document["attributes"] = described | {SEAL: _seal(document)}
        for name in _DESCRIPTIONS:
            write_whole(fresh / name, json.dumps(document, indent=2).encode())
        yield fresh


def _seal(description: dict[str, Any]) -> str:
    """Return the checksum of a description, computed without its checksum attribute."""
    attributes = {key: value for key, value in description["attributes"].items() if key != SEAL}
    old = attributes.get("zwidth_format") == OLD_FORMAT
    return digest(attributes if old else {**description, "attributes": attributes})


def _build(path: Path, plan: Plan) -> None:
    """Write the coordinates and describe the variables."""
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
            # NaN, which no value is: a chunk of zeros would otherwise not be written, and not be found missing.
            fill_value="" if values.dtype.kind == "T" else np.nan,
            dimension_names=dims,
            attributes=attributes,
        )
        array[...] = values
    small, blosc = [ZstdCodec(level=3), Crc32cCodec()], BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")
    keeping: dict[str, dict[str, Any]] = {
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
            group.create_array(name, dtype=output.dtype, attributes=attributes, **common, **keeping[output.dtype])
        kept = common | keeping["uint8"]
        group.create_array(STATUS_OF[family.family], dtype="uint8", attributes=status_flags(), **kept)


def list_stores(path: str | os.PathLike[str]) -> list[Path]:
    """The stores at a path: the path itself, or those in the folder, one at least."""
    folder = Path(os.fsdecode(path))
    if (folder / "zarr.json").is_file() or folder.name.endswith(SUFFIX):
        return [folder]
    found = sorted(found for found in folder.glob(f"*{SUFFIX}") if not found.name.startswith("."))
    if not found:
        what = "holds no store of a sweep" if folder.is_dir() else "no such folder"
        raise StoreError(f"{folder}: {what}; name the folder of a run with a study of kind 'sweep', or a store in it")
    return found


def find_store(path: str | os.PathLike[str]) -> Store:
    first, *others = list_stores(path)
    if others:
        names = ", ".join(store.name for store in (first, *others))
        raise StoreError(f"{os.fsdecode(path)}: holds several stores; name one of {names}")
    return Store(first)
