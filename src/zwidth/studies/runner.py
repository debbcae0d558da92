"""Running a configuration: every study computed, written and drawn, into one folder."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zwidth import __version__
from zwidth.studies.events import ProgressCallback, RunResult, StudyEvent, StudyResult
from zwidth.studies.folder import RUN_FILE, staged
from zwidth.sweep.config import Config, load_config

if TYPE_CHECKING:
    from zwidth.studies.jobs import Job

RUN_FORMAT = 1
_PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "matplotlib", "optimistix", "equinox", "jaxopt")


def run(
    config: Config | str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> RunResult:
    """Run the studies of a configuration one by one and write their results into one folder.

    A study writes a table ``<name>.csv`` (a map: ``<name>.npz``) and a figure as PNG and SVG; ``recommend`` adds a
    recommendation, and a configuration that repeats figures of the paper adds ``published.md`` and
    ``published.json``. ``run.json`` tells what ran, in which versions, how long it took and what failed.

    Args:
        config: a configuration, or the path of one.
        out: the folder to make; ``runs/<name of the configuration>`` where left out.
        overwrite: replace a run that is already there.
        progress: called with a `StudyEvent` when a study starts and when it ends.

    Returns:
        RunResult: ``folder``; ``studies``, how each of them went; ``seconds``. A study that fails is recorded with
        its error and does not keep the others from running; ``ok`` tells that none did.

    Raises:
        ConfigError: the configuration has faults.
        StoreExistsError: the folder is not empty; with ``overwrite``, only where it holds no run.
        StoreBusyError: with ``overwrite``: another run computes sweeps in the folder.

    Numerics:
        Float64 throughout. The folder takes its name when all studies have ended; until then it is called
        ``.<name>.<random>.partial``.

    Example:
        >>> import tempfile, zwidth.studies
        >>> from zwidth.sweep.config import Config
        >>> study = {"kind": "map", "name": "m", "delta": 0.1, "d": 0, "alpha": 0.2, "beta": [0.1, 0.5]}
        >>> config = Config.model_validate({"version": 1, "name": "small", "studies": [study]})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     zwidth.studies.run(config, out=f"{folder}/small").ok
        True
    """
    text = ""
    if not isinstance(config, Config):
        path = Path(os.fsdecode(config))
        config = load_config(path)
        text = path.read_text(encoding="utf-8-sig")
    folder = Path("runs", config.name) if out is None else Path(os.fsdecode(out))
    text = text or json.dumps(config.model_dump(mode="json", exclude_none=True), indent=2) + "\n"
    started, clock = datetime.now(UTC), time.perf_counter()
    with staged(folder.absolute(), overwrite) as partial:
        # A folder that is refused is refused before JAX is loaded.
        from zwidth.studies.jobs import jobs_of

        jobs, results = jobs_of(config), []
        for index, job in enumerate(jobs, start=1):
            tell = progress or (lambda event: None)
            tell(StudyEvent(index, len(jobs), job.name, job.kind))
            results.append(_perform(job, partial))
            tell(StudyEvent(index, len(jobs), job.name, job.kind, results[-1]))
        seconds = time.perf_counter() - clock
        (partial / "config.yaml").write_text(text, encoding="utf-8")
        record = _record(config, text, results, started, seconds)
        (partial / RUN_FILE).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return RunResult(folder, tuple(results), seconds)


def _perform(job: Job, folder: Path) -> StudyResult:
    """Do one job; whatever goes wrong is recorded, for the other jobs do not depend on it."""
    clock = time.perf_counter()
    files: list[str] = []
    notes: tuple[str, ...] = ()
    error: Exception | None = None
    try:
        outcome = job.perform()
        notes = outcome.notes
        files.extend(outcome.write(folder, job.name))
    except Exception as caught:
        error = caught
    return StudyResult(
        name=job.name,
        kind=job.kind,
        state="failed" if error else "done",
        seconds=time.perf_counter() - clock,
        files=tuple(files),
        notes=notes,
        error=f"{type(error).__name__}: {error}" if error else "",
        exception=error,
    )


def _record(config: Config, text: str, results: list[StudyResult], started: datetime, seconds: float) -> dict[str, Any]:
    """The content of run.json."""
    import jax

    return {
        "format": RUN_FORMAT,
        "name": config.name,
        "description": config.description,
        "config_sha256": hashlib.sha256(text.encode("utf-8")).hexdigest(),
        "started": started.isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "precision": "float64",
        "backend": jax.default_backend(),
        "versions": {"zwidth": __version__, "python": platform.python_version(), **_versions()},
        "studies": [
            {
                "name": result.name,
                "kind": result.kind,
                "state": result.state,
                "seconds": round(result.seconds, 3),
                "files": list(result.files),
                "notes": list(result.notes),
                "error": result.error,
            }
            for result in results
        ],
    }


def _versions() -> dict[str, str]:
    """The versions of the packages that a result depends on."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
