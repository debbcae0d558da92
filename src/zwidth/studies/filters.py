"""The filters study: how stiff a wall can be behind each velocity filter, and what noise the filter lets through."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from zwidth import figures
from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.parts import locate_refusal
from zwidth.config.scenes import AnyScene, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Axis, Quantity, axis_of, quantity_of
from zwidth.figures.table import SI_COLUMNS, stack
from zwidth.parts.noise import find_velocity_noise
from zwidth.parts.velocity import BackwardDifference, LowPass, Velocity, WindowedDifference
from zwidth.studies.outcome import ComputedStudy, Outcome, Table, summarize_stiffest
from zwidth.words.errors import InputError
from zwidth.words.quantities import POSITIVE


@register
class FiltersStudy(ComputedStudy):
    """The stiffest wall over the cut-off of a low-pass and over the length of a window, and its noise."""

    method = "The highest point of all edges of the stable set, one filter after the other, to about 1e-13."
    from_scene = ("device",)
    takes_parts = True

    kind: Literal["filters"]

    device: PhysicalDevice
    """Device in SI units; the scene's where left out. Its velocity estimate is replaced."""

    damping: Annotated[Axis, axis_of("damping")] | None = None
    """Physical damping of the device, in N s/m or with a unit; the device's own where left out."""

    cutoff: Annotated[Axis, axis_of("velocity.cutoff")] | None = None
    """Cut-offs of a low-pass, in Hz or with a unit."""

    order: Annotated[int, quantity_of("velocity.order")] = 1
    """Order of the low-pass, 1 or 2."""

    samples: Annotated[Axis, axis_of("velocity.samples")] | None = None
    """Lengths of a window, in periods."""

    resolution: Annotated[float, Quantity("m", POSITIVE)] | None = None
    """One count of the position, in m or with a unit: the noise that it makes of the velocity is computed as well."""

    noise_limit: Annotated[float, Quantity("m/s", POSITIVE)] | None = None
    """Standard deviation that the noise of the velocity may have, in m/s or with a unit: the best filter is marked."""

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.cutoff is None and self.samples is None:
            yield (), problem("cutoff and samples are missing", "filters have one of them", "add 'cutoff: [30, 100]'")
        if self.noise_limit is not None and self.resolution is None:
            what = "got a noise limit without a resolution"
            yield ("noise_limit",), problem(what, "noise comes from the counts of the position", "add 'resolution'")
        if self.order > 2:
            yield ("order",), problem(f"got {self.order}", "a low-pass has order 1 or 2", "write 1 or 2")
        elif self.cutoff is not None:
            try:
                LowPass(cutoff=self.cutoff.largest, order=self.order).estimate(self.device.period)
            except InputError as error:
                yield ("cutoff",), locate_refusal(error)[1]

    @property
    def dampings(self) -> np.ndarray:
        """The values of the physical damping."""
        return np.array([self.device.damping]) if self.damping is None else self.damping.values()

    @property
    def sizes(self) -> dict[str, int]:
        filters = 1 + sum(axis.size for axis in (self.cutoff, self.samples) if axis is not None)
        return {"damping": self.dampings.size, "filters": filters}

    def estimates(self) -> Iterator[tuple[dict[str, Any], Velocity]]:
        """Every estimate with the columns that name it; the difference of two samples first."""
        absent = {"cutoff_Hz": np.nan, "samples": np.nan}
        yield {"estimate": "backward_difference", **absent, "samples": 1.0}, BackwardDifference()
        for cutoff in () if self.cutoff is None else self.cutoff.values().tolist():
            yield {"estimate": "low_pass", **absent, "cutoff_Hz": cutoff}, LowPass(cutoff=cutoff, order=self.order)
        for samples in () if self.samples is None else self.samples.values().tolist():
            named = {"estimate": "windowed_difference", **absent, "samples": samples}
            yield named, WindowedDifference(int(samples))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """The stiffest wall behind every filter, as a table and figures."""
        rows = []
        bare = self.device.to_scene()
        for damping in self.dampings.tolist():
            for named, velocity in self.estimates():
                top = bare.replace(damping=damping, velocity=velocity).max_stiffness()
                row = {"damping_N_s_per_m": damping, **named, **summarize_stiffest(top)}
                if self.resolution is not None:
                    noise = find_velocity_noise(velocity, self.device.period, self.resolution)
                    row |= {"velocity_noise_m_per_s": noise, "force_noise_N": noise * abs(float(top.virtual_damping))}
                rows.append(row)
        table = stack(rows)
        drawn: dict[str, Any] = {"": partial(figures.draw_filters, table)}
        if self.resolution is not None:
            best = (
                np.zeros(table["estimate"].size, bool)
                if self.noise_limit is None
                else _mark_best(table, self.noise_limit)
            )
            table = {**table, "best": best}
            drawn["_noise"] = partial(figures.draw_filter_noise, table, self.noise_limit or np.nan)
        return Outcome(table=table, figures=drawn)


def _mark_best(table: Table, limit: float) -> np.ndarray:
    """Which filter of each damping gives the stiffest wall within a limit of the noise."""
    best = np.zeros(table["estimate"].size, bool)
    quiet = table["velocity_noise_m_per_s"] <= limit
    for damping in np.unique(table["damping_N_s_per_m"]):
        own = np.flatnonzero(quiet & (table["damping_N_s_per_m"] == damping) & np.isfinite(table[SI_COLUMNS[0]]))
        if own.size:
            best[own[np.argmax(table[SI_COLUMNS[0]][own])]] = True
    return best
