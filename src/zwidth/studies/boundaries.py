"""The boundary study, over alpha and beta or, for alpha -> 0, over delta and beta."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np

from zwidth.batching import map_flat
from zwidth.figures import draw_boundary, draw_zero_stiffness
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
from zwidth.stability.curve import lobe_end
from zwidth.stability.region import Piece, stable_region
from zwidth.studies.outcome import Outcome, Table, stack
from zwidth.studies.passivity import passive_intervals, passive_outlines
from zwidth.studies.ridges import needed_models, ridge_paths
from zwidth.sweep.studies import BoundaryStudy

_RIDGE_POINTS = 101
# Batches of one size: a run with several studies over delta compiles once for each delay model.
_BATCH = 256


def run_boundary(study: BoundaryStudy, si: SIScale | None) -> Outcome:
    """Compute and draw the boundaries of a study."""
    return _zero_stiffness(study) if study.plane == "delta_beta" else _stiffness(study, si)


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
    return Outcome(table=_stiffness_table(data), figures={"": partial(draw_boundary, data)}, notes=tuple(notes))


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
    return Outcome(table=stack(parts), figures={"": partial(draw_zero_stiffness, data)})


def stable_intervals(deltas: np.ndarray, delays: np.ndarray, delay: DelayModel) -> list[DampingInterval]:
    """The virtual damping that is stable for alpha -> 0, over delta, for every delay."""
    columns = [np.tile(deltas, delays.size), np.repeat(delays, deltas.size)]
    upper = map_flat(_upper_kernel, columns, (delay,), _BATCH, fused=False)
    rows = np.asarray(upper).reshape(delays.size, deltas.size)
    return [DampingInterval(float(d), delay, deltas, -deltas, row) for d, row in zip(delays, rows, strict=True)]


def _upper_kernel(delta, d, delay: str):
    """The largest stable beta as alpha -> 0: the lobe's end, or the line P(-1) = 0 where it comes first."""
    loop = frequency_loop(delta, d, delay)
    omega = lobe_end(loop, d, delay)
    end = frequency_boundary(omega, loop, delay)
    # A lobe that runs to omega = pi is left along the line alpha + 2 beta = const.
    upper = jnp.where(omega >= jnp.pi, end.beta + 0.5 * end.alpha, end.beta)
    line = 0.5 * line_at_minus_one(delta, d)
    # A fractional power has no real pole at z = -1.
    has_line = (delay == "held") | (d == jnp.floor(d))
    return jnp.where(has_line & (line > -delta), jnp.minimum(upper, line), upper)
