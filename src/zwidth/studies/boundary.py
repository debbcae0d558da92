"""The boundary study, over alpha and beta or, for alpha -> 0, over delta and beta."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import BeforeValidator

from zwidth import figures
from zwidth.batching import map_flat
from zwidth.config.faults import LocatedProblem, listing, problem
from zwidth.config.fields import Boolean, one_of
from zwidth.config.scenes import AnyScene
from zwidth.config.study import DelayModels, figure_layout
from zwidth.figures.data import (
    BoundaryData,
    DampingInterval,
    DelayModel,
    Outline,
    RidgePath,
    SIScale,
    ZeroStiffnessData,
)
from zwidth.loop import frequency_boundary, frequency_loop, line_at_minus_one
from zwidth.stability.bracketing import lobe_end
from zwidth.stability.region import Piece, stable_region
from zwidth.studies.curves import CurvesStudy
from zwidth.studies.outcome import Outcome, Table, si_of, stack
from zwidth.studies.passivity import passive_intervals, passive_outlines
from zwidth.studies.ridge import needed_models, ridge_paths

Plane: TypeAlias = Literal["alpha_beta", "delta_beta"]

# Samples of a boundary over frequency; only an estimate of a result's size rests on it.
_POINTS_PER_CURVE = 1000
_RIDGE_POINTS = 101
# Batches of one size: a run with several studies over delta compiles once for each delay model.
_BATCH = 256


class BoundaryStudy(CurvesStudy):
    """Stability boundaries, one for every delta, d and delay model."""

    what: ClassVar[str] = "a boundary study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_models")
    reads_scene: ClassVar[bool] = True

    kind: Literal["boundary"]

    plane: Annotated[Plane, BeforeValidator(one_of("alpha_beta", "delta_beta"))] = "alpha_beta"
    """Boundary over alpha and beta, or over delta and beta at alpha -> 0."""

    delay_models: DelayModels = ("held",)
    """Models of a delay that is not whole."""

    ridge_path: Boolean = False
    """Draw the path of maximum stiffness over delta as well; in the plane alpha_beta."""

    passivity: Boolean = False
    """Draw the passivity condition as well."""

    figure: Annotated[
        Literal["fig5", "fig6", "fig7", "fig8", "fig9"] | None, figure_layout("fig5", "fig6", "fig7", "fig8", "fig9")
    ] = None
    """Layout of the figure; a generic one where left out."""

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        plane = raw.get("plane", "alpha_beta")
        plane = plane if isinstance(plane, str) else ""
        if plane == "delta_beta" and raw.get("ridge_path") is True:
            allowed = "the path of maximum stiffness lies in the plane alpha_beta; at alpha -> 0 there is none"
            yield ("ridge_path",), problem("got true with plane delta_beta", allowed, "remove ridge_path")
        figure = raw.get("figure")
        layouts = {"alpha_beta": ("fig5", "fig7", "fig8"), "delta_beta": ("fig6", "fig9")}
        for other, names in layouts.items():
            if figure in names and plane in layouts and plane != other:
                allowed = f"the layouts for this plane are {listing(layouts[plane])}"
                remedy = "choose one of these, or change the plane"
                yield ("figure",), problem(f"got {figure!r} with plane {plane}", allowed, remedy)

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.plane == "delta_beta" and self.delta.size < 2:
            allowed = "the plane delta_beta needs two values of delta or more, its curves run over delta"
            yield ("delta",), problem("got one value", allowed, "give delta as a list, linear or log axis")

    @property
    def points(self) -> int:
        """About a thousand frequencies a curve; over delta, one point."""
        return super().points * (_POINTS_PER_CURVE if self.plane == "alpha_beta" else 1)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """One boundary for every delta, d and delay model, as a table and a figure."""
        if self.plane == "delta_beta":
            return _zero_stiffness(self)
        return _stiffness(self, si_of(self.delta, self.d, scene))


def outline(delta: float, d: float, delay: DelayModel) -> tuple[Outline, bool]:
    """The stable region of one device, and whether a pole count confirms its edge."""
    region = stable_region(delta, d, delay=delay)
    piece = np.array([Piece(int(code)).name.lower() for code in region.piece])
    return Outline(delta, d, delay, region.alpha, region.beta, region.omega, piece), region.verified


def _stiffness(study: BoundaryStudy, si: SIScale | None) -> Outcome:
    """Boundaries over alpha and beta."""
    deltas, delays = study.delta.values(), study.d.values()
    outlines, notes = [], []
    paths: list[RidgePath] = []
    for model, chosen in needed_models(study.delay_models, delays):
        for d in chosen.tolist():
            for delta in deltas.tolist():
                edge, verified = outline(delta, d, model)
                outlines.append(edge)
                if model == "held" and not verified:
                    notes.append(f"boundary: the pole count does not confirm the edge at delta = {delta:g}, d = {d:g}")
        if study.ridge_path:
            along = np.linspace(deltas.min(), deltas.max(), _RIDGE_POINTS)
            more, remarks = ridge_paths(along, chosen, model)
            paths += more
            notes += remarks
    passive = passive_outlines(deltas, delays) if study.passivity else ()
    data = BoundaryData(tuple(outlines), tuple(paths), passive, si)
    return Outcome(table=_stiffness_table(data), figures={"": partial(figures.draw_boundary, data)}, notes=tuple(notes))


def _stiffness_table(data: BoundaryData) -> Table:
    """All curves below each other; the column ``curve`` tells them apart."""
    names = ("d", "delta", "delay_model", "omega", "alpha", "beta", "piece")
    parts = [{"curve": "boundary", **{name: getattr(edge, name) for name in names}} for edge in data.outlines]
    for path in data.ridge_paths:
        columns = {"d": path.d, "delta": path.delta, "delay_model": path.delay_model, "omega": path.omega}
        parts.append({"curve": "ridge_path", **columns, "alpha": path.alpha_max, "beta": path.beta})
    for edge in data.passive:
        columns = {"d": edge.d, "delta": edge.delta, "delay_model": "held", "alpha": edge.alpha, "beta": edge.beta}
        parts.append({"curve": "passive", **columns})
    table = stack(parts)
    if data.si is not None:
        table["stiffness_N_per_m"] = table["alpha"] * data.si.stiffness
        table["virtual_damping_N_s_per_m"] = table["beta"] * data.si.virtual_damping
    return table


def _zero_stiffness(study: BoundaryStudy) -> Outcome:
    """Boundaries over delta and beta for alpha -> 0."""
    deltas, delays = np.sort(study.delta.values()), study.d.values()
    stable = [
        interval
        for model, chosen in needed_models(study.delay_models, delays)
        for interval in stable_intervals(deltas, chosen, model)
    ]
    passive = passive_intervals(deltas, delays) if study.passivity else ()
    data = ZeroStiffnessData(tuple(stable), passive)
    names = ("d", "delay_model", "delta", "beta_lower", "beta_upper")
    parts = [
        {"curve": curve, **{name: getattr(interval, name) for name in names}}
        for curve, intervals in (("stable", data.stable), ("passive", data.passive))
        for interval in intervals
    ]
    return Outcome(table=stack(parts), figures={"": partial(figures.draw_zero_stiffness, data)})


def stable_intervals(deltas: np.ndarray, delays: np.ndarray, delay: DelayModel) -> list[DampingInterval]:
    """The virtual damping that is stable for alpha -> 0, over delta, for every delay."""
    columns = [np.tile(deltas, delays.size), np.repeat(delays, deltas.size)]
    upper = map_flat(_upper_kernel, columns, (delay,), _BATCH, fused=False)
    rows = np.asarray(upper).reshape(delays.size, deltas.size)
    return [DampingInterval(float(d), delay, deltas, -deltas, row) for d, row in zip(delays, rows, strict=True)]


def _upper_kernel(delta, d, delay: str):
    """The largest stable beta as alpha -> 0: the lobe's end, or the line P(-1) = 0 where it comes first."""
    import jax.numpy as jnp

    loop = frequency_loop(delta, d, delay)
    omega = lobe_end(loop, d, delay)
    end = frequency_boundary(omega, loop, delay)
    # A lobe that runs to omega = pi is left along the line alpha + 2 beta = const.
    upper = jnp.where(omega >= jnp.pi, end.beta + 0.5 * end.alpha, end.beta)
    line = 0.5 * line_at_minus_one(delta, d)
    # A fractional power has no real pole at z = -1.
    has_line = (delay == "held") | (d == jnp.floor(d))
    return jnp.where(has_line & (line > -delta), jnp.minimum(upper, line), upper)
