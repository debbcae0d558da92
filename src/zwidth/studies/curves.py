"""The base of studies over delta and d."""

from __future__ import annotations

from zwidth.config.axes import DelayAxis, DeltaAxis
from zwidth.studies.outcome import ComputedStudy


class CurvesStudy(ComputedStudy):
    """What the studies over delta and d share."""

    delta: DeltaAxis
    """Normalized damping of the device, an axis; the scene's where left out."""

    d: DelayAxis
    """Delay in periods, an axis; the scene's where left out."""

    @property
    def models(self) -> int:
        """How many delay models are computed."""
        return len(getattr(self, "delay_models", ("held",)))

    @property
    def extent(self) -> str:
        return f"delta x d x delay models = {self.delta.size} x {self.d.size} x {self.models}"

    @property
    def points(self) -> int:
        return self.delta.size * self.d.size * self.models

    @property
    def nbytes(self) -> int:
        """alpha, beta, frequency and two codes a point."""
        return self.points * 32
