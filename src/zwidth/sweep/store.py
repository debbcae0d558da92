"""The store of one sweep: a Zarr group that xarray opens, which knows what is in it and whether that is whole.

A chunk of the plan is a chunk of every variable of its family, so that no two tasks ever write one file. When all files
of a chunk are there, their checksums are written, in one small file that says by being there that the chunk is done.
Every file appears under its name at once and whole. That holds when a program is killed at any moment; it does not
when the machine loses power, since nothing waits for the disk: whoever reads a file compares its checksum.

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
from zwidth.sweep.files import checksum, content, digest
from zwidth.sweep.plan import Plan, Task, kept_plan
from zwidth.words.errors import InputError, StoreError, how_to_install
from zwidth.words.files import hidden_beside, remove_quietly, write_whole
from zwidth.words.quantities import NOT_COMPUTED, OUTPUTS, STATUS_OF, status_flags
from zwidth.words.rotation import own_unit
from zwidth.words.status import Status

SUFFIX = ".zarr"
FORMAT = 1
SEAL = "attributes_sha256"
FILES = "file_checksums"
# Zarr reads the first; the second is a copy of it, for the whole store would be lost with one flipped bit.
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


def name_checksums(family: str) -> str:
    return f"{family}_checksum"


class Store:
    """A store on the disk, in a folder ``<study>.zarr``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """What the store says of itself, twice; raises `StoreError` where neither can be trusted."""
        faults = []
        for name in _DESCRIPTIONS:
            try:
                attributes = json.loads((self.path / name).read_text(encoding="utf-8"))["attributes"]
                if digest({key: value for key, value in attributes.items() if key != SEAL}) == attributes[SEAL]:
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
        if attributes.get("zwidth_format") != FORMAT:
            what = attributes.get("zwidth_format")
            raise StoreError(f"{self.path}: format {what}, this release reads format {FORMAT}; use another release")
        return attributes

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
            group = zarr.open_group(self.path, mode="r+", zarr_format=3, use_consolidated=False)
            arrays: dict[str, Any] = {name: group[name] for family in self.plan.families for name in family.variables}
        # To look whether a chunk holds its fill value alone takes Zarr longer than to write it.
        return {name: array.with_config({"write_empty_chunks": True}) for name, array in arrays.items()}

    def name(self, task: Task) -> str:
        """A chunk by its study, for messages."""
        return f"{self.study.name}/{task}"

    def files(self, task: Task) -> list[Path]:
        """The files that hold a chunk, in the order of its variables."""
        key = "/".join(("c", *map(str, task.position)))
        return [self.path / name / key for name in task.plan.variables]

    def flag(self, task: Task) -> Path:
        """The file that says by being there that a chunk is done."""
        return self.path / name_checksums(task.family) / "c" / str(task.index) / "0"

    def is_done(self, task: Task) -> bool:
        return self.flag(task).exists()

    def holds(self, task: Task) -> bool:
        """The same of a chunk that another machine may have done just now."""
        if not self.is_done(task):
            # A network file system remembers for a while that a file was not there, unless its folder is read again.
            for folder in reversed(self.flag(task).parents[:2]):
                with suppress(OSError):
                    os.listdir(folder)
        return self.is_done(task)

    def missing(self) -> list[Task]:
        """The chunks that are not marked as done, in the order of the work."""
        return [task for task in self.plan.tasks() if not self.is_done(task)]

    def write(self, task: Task, values: Mapping[str, np.ndarray]) -> None:
        """Write all variables of a chunk, then mark it as done."""
        files = self.files(task)
        shape = tuple(part.stop - part.start for part in task.place)
        with silence_zarr():
            for name, file in zip(task.plan.variables, files, strict=True):
                # Zarr would read what is left of a damaged chunk at the edge of the grid before it replaces it.
                remove_quietly(file)
                self._arrays[name][task.place or ...] = np.ascontiguousarray(values[name]).reshape(shape)
        sums = np.array([checksum(file) for file in files], dtype="<u4")
        write_whole(self.flag(task), sums.tobytes())

    def count_statuses(self) -> dict[str, np.ndarray]:
        """How many points of each family have each status; those of damaged chunks are not counted."""
        counts = {family.family: np.zeros(NOT_COMPUTED, int) for family in self.plan.families}
        for task in self.plan.tasks():
            name = STATUS_OF[task.family]
            file = self.files(task)[task.plan.variables.index(name)]
            if self.is_done(task) and checksum(file) == self.checksums(task).get(name):
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
        """What is wrong with a chunk that is marked as done; nothing where its files are what was written."""
        sums = self.checksums(task)
        if not sums:
            return "its record of checksums is damaged"
        files = zip(sums, self.files(task), strict=True)
        wrong = [(name, file) for name, file in files if checksum(file) != sums[name]]
        return ", ".join(f"{name} is {'damaged' if file.exists() else 'missing'}" for name, file in wrong)

    def checksums(self, task: Task) -> dict[str, int]:
        """The checksums of the files of a chunk that is done, by their variables; nothing where they are damaged."""
        kept, variables = content(self.flag(task)), task.plan.variables
        whole = len(kept) == 4 * len(variables)
        return dict(zip(variables, np.frombuffer(kept, "<u4").tolist(), strict=True)) if whole else {}

    @property
    def described(self) -> dict[str, int]:
        """The checksums of the files beside the chunks, by their names: coordinates and descriptions of variables."""
        return self.attributes[FILES]

    def damaged_files(self) -> list[str]:
        """Those files that are not what was written, and the store's own description where it is damaged."""
        found = [name for name, expected in self.described.items() if checksum(self.path / name) != expected]
        # Two copies that differ: which of them is damaged, what is made anew from the sound one tells.
        first, second = (content(self.path / name) for name in _DESCRIPTIONS)
        return found if first == second else [*_DESCRIPTIONS, *found]

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
    """Make an empty store that appears complete."""
    with _build_beside(path, attributes) as fresh:
        os.rename(fresh, path)
    return Store(path)


@contextmanager
def _build_beside(path: Path, attributes: dict[str, Any]) -> Iterator[Path]:
    """A complete store without chunks, beside ``path``; what is left of it goes when the block ends."""
    plan = kept_plan(SweepStudy.model_validate(attributes["study"]), attributes["plan"])
    grid = plan.grid
    with hidden_beside(path) as fresh:
        with silence_zarr():
            _build(fresh, plan)
        files = sorted(file for file in fresh.rglob("*") if file.is_file() and file != fresh / "zarr.json")
        sums = {file.relative_to(fresh).as_posix(): checksum(file) for file in files}
        # The coordinates that are no dimension, as CF lists them.
        auxiliary = " ".join(
            name for name in grid.coordinates() if name not in {dim.replace(".", "_") for dim in grid.dims}
        )
        described = {"Conventions": "CF-1.11", "zwidth_format": FORMAT, "coordinates": auxiliary, **attributes}
        described = {key: value for key, value in described.items() if key not in (FILES, SEAL)} | {FILES: sums}
        document = json.loads((fresh / "zarr.json").read_text(encoding="utf-8"))
        document["attributes"] = {**described, SEAL: digest(described)}
        for name in _DESCRIPTIONS:
            write_whole(fresh / name, json.dumps(document, indent=2).encode())
        yield fresh


def _build(path: Path, plan: Plan) -> None:
    """Write the coordinates and describe the variables."""
    import zarr
    from zarr.codecs import BloscCodec, ZstdCodec
    from zarr.codecs.numcodecs import PackBits

    group = zarr.create_group(path, zarr_format=3)
    for name, (dims, values, attributes) in plan.grid.coordinates().items():
        if values.dtype.kind == "U":
            values = values.astype(np.dtypes.StringDType())
        array = group.create_array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            # NaN, which no value is: a chunk of zeros would otherwise not be written, and not be found missing.
            fill_value="" if values.dtype.kind == "T" else np.nan,
            dimension_names=dims,
            attributes=attributes,
        )
        array[...] = values
    keeping: dict[str, dict[str, Any]] = {
        "bool": {"filters": [PackBits()], "compressors": [ZstdCodec(level=3)], "fill_value": False},
        "float64": {"compressors": [BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")], "fill_value": np.nan},
        "uint8": {"compressors": [ZstdCodec(level=3)], "fill_value": NOT_COMPUTED},
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
                attributes["units"] = own_unit(output.units_in(plan.grid.physical))
            attributes["ancillary_variables"] = STATUS_OF[family.family]
            group.create_array(name, dtype=output.dtype, attributes=attributes, **common, **keeping[output.dtype])
        kept = common | keeping["uint8"]
        group.create_array(STATUS_OF[family.family], dtype="uint8", attributes=status_flags(), **kept)
        group.create_array(
            name_checksums(family.family),
            shape=(family.count, len(family.variables)),
            chunks=(1, len(family.variables)),
            dtype="<u4",
            compressors=None,
            fill_value=0,
            dimension_names=(f"{family.family}_chunk", f"{family.family}_variable"),
            attributes={"long_name": f"CRC-32 of the files of a chunk: {', '.join(family.variables)}; written last"},
        )


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
