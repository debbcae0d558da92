"""The one run: studies of a configuration computed, written and drawn into one folder, and what it tells of itself."""

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
from zwidth.figures.style import style_sheet
from zwidth.runs.record import RUN_FILE, Record, gather_inputs, rename_inputs
from zwidth.studies.document import Config, FigureLook, load_config
from zwidth.studies.outcome import LISTENER, ComputedStudy, Outcome
from zwidth.sweep.engine import Progress, SweepResult, check_stores, compute_sweeps, remove_store, store_path
from zwidth.sweep.files import is_fatal, lock_folder
from zwidth.sweep.plan import MEMORY, Plan, check_resources, make_plan
from zwidth.sweep.store import Store, check_installed
from zwidth.words.errors import InputError
from zwidth.words.files import hidden_beside
from zwidth.words.status import note_failures

AnyConfig = Config | Mapping[str, Any] | str | os.PathLike[str]


@dataclass(frozen=True)
class StudyResult:
    """Outcome of one study in a run.

    States: "done"; "kept", computed by an earlier run; "failed"; "open", a sweep stopped before its last chunk.
    """

    name: str
    kind: str
    state: Literal["done", "kept", "failed", "open"]
    seconds: float = 0.0  # the sweeps of a run are computed together
    files: tuple[str, ...] = ()  # written in the run's folder; a sweep's is its store
    notes: tuple[str, ...] = ()  # what a reader of the results must know, such as points without an answer
    answer: tuple[str, ...] = ()  # what was found, where a line or two can say it
    error: str = ""  # type and message of what went wrong
    exception: Exception | None = field(default=None, repr=False, compare=False)  # of a study that is no sweep
    sweep: SweepResult | None = None


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    folder: Path
    studies: tuple[StudyResult, ...]  # how each of them went, those that are sweeps last
    seconds: float
    repaired: tuple[str, ...] = ()  # files and chunks that were damaged or missing, and that were made again
    hopeless: str = ""  # the error that ended the run early, for nothing else would have escaped it, as a full disk
    interrupted: bool = False  # whether somebody stopped the run, with Ctrl-C; what was done by then is kept
    lost: str = ""  # why a cluster could not go on, its scheduler having died say; what was done by then is kept
    whole: int = 0  # how many studies it was to do, beside sweeps

    @property
    def failed(self) -> tuple[StudyResult, ...]:
        """The studies that lack results because something went wrong."""
        return tuple(study for study in self.studies if study.state == "failed")

    @property
    def sweeps(self) -> dict[str, SweepResult]:
        """The sweeps by their names."""
        return {study.name: study.sweep for study in self.studies if study.sweep is not None}

    @property
    def ok(self) -> bool:
        """Whether everything that this run was to do is done."""
        return not (self.failed or self.interrupted or self.hopeless or self.lost)


@dataclass(frozen=True)
class StudyEvent:
    """The start or the end of a study, a part of one, or a chunk of a sweep."""

    index: int  # number of the study, from 1
    total: int  # how many there are
    name: str
    kind: str
    result: StudyResult | None = None  # how it went, when it ends
    progress: Progress | None = None  # how far the sweeps are, after a chunk
    parts: tuple[int, int] | None = None  # how many parts of a study that takes long are done, and of how many


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
    reads are copied to ``inputs``, and ``config.yaml``, the configuration with the names of the copies, computes the
    same again.
    ``run.json`` tells what ran, in which versions, how long it took, what failed, and which files are the run's own.

    Args:
        config: the path of a configuration; or what its file would hold, as a dict, in which arrays serve as lists and
            files are looked for in the present folder; or a configuration that is read already.
        out: the folder; ``runs/<name of the configuration>`` where left out.
        overwrite: replace a run that is already there: the files that its record names, and nothing else; where the
            record is lost and ``config.yaml`` is this configuration's, files of the names that the run writes.
        resume: go on with a run that is there. What is done and undamaged is kept, what failed or is damaged is
            computed again; another configuration, or another release, is refused.
        workers: how many processes compute sweeps on this machine; this process itself where left out. They are
            spawned: a script that asks for them does its work below ``if __name__ == "__main__":``.
        scheduler: address of a dask.distributed scheduler whose workers compute sweeps, and see the same folder.
        memory: bytes that a chunk of a sweep may take while it is computed.
        progress: called with a `StudyEvent` when a study starts and when it ends, after every chunk of a sweep, and
            between the parts of a study that takes long.

    Returns:
        RunResult: ``folder``; ``studies``, how each of them went; ``seconds``. A study that fails is recorded with its
        error and does not keep the others from running; ``ok`` tells that none did. Ctrl-C ends the run with
        ``interrupted`` set; what is done by then is kept.

    Raises:
        ConfigError: the configuration has faults.
        StoreExistsError: the folder holds a run, and neither ``resume`` nor ``overwrite`` is set; or it holds something
            else.
        StoreError: with ``resume``: a store is damaged, or the run was made from another configuration or release.
        StoreBusyError: another run is writing to the folder.
        ResourceError: the results do not fit on the disk, or the workers not into memory.
        InputError: options that exclude each other, a folder that cannot be written, a scheduler that does not answer.

    Numerics:
        Float64. The values do not depend on chunks, workers or engine; on another kind of processor or with another
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
    pieces = [study for study in config.studies if isinstance(study, ComputedStudy)]
    plans = [make_plan(study, memory=memory) for study in config.studies if isinstance(study, SweepStudy)]
    sweeps = [plan.study for plan in plans]
    if plans:
        check_installed()
    elif scheduler is not None:
        raise InputError(f"scheduler: got {scheduler!r}, but the configuration has no sweep; leave it out")
    # What does not fit, or not belong there, is refused before anything is made.
    Record(folder).check_free(text, overwrite=overwrite, going_on=resume)
    begun = {study.name for study in sweeps if store_path(folder, study).exists()}
    check_resources(plans, folder, workers or 1, begun=set() if overwrite else begun)
    with lock_folder(folder):
        record = Record(folder)
        record.check_free(text, overwrite=overwrite, going_on=resume)
        inputs = _list_inputs(config, names, files)
        if overwrite:
            record.clear()
            for study in sweeps:
                remove_store(folder, study)
        record.check_same({study.name: inputs[study.name] for study in (*pieces, *sweeps)})
        check_stores(sweeps, folder, resume=resume)
        record.sweep_up()
        job = _Run(config, record, inputs, progress or (lambda event: None), len(pieces) + len(plans))
        digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
        planned = [study.name for study in config.studies]
        record.start(name=config.name, description=config.description, config_sha256=digest, planned=planned)
        record.keep_config(text, files)
        job.do(pieces)
        about = {"name": config.name, "description": config.description}
        about |= {"config": _spell(config), "config_sha256": digest}
        if plans and not job.over:
            job.sweep(plans, about, workers=workers, scheduler=scheduler)
    seconds = time.perf_counter() - clock
    ends = job.hopeless, job.interrupted, job.lost, len(pieces)
    return RunResult(shown, tuple(job.results), seconds, tuple(job.repaired), *ends)


def plan_run(config: AnyConfig, *, memory: int = MEMORY) -> list[Study | Plan]:
    """What `run` would compute: each study, a sweep as its plan; nothing is done.

    Raises:
        ConfigError: the configuration has faults.
    """
    config, _ = _read_config(config)
    return [make_plan(study, memory=memory) if isinstance(study, SweepStudy) else study for study in config.studies]


class _Run:
    """A run of so many studies on its way; its folder is held, and ``tell`` is called with every event."""

    def __init__(
        self, config: Config, record: Record, inputs: dict[str, Any], tell: ProgressCallback, total: int
    ) -> None:
        self.config, self.record, self.inputs, self.tell, self.total = config, record, inputs, tell, total
        self.results: list[StudyResult] = []
        self.repaired = [f"{RUN_FILE} is damaged"] if record.damaged else []
        self.hopeless = self.lost = ""
        self.interrupted = False

    @property
    def over(self) -> bool:
        return bool(self.hopeless) or self.interrupted

    def do(self, pieces: list[ComputedStudy]) -> None:
        """Compute what is not done yet; whatever goes wrong is recorded, for the others do not depend on it."""
        for index, study in enumerate(pieces, start=1):
            event = StudyEvent(index, self.total, study.name, study.kind_name())
            entry, faults = self.record.entry(study.name), self.record.faults(study.name)
            done = entry is not None and entry["state"] == "done"
            self.repaired += [f"{study.name}: {fault}" for fault in faults if done]
            try:
                if entry is not None and done and not faults:
                    kept: Any = {name: tuple(entry.get(name, ())) for name in ("files", "notes", "answer")}
                    self.results.append(StudyResult(study.name, event.kind, "kept", **kept))
                else:
                    self.tell(event)
                    LISTENER.set(lambda *parts, event=event: self.tell(replace(event, parts=parts)))
                    self.results.append(self._compute(study))
                self.tell(replace(event, result=self.results[-1]))
            except KeyboardInterrupt:
                self.interrupted = True
            if self.over:
                return

    def _compute(self, study: ComputedStudy) -> StudyResult:
        clock, outcome, error = time.perf_counter(), Outcome(), None
        entry = {"name": study.name, "kind": study.kind_name(), "inputs": self.inputs[study.name]}
        alone = sum(type(other) is type(study) for other in self.config.studies) == 1

        def tell(error: Exception | None) -> dict[str, Any]:
            ended = {"error": _describe_error(error), "state": "failed" if error else "done"}
            seconds = round(time.perf_counter() - clock, 3)
            return {**entry, "seconds": seconds, "notes": [*outcome.notes], "answer": [*outcome.answer], **ended}

        with hidden_beside(self.record.folder / study.name) as stage:
            stage.mkdir()
            try:
                look = self.config.figure or FigureLook()
                with style_sheet(size=look.size, dpi=look.dpi, system=study.unit_system):
                    outcome = study.compute(self.config.scene, alone)
                    outcome.write(stage, study.name, study.unit_system, look.formats)
            except Exception as caught:
                error = caught
            try:
                self.record.keep(stage, tell(error))
            except Exception as caught:
                error = error or caught
                before = self.record.entry(study.name) or {}
                with suppress(OSError):
                    self.record.note({**tell(error), "files": before.get("files", {})})
        if error is not None and is_fatal(error):
            self.hopeless = _describe_error(error)
        kept = self.record.entry(study.name) or {"files": ()}
        ended = "failed" if error else "done", time.perf_counter() - clock, tuple(kept["files"])
        told = outcome.notes, outcome.answer, _describe_error(error), error
        return StudyResult(study.name, study.kind_name(), *ended, *told)

    def sweep(self, plans: list[Plan], about: dict[str, Any], **options: Any) -> None:
        """Compute the sweeps, all together, so that workers are started once."""
        clock = time.perf_counter()
        number = {plan.study.name: len(self.results) + k for k, plan in enumerate(plans, start=1)}
        # Chunks end one by one, those of several sweeps mixed where there are workers: to each the time before its end.
        spent = dict.fromkeys(number, 0.0)

        def follow(progress: Progress) -> None:
            nonlocal clock
            event = StudyEvent(number[progress.study], self.total, progress.study, "sweep", progress=progress)
            if not spent[progress.study]:
                self.tell(replace(event, progress=None))
            now = time.perf_counter()
            spent[progress.study] += now - clock
            clock = now
            self.tell(event)

        for plan in plans:
            # Named before it is made: what a killed run leaves is its own.
            self.record.note(self._spell_sweep(plan.study, "open"))
        try:
            sweeps = compute_sweeps(plans, self.record.folder, about, progress=follow, **options)
        except KeyboardInterrupt:
            # Before the first chunk began.
            self.interrupted = True
            return
        self.hopeless, self.interrupted, self.lost = sweeps.fatal_error, sweeps.interrupted, sweeps.lost
        for study in (plan.study for plan in plans):
            sweep = sweeps.results[study.name]
            self.repaired += sweep.repaired
            store = Store(sweep.store)
            state = "failed" if sweep.failed else "open" if store.missing() else "done"
            counts = store.count_statuses() if state == "done" else {}
            notes = tuple(note for family, each in counts.items() for note in note_failures(each, f"{family}s"))
            error = next(iter(sweep.failed.values()), sweeps.lost)
            seconds = spent[study.name]
            if not self.hopeless:
                ended = {"seconds": round(seconds, 3), "notes": [*notes], "error": error}
                self.record.note({**self._spell_sweep(study, state), **ended})
            files = (sweep.store.name,)
            result = StudyResult(study.name, "sweep", state, seconds, files, notes, error=error, sweep=sweep)
            self.results.append(result)
            self.tell(StudyEvent(number[study.name], self.total, study.name, "sweep", result))

    def _spell_sweep(self, study: SweepStudy, state: str) -> dict[str, Any]:
        """What the record says of a sweep; its store knows by itself which of its files are whole."""
        files = {store_path(Path(), study).name: None}
        return {"name": study.name, "kind": "sweep", "state": state, "inputs": self.inputs[study.name], "files": files}


def _list_inputs(config: Config, names: dict[str, str], files: dict[str, bytes]) -> dict[str, dict[str, Any]]:
    """What the results of each study follow from, besides the releases; a file by its copy and what that holds."""
    digests = {name: hashlib.sha256(files[Path(copy).name]).hexdigest()[:16] for name, copy in names.items()}
    names = {name: f"{copy}, sha256 {digests[name]}..." for name, copy in names.items()}
    found = {study.name: _spell(study) for study in config.studies}
    for study in config.studies:
        if isinstance(study, ComputedStudy):
            found[study.name] = rename_inputs(found[study.name], names)
            if config.figure is not None:
                found[study.name]["figure"] = _spell(config.figure)
            if study.reads_scene and config.scene is not None:
                found[study.name]["scene"] = _spell(config.scene)
    return found


def _spell(model: Any) -> dict[str, Any]:
    """A configuration, or a part of it, as JSON has it."""
    return model.model_dump(mode="json", exclude_none=True)


def _read_config(config: AnyConfig) -> tuple[Config, str]:
    if isinstance(config, Mapping):
        config = read_mapping(config, Config)
    if isinstance(config, Config):
        return config, write_yaml(_spell(config))
    if not isinstance(config, str | bytes | os.PathLike):
        raise InputError(f"config: got {config!r}; give the path of a configuration, or a dict")
    path = Path(os.fsdecode(config))
    return load_config(path), path.read_text(encoding="utf-8-sig")


def _describe_error(error: Exception | None) -> str:
    return f"{type(error).__name__}: {error}" if error else ""


def _check_options(workers: int | None, scheduler: str | None, *, resume: bool, overwrite: bool) -> None:
    if workers is not None and scheduler is not None:
        raise InputError("workers, scheduler: got both; the cluster has its own workers, give one of the two")
    if workers is not None and workers < 1:
        raise InputError(f"workers: got {workers}; at least 1")
    if overwrite and resume:
        raise InputError("overwrite: given together with resume; give only one of them")
