"""The map study: stability and passivity on a grid of alpha, beta, delta and d."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import WrapValidator

from zwidth import figures
from zwidth.config.fields import members
from zwidth.config.scenes import AnyScene
from zwidth.config.study import HeldOnly, register
from zwidth.config.values import AnyAxis, DelayAxis, DeltaAxis
from zwidth.figures.stable_set import Outlines
from zwidth.loops.rigid.passivity import is_passive
from zwidth.loops.rigid.spectral_radius import spectral_radius
from zwidth.loops.rigid.verdict import is_stable
from zwidth.studies.outcome import ComputedStudy, Outcome, add_si_of_scene, share_of_device
from zwidth.studies.ridge import find_edges

MapOutput: TypeAlias = Literal["stable", "spectral_radius", "passive"]

_TYPES = {"stable": np.bool_, "spectral_radius": np.float64, "passive": np.bool_}
_FUNCTIONS = {"stable": is_stable, "spectral_radius": spectral_radius, "passive": is_passive}


@register
class MapStudy(ComputedStudy):
    """Stability and passivity on a grid of alpha, beta, delta and d."""

    method = "Labels by the phase at the one gain crossover; radii by Newton's method, to some rounding errors."
    from_scene = ("delta", "d", "delay_model")
    reads_scene = True

    kind: Literal["map"]

    alpha: AnyAxis
    """Normalized stiffness of the wall, an axis."""

    beta: AnyAxis
    """Normalized damping of the wall, an axis."""

    delta: DeltaAxis
    """Normalized damping of the device, a number or an axis; the scene's where left out."""

    d: DelayAxis
    """Delay in periods, a number or an axis; the scene's where left out."""

    outputs: Annotated[tuple[MapOutput, ...], WrapValidator(members("outputs"))] = ("stable",)
    """What is computed at every point."""

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; poles exist in the model 'held' only."""

    @property
    def sizes(self) -> dict[str, int]:
        return {name: getattr(self, name).size for name in ("alpha", "beta", "delta", "d")}

    @property
    def nbytes(self) -> int:
        # And a status code a point.
        return self.points * (1 + sum(np.dtype(_TYPES[name]).itemsize for name in self.outputs))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        alpha, beta, delta, d = (axis.values() for axis in (self.alpha, self.beta, self.delta, self.d))
        share = share_of_device(self.delta, self.d, scene)
        outputs = {name: np.empty(tuple(self.sizes.values()), dtype=_TYPES[name]) for name in self.outputs}
        # One plane at a time: the columns that broadcasting lays out are several times as large as the results.
        for delta_index, d_index in np.ndindex(delta.size, d.size):
            place = (slice(None), slice(None), delta_index, d_index)
            for name in outputs:
                damping = float(delta[delta_index]) * (share if name == "passive" else 1.0)
                found = _FUNCTIONS[name](alpha[:, None], beta[None, :], damping, float(d[d_index]))
                outputs[name][place] = np.asarray(found)
        arrays = {"alpha": alpha, "beta": beta, "delta": delta, "d": d, **outputs}
        arrays = add_si_of_scene(arrays, self.delta, self.d, scene)
        names = outputs if min(alpha.size, beta.size) > 1 else ()

        def find_edge(name: str, delta: float, d: float) -> Outlines | None:
            return find_edges(delta * (share if name == "passive" else 1.0), d).get(name)

        draw = partial(figures.draw_map, arrays)
        drawn = {f"_{name}": partial(draw, name, edges=partial(find_edge, name)) for name in names}
        return Outcome(arrays=arrays, figures=drawn)
