"""From a configuration to the pieces of work that a run consists of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from zwidth import report
from zwidth.figures.data import SIScale
from zwidth.studies.boundaries import run_boundary
from zwidth.studies.maps import run_map
from zwidth.studies.outcome import Outcome
from zwidth.studies.passivity import run_passivity
from zwidth.studies.recommend import run_recommend, si_scale
from zwidth.studies.ridges import run_ridge
from zwidth.studies.steps import run_step
from zwidth.sweep.axes import Axis
from zwidth.sweep.devices import PhysicalScene
from zwidth.sweep.document import Config
from zwidth.sweep.responses import RecommendStudy, StepStudy
from zwidth.sweep.studies import BoundaryStudy, MapStudy, PassivityStudy, RidgeStudy, Study
from zwidth.sweep.sweeps import SweepStudy


@dataclass(frozen=True)
class Job:
    """One piece of a run: a study of the configuration, or the comparison with the paper's numbers."""

    name: str
    kind: str
    perform: Callable[[], Outcome]


def jobs_of(config: Config) -> list[Job]:
    """The studies in their order; then, where figures of the paper are repeated, its numbers as well.

    Sweeps are left out: they have stores of their own.
    """
    studies = [study for study in config.studies if not isinstance(study, SweepStudy)]
    jobs = [Job(study.name, study.kind, _performer(study, config)) for study in studies]
    if any((getattr(study, "figure", None) or "").startswith("fig") for study in config.studies):
        jobs.append(Job("published", "report", run_report))
    return jobs


def _performer(study: Study, config: Config) -> Callable[[], Outcome]:
    """What computes a study."""
    if isinstance(study, BoundaryStudy):
        return lambda: run_boundary(study, _si_of(study, config))
    if isinstance(study, MapStudy):
        return lambda: run_map(study, _si_of(study, config))
    if isinstance(study, RidgeStudy):
        return lambda: run_ridge(study)
    if isinstance(study, PassivityStudy):
        return lambda: run_passivity(study)
    if isinstance(study, StepStudy):
        return lambda: run_step(study)
    if isinstance(study, RecommendStudy):
        alone = sum(isinstance(other, RecommendStudy) for other in config.studies) == 1
        stem = "recommendation" if alone else f"{study.name}_recommendation"
        return lambda: run_recommend(study, stem)
    raise AssertionError(f"no one knows how to run a study of type {type(study).__name__}")


def _si_of(study: BoundaryStudy | MapStudy, config: Config) -> SIScale | None:
    """How to read the study's walls in SI units: it must be about the device of the file's scene alone."""
    scene = config.scene
    if not isinstance(scene, PhysicalScene):
        return None
    same = _is(study.delta, scene.delta) and _is(study.d, scene.d)
    return si_scale(scene.device) if same else None


def _is(axis: Axis, value: float) -> bool:
    return axis.size == 1 and float(axis.values()[0]) == value


def run_report() -> Outcome:
    """Compare the paper's printed numbers with the computed ones."""
    printed, sharpened = report.published_numbers(), report.sharpened_numbers()
    wrong = [row for row in printed if not row.agrees]
    return Outcome(
        documents={
            "published.md": report.as_markdown(printed, sharpened),
            "published.json": report.as_json(printed, sharpened),
        },
        notes=tuple(f"{row.quantity}: printed {row.printed}, computed {row.computed:.10g}" for row in wrong),
    )
