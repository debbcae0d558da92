"""The map study: stability and passivity on a grid of alpha, beta, delta and d."""

from __future__ import annotations

from functools import partial

import numpy as np

from zwidth.figures import draw_map
from zwidth.figures.data import MapData, SIScale
from zwidth.stability.labels import is_stable
from zwidth.stability.passivity import is_passive
from zwidth.stability.radii import spectral_radius
from zwidth.studies.outcome import Outcome
from zwidth.sweep.studies import MapStudy

_TYPES = {"stable": np.bool_, "spectral_radius": np.float64, "passive": np.bool_}
_FUNCTIONS = {"stable": is_stable, "spectral_radius": spectral_radius, "passive": is_passive}


def run_map(study: MapStudy, si: SIScale | None) -> Outcome:
    """Compute and draw the outputs of a study."""
    alpha, beta, delta, d = (axis.values() for axis in (study.alpha, study.beta, study.delta, study.d))
    outputs = {name: np.empty(study.shape, dtype=_TYPES[name]) for name in study.outputs}
    # One plane at a time: the columns that broadcasting lays out are several times as large as the results.
    for delta_index, d_index in np.ndindex(delta.size, d.size):
        place = (slice(None), slice(None), delta_index, d_index)
        wall = (alpha[:, None], beta[None, :], float(delta[delta_index]), float(d[d_index]))
        for name in outputs:
            outputs[name][place] = np.asarray(_FUNCTIONS[name](*wall))
    data = MapData(alpha, beta, delta, d, outputs, si)
    figures = {f"_{name}": partial(draw_map, data, name) for name in outputs} if min(alpha.size, beta.size) > 1 else {}
    return Outcome(arrays={"alpha": alpha, "beta": beta, "delta": delta, "d": d, **outputs}, figures=figures)
