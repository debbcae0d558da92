"""The stiffest stable wall over delta, and the ridge study."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from zwidth import figures
from zwidth.config.scenes import AnyScene
from zwidth.config.study import DelayModels, figure_layout
from zwidth.figures.data import DelayModel, RidgeData, RidgePath, SlopeCurve, SlopeData
from zwidth.stability.ridge import RidgeKind, RidgePoint, alpha_max
from zwidth.stability.slope import stiffness_slope
from zwidth.status import Status
from zwidth.studies.curves import CurvesStudy
from zwidth.studies.outcome import Outcome, stack

# Every batch has this size, so that a run with many of them compiles the ridge once for each delay model.
_BATCH = 4096
# A path that goes this far shows what alpha_max/delta tends to: within some percent.
_STRONG_DAMPING = 100.0
# Delays at which g(d) is sampled between two whole ones; it has kinks at these.
_SLOPE_SAMPLES = 64


class RidgeStudy(CurvesStudy):
    """Maximum stiffness over delta, one curve for every d and delay model."""

    what: ClassVar[str] = "a ridge study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_models")

    kind: Literal["ridge"]

    delay_models: DelayModels = ("held",)
    """Models of a delay that is not whole."""

    figure: Annotated[Literal["fig10"] | None, figure_layout("fig10")] = None
    """Layout of the figure; a generic one where left out."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """The maximum stiffness over delta, as a table and a figure."""
        paths, notes = [], []
        for model, delays in needed_models(self.delay_models, self.d.values()):
            more, remarks = ridge_paths(self.delta.values(), delays, model)
            paths += more
            notes += remarks
        data = RidgeData(tuple(paths))
        drawn: dict[str, Any] = {"": partial(figures.draw_ridge, data, two_scalings=self.figure == "fig10")}
        if min(float(path.delta.max()) for path in paths) >= _STRONG_DAMPING:
            drawn["_slope"] = partial(figures.draw_slope, slope_data(tuple(paths)))
        return Outcome(table=stack(ridge_columns(path) for path in paths), figures=drawn, notes=tuple(notes))


def ridges(delta: np.ndarray, d: np.ndarray, delay: DelayModel) -> RidgePoint:
    """`zwidth.alpha_max` of flat arrays, in batches of one size."""
    delta, d = np.broadcast_arrays(np.asarray(delta, dtype=np.float64), np.asarray(d, dtype=np.float64))
    count = delta.size
    missing = -count % _BATCH
    padded = [np.pad(column, (0, missing), mode="edge") for column in (delta, d)]
    pieces = [
        alpha_max(*(column[start : start + _BATCH] for column in padded), delay=delay)
        for start in range(0, count + missing, _BATCH)
    ]
    return RidgePoint(*(np.concatenate(column)[:count] for column in zip(*pieces, strict=True)))


def ridge_paths(delta: np.ndarray, d: np.ndarray, delay: DelayModel) -> tuple[list[RidgePath], list[str]]:
    """One path over ``delta`` for every delay, and notes about points without an answer."""
    points = ridges(np.tile(delta, d.size), np.repeat(d, delta.size), delay)
    rows = RidgePoint(*(column.reshape(d.size, delta.size) for column in points))
    paths, notes = [], []
    for index, delay_factor in enumerate(d):
        alpha, beta, omega, kind, status = (column[index] for column in rows)
        names = np.array([RidgeKind(int(code)).name.lower() for code in kind])
        paths.append(RidgePath(float(delay_factor), delay, delta, alpha, beta, omega, names))
        failed = int(np.count_nonzero(status != Status.OK))
        if failed:
            notes.append(
                f"alpha_max: {failed} of {delta.size} points have no answer for d = {delay_factor:g} ({delay})"
            )
    return paths, notes


def needed_models(models: tuple[DelayModel, ...], d: np.ndarray) -> list[tuple[DelayModel, np.ndarray]]:
    """The delays to compute in each model: for whole periods the models agree, and one of them is enough."""
    chosen: list[tuple[DelayModel, np.ndarray]] = []
    for model in models:
        delays = d[d != np.floor(d)] if model == "fractional_power" and "held" in models else d
        if delays.size:
            chosen.append((model, delays))
    return chosen


def ridge_columns(path: RidgePath) -> dict[str, object]:
    """The columns of one path in a data file."""
    names = ("d", "delay_model", "delta", "alpha_max", "beta", "omega", "kind")
    return {name: getattr(path, name) for name in names}


def slope_data(paths: tuple[RidgePath, ...]) -> SlopeData:
    """Add to paths of maximum stiffness what alpha_max/delta tends to, and that limit over the delay."""
    limits = tuple(float(stiffness_slope(path.d, delay=path.delay_model)) for path in paths)
    longest = max(1.0, np.ceil(max(path.d for path in paths)))
    d = np.linspace(0.0, longest, int(longest) * _SLOPE_SAMPLES + 1)
    models: dict[DelayModel, None] = {path.delay_model: None for path in paths}
    curves = tuple(SlopeCurve(model, d, np.asarray(stiffness_slope(d, delay=model))) for model in models)
    return SlopeData(paths, limits, curves)
