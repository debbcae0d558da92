"""Run the studies of a configuration: compute them, write results and figures into one folder, and record the run.

A study is either a sweep, computed chunk by chunk into a store (`sweep.engine`), or a *computed study*, computed as a
whole and written to a table and figures (`studies`). The computed studies run first, one by one, then all sweeps
together. The *record* of a run is the file ``run.json`` in its folder, with one *entry* per study (`runs.record`). A
*part* of a long study is a step of it whose completion is reported.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

from zwidth.config.reader import read_mapping, write_yaml
from zwidth.config.study import Study
from zwidth.config.sweep import SweepStudy
from zwidth.core.errors import InputError
from zwidth.core.status import note_failures
from zwidth.io.files import temporary_sibling
from zwidth.plotting.style import style_sheet
from zwidth.runs.record import RUN_FILE, Record, gather_inputs, rename_inputs
from zwidth.studies.document import Config, FigureLook, load_config
from zwidth.studies.outcome import LISTENER, ComputedStudy, Outcome
from zwidth.sweep.engine import Progress, SweepResult, check_stores, compute_sweeps, remove_store, store_path
from zwidth.sweep.files import is_fatal, lock_folder
from zwidth.sweep.plan import MEMORY, Plan, check_resources, make_plan
from zwidth.sweep.store import Store, check_installed

AnyConfig = Config | Mapping[str, Any] | str | os.PathLike[str]


@dataclass(frozen=True)
class StudyResult:
    """Outcome of one study in a run.

    States: "done"; "kept", computed by an earlier run; "failed"; "open", a sweep stopped before its last chunk.
    """

    name: str
    kind: str
    state: Literal["done", "kept", "failed", "open"]
    seconds: float = 0.0  # computing time in s; for a sweep, its part of the time in which all sweeps were computed
    files: tuple[str, ...] = ()  # names of the files written in the folder of the run; for a sweep, of its store
    notes: tuple[str, ...] = ()  # remarks that affect the use of the results, such as points without a result
    answer: tuple[str, ...] = ()  # main result in one or two lines; empty if it is longer
    error: str = ""  # type and message of the exception that ended the study; empty if there was none
    # Exception that ended a computed study; None if there was none.
    exception: Exception | None = field(default=None, repr=False, compare=False)
    sweep: SweepResult | None = None  # outcome of the chunks; None for a computed study


@dataclass(frozen=True)
class RunResult:
    """Outcome of a run."""

    folder: Path
    studies: tuple[StudyResult, ...]  # outcome of each study, sweeps last
    seconds: float  # run time in s
    repaired: tuple[str, ...] = ()  # damaged or missing files and chunks that were created again
    fatal_error: str = ""  # error that ended the run, because it affects every study, such as a full disk
    interrupted: bool = False  # True if the user stopped the run with Ctrl-C; earlier results are kept
    cluster_error: str = ""  # error of the cluster that ended the run; earlier results are kept
    computed_count: int = 0  # number of studies in the configuration that are not sweeps

    @property
    def failed(self) -> tuple[StudyResult, ...]:
        """The outcomes of the studies that failed because of an error."""
        return tuple(study for study in self.studies if study.state == "failed")

    @property
    def sweeps(self) -> dict[str, SweepResult]:
        """The outcome of each sweep, by name of the study."""
        return {study.name: study.sweep for study in self.studies if study.sweep is not None}

    @property
    def ok(self) -> bool:
        """True if no study failed, and neither the user nor an error ended the run early."""
        return not (self.failed or self.interrupted or self.fatal_error or self.cluster_error)


@dataclass(frozen=True)
class StudyEvent:
    """Event that a run reports: start or end of a study, or completion of a part of it or of a chunk of a sweep."""

    index: int  # number of the study, from 1
    total: int  # number of studies
    name: str
    kind: str
    result: StudyResult | None = None  # outcome of the study; only at its end
    progress: Progress | None = None  # progress of all sweeps; only after a chunk
    parts: tuple[int, int] | None = None  # numbers of finished and of all parts; only after a part of a long study


ProgressCallback: TypeAlias = Callable[[StudyEvent], None]


def run(
    config: AnyConfig,
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    memory: int = MEMORY,
    progress: ProgressCallback | None = None,
) -> RunResult:
    """Run the studies of a configuration and write their results into one folder.

    A sweep is computed chunk by chunk into a store ``<name>.zarr``. Any other study writes a table ``<name>.csv`` (a
    map: ``<name>.npz``) and a figure as PNG and SVG; ``recommend`` adds a recommendation. Files that the configuration
    reads are copied to ``inputs``. The file ``config.yaml``, the configuration with the names of the copies, reproduces
    the run. The record ``run.json`` contains the studies, package versions, times, errors, and the files of the run.

    Args:
        config: The path of a configuration; or its content as a dict, in which arrays may replace lists, and names of
            files are relative to the current folder; or a loaded configuration.
        out: The folder of the run; by default ``runs/<name of the configuration>``.
        overwrite: Replace an existing run: the files named in its record, and no others. If the record is lost but
            ``config.yaml`` is that of this configuration, also files with the names that the run writes.
        resume: Continue an existing run. Undamaged results are kept; failed and damaged ones are computed again. The
            configuration and the releases of zwidth, JAX and NumPy must be the same.
        workers: Number of processes that compute sweeps on this machine; by default this process computes them. The
            processes are spawned, so a script must call this function below ``if __name__ == "__main__":``.
        scheduler: Address of a dask.distributed scheduler whose workers compute sweeps. The workers need access to the
            folder under the same path.
        memory: Bytes available to a chunk of a sweep during its computation.
        progress: Function that is called with a `StudyEvent` at the start and the end of a study, after every chunk of
            a sweep, and after each part of a long study.

    Returns:
        RunResult: ``folder``, ``studies`` with the outcome of each study, ``seconds``. If a study fails, its error is
        recorded and the other studies still run; ``ok`` is true if all studies succeed. Ctrl-C ends the run, sets
        ``interrupted`` and keeps all results computed until then.

    Raises:
        ConfigError: The configuration has faults.
        StoreExistsError: The folder contains a run, and neither ``resume`` nor ``overwrite`` is set; or it contains
            other files.
        StoreError: With ``resume``: a store is damaged, or the run was computed from another configuration or by
            another release.
        StoreBusyError: Another run is writing to the folder.
        ResourceError: The results do not fit on the disk, or the workers do not fit into memory.
        InputError: Options exclude each other, the folder cannot be written, or the scheduler does not reply.

    Numerics:
        Float64. The values do not depend on chunks, workers or scheduler. On another type of processor or with another
        release of JAX the last digits may differ.

    Example:
        >>> import tempfile, zwidth
        >>> study = {"kind": "map", "name": "m", "delta": 0.1, "d": 0, "alpha": 0.2, "beta": [0.1, 0.5]}
        >>> config = {"version": 1, "name": "small", "studies": [study]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     zwidth.run(config, out=f"{folder}/small").ok
        True
    """
    _check_options(workers, scheduler, resume=resume, overwrite=overwrite)
    config, text = _read_config(config)
    text, files, names = gather_inputs(text, config.folder)
    shown = Path("runs", config.name) if out is None else Path(os.fsdecode(out))
    folder, clock = Path(os.path.abspath(shown)), time.perf_counter()
    computed = [study for study in config.studies if isinstance(study, ComputedStudy)]
    plans = [make_plan(study, memory=memory) for study in config.studies if isinstance(study, SweepStudy)]
    sweeps = [plan.study for plan in plans]
    if plans:
        check_installed()
    elif scheduler is not None:
        raise InputError(f"scheduler: got {scheduler!r}, but the configuration has no sweep; leave it out")
    # Check the content of the folder and the resources before creating any file.
    Record(folder).check_free(text, overwrite=overwrite, resume=resume)
    begun = {study.name for study in sweeps if store_path(folder, study).exists()}
    check_resources(plans, folder, workers or 1, begun=set() if overwrite else begun)
    with lock_folder(folder):
        record = Record(folder)
        record.check_free(text, overwrite=overwrite, resume=resume)
        inputs = _list_inputs(config, names, files)
        if overwrite:
            record.clear()
            for study in sweeps:
                remove_store(folder, study)
        record.check_same({study.name: inputs[study.name] for study in (*computed, *sweeps)})
        check_stores(sweeps, folder, resume=resume)
        record.remove_leftovers()
        active = _Run(config, record, inputs, progress or (lambda event: None), len(computed) + len(plans))
        digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
        planned = [study.name for study in config.studies]
        record.start(name=config.name, description=config.description, config_sha256=digest, planned=planned)
        record.keep_config(text, files)
        active.compute_studies(computed)
        about = {"name": config.name, "description": config.description}
        about |= {"config": _to_json(config), "config_sha256": digest}
        if plans and not active.over:
            active.run_sweeps(plans, about, workers=workers, scheduler=scheduler)
    seconds = time.perf_counter() - clock
    ends = active.fatal_error, active.interrupted, active.cluster_error, len(computed)
    return RunResult(shown, tuple(active.results), seconds, tuple(active.repaired), *ends)


def plan_run(config: AnyConfig, *, memory: int = MEMORY) -> list[Study | Plan]:
    """Return what `run` would compute, without computing it: each study, or the plan of a study that is a sweep.

    Raises:
        ConfigError: The configuration has faults.
    """
    config, _ = _read_config(config)
    return [make_plan(study, memory=memory) if isinstance(study, SweepStudy) else study for study in config.studies]


class _Run:
    """A run in progress; its caller must hold the lock of the folder.

    Args:
        config: The configuration.
        record: The record of the run.
        inputs: Inputs of each study for the record, by name of the study.
        report: Function that is called with every event.
        total: Number of studies.
    """

    def __init__(
        self, config: Config, record: Record, inputs: dict[str, Any], report: ProgressCallback, total: int
    ) -> None:
        self.config, self.record, self.inputs, self.report, self.total = config, record, inputs, report, total
        self.results: list[StudyResult] = []
        self.repaired = [f"{RUN_FILE} is damaged"] if record.damaged else []
        self.fatal_error = self.cluster_error = ""
        self.interrupted = False

    @property
    def over(self) -> bool:
        """True if no further study is to be computed."""
        return bool(self.fatal_error) or self.interrupted

    def compute_studies(self, computed: list[ComputedStudy]) -> None:
        """Compute the studies that are not done yet.

        An error of a study is recorded and does not stop the others, because studies are independent.
        """
        for index, study in enumerate(computed, start=1):
            event = StudyEvent(index, self.total, study.name, study.kind_name())
            entry, faults = self.record.entry(study.name), self.record.faults(study.name)
            done = entry is not None and entry["state"] == "done"
            self.repaired += [f"{study.name}: {fault}" for fault in faults if done]
            try:
                if entry is not None and done and not faults:
                    kept: Any = {name: tuple(entry.get(name, ())) for name in ("files", "notes", "answer")}
                    self.results.append(StudyResult(study.name, event.kind, "kept", **kept))
                else:
                    self.report(event)
                    LISTENER.set(lambda *parts, event=event: self.report(replace(event, parts=parts)))
                    self.results.append(self._compute(study))
                self.report(replace(event, result=self.results[-1]))
            except KeyboardInterrupt:
                self.interrupted = True
            if self.over:
                return

    def _compute(self, study: ComputedStudy) -> StudyResult:
        """Compute a study, write its files, record its entry, and return its outcome."""
        clock, outcome, error = time.perf_counter(), Outcome(), None
        entry = {"name": study.name, "kind": study.kind_name(), "inputs": self.inputs[study.name]}
        alone = sum(type(other) is type(study) for other in self.config.studies) == 1

        def make_entry(error: Exception | None) -> dict[str, Any]:
            ended = {"error": _describe_error(error), "state": "failed" if error else "done"}
            seconds = round(time.perf_counter() - clock, 3)
            return {**entry, "seconds": seconds, "notes": [*outcome.notes], "answer": [*outcome.answer], **ended}

        with temporary_sibling(self.record.folder / study.name) as stage:
            stage.mkdir()
            try:
                look = self.config.figure or FigureLook()
                with style_sheet(size=look.size, dpi=look.dpi, system=study.unit_system):
                    outcome = study.compute(self.config.scene, alone)
                    outcome.write(stage, study.name, study.unit_system, look.formats)
            except Exception as caught:
                error = caught
            try:
                self.record.keep(stage, make_entry(error))
            except Exception as caught:
                error = error or caught
                before = self.record.entry(study.name) or {}
                with suppress(OSError):
                    self.record.note({**make_entry(error), "files": before.get("files", {})})
        if error is not None and is_fatal(error):
            self.fatal_error = _describe_error(error)
        kept = self.record.entry(study.name) or {"files": ()}
        ended = "failed" if error else "done", time.perf_counter() - clock, tuple(kept["files"])
        texts = outcome.notes, outcome.answer, _describe_error(error), error
        return StudyResult(study.name, study.kind_name(), *ended, *texts)

    def run_sweeps(self, plans: list[Plan], about: dict[str, Any], **options: Any) -> None:
        """Compute all sweeps together, so that worker processes are started only once.

        Args:
            plans: The plan of each sweep.
            about: Attributes of the stores.
            options: Arguments of `compute_sweeps` that select workers or a scheduler.
        """
        clock = time.perf_counter()
        number = {plan.study.name: len(self.results) + k for k, plan in enumerate(plans, start=1)}
        # Count the time between two completed chunks as computing time of the second chunk's sweep. Workers compute
        # chunks of several sweeps in parallel, so the times of sweeps cannot be measured separately.
        spent = dict.fromkeys(number, 0.0)

        def report_chunk(progress: Progress) -> None:
            nonlocal clock
            event = StudyEvent(number[progress.study], self.total, progress.study, "sweep", progress=progress)
            if not spent[progress.study]:
                self.report(replace(event, progress=None))
            now = time.perf_counter()
            spent[progress.study] += now - clock
            clock = now
            self.report(event)

        for plan in plans:
            # Record the store before it is created, so that the record of a killed run contains it.
            self.record.note(self._make_sweep_entry(plan.study, "open"))
        try:
            sweeps = compute_sweeps(plans, self.record.folder, about, progress=report_chunk, **options)
        except KeyboardInterrupt:
            # Record an interrupt before the first chunk; `compute_sweeps` handles later interrupts itself.
            self.interrupted = True
            return
        self.fatal_error, self.interrupted, self.cluster_error = (
            sweeps.fatal_error,
            sweeps.interrupted,
            sweeps.cluster_error,
        )
        for study in (plan.study for plan in plans):
            sweep = sweeps.results[study.name]
            self.repaired += sweep.repaired
            store = Store(sweep.store)
            state = "failed" if sweep.failed else "open" if store.missing() else "done"
            counts = store.count_statuses() if state == "done" else {}
            notes = tuple(note for family, each in counts.items() for note in note_failures(each, f"{family}s"))
            error = next(iter(sweep.failed.values()), sweeps.cluster_error)
            seconds = spent[study.name]
            if not self.fatal_error:
                ended = {"seconds": round(seconds, 3), "notes": [*notes], "error": error}
                self.record.note({**self._make_sweep_entry(study, state), **ended})
            files = (sweep.store.name,)
            result = StudyResult(study.name, "sweep", state, seconds, files, notes, error=error, sweep=sweep)
            self.results.append(result)
            self.report(StudyEvent(number[study.name], self.total, study.name, "sweep", result))

    def _make_sweep_entry(self, study: SweepStudy, state: str) -> dict[str, Any]:
        """Return the entry of a sweep for the record; its file has no checksum, because the store contains its own."""
        files = {store_path(Path(), study).name: None}
        return {"name": study.name, "kind": "sweep", "state": state, "inputs": self.inputs[study.name], "files": files}


def _list_inputs(config: Config, names: dict[str, str], files: dict[str, bytes]) -> dict[str, dict[str, Any]]:
    """Return a dictionary, by name of the study, of all inputs that determine its results.

    In the inputs, the name of a file is replaced by the path and the checksum of its copy.

    Args:
        config: The configuration.
        names: Path of the copy of each file, by the original name of the file.
        files: Content of each copy, by the name of the copy.
    """
    digests = {name: hashlib.sha256(files[Path(copy).name]).hexdigest()[:16] for name, copy in names.items()}
    names = {name: f"{copy}, sha256 {digests[name]}..." for name, copy in names.items()}
    inputs = {study.name: _to_json(study) for study in config.studies}
    for study in config.studies:
        if isinstance(study, ComputedStudy):
            inputs[study.name] = rename_inputs(inputs[study.name], names)
            if config.figure is not None:
                inputs[study.name]["figure"] = _to_json(config.figure)
            if study.reads_scene and config.scene is not None:
                inputs[study.name]["scene"] = _to_json(config.scene)
    return inputs


def _to_json(model: Any) -> dict[str, Any]:
    """Return a configuration, or a part of it, as a JSON value."""
    return model.model_dump(mode="json", exclude_none=True)


def _read_config(config: AnyConfig) -> tuple[Config, str]:
    """Read a configuration, as accepted by `run`, and return it with its text in YAML."""
    if isinstance(config, Mapping):
        config = read_mapping(config, Config)
    if isinstance(config, Config):
        return config, write_yaml(_to_json(config))
    if not isinstance(config, str | bytes | os.PathLike):
        raise InputError(f"config: got {config!r}; pass the path of a configuration, or a dict")
    path = Path(os.fsdecode(config))
    return load_config(path), path.read_text(encoding="utf-8-sig")


def _describe_error(error: Exception | None) -> str:
    """Return the type and message of an exception; "" for None."""
    return f"{type(error).__name__}: {error}" if error else ""


def _check_options(workers: int | None, scheduler: str | None, *, resume: bool, overwrite: bool) -> None:
    """Raise `InputError` if options are invalid or exclude each other."""
    if workers is not None and scheduler is not None:
        raise InputError("workers, scheduler: got both; the cluster has its own workers, so set only one of them")
    if workers is not None and workers < 1:
        raise InputError(f"workers: got {workers}; at least 1")
    if overwrite and resume:
        raise InputError("overwrite: given together with resume; set only one of them")
