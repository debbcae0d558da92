"""The published study: the paper's printed numbers beside the computed ones."""

from __future__ import annotations

from typing import ClassVar, Literal

from zwidth.config.scenes import AnyScene
from zwidth.studies import paper_values as report
from zwidth.studies.outcome import ComputedStudy, Outcome


class PublishedStudy(ComputedStudy):
    """Every number that the paper prints beside the computed one."""

    what: ClassVar[str] = "a published study"
    from_scene: ClassVar[tuple[str, ...]] = ()

    kind: Literal["published"]

    @property
    def extent(self) -> str:
        return "the numbers of the paper"

    @property
    def points(self) -> int:
        return 100

    @property
    def nbytes(self) -> int:
        return 100_000

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """Compare every printed number with the computed one, as text and as JSON."""
        printed, sharpened = report.published_numbers(), report.sharpened_numbers()
        return Outcome(
            documents={
                f"{self.name}.md": report.as_markdown(printed, sharpened),
                f"{self.name}.json": report.as_json(printed, sharpened),
            },
            notes=tuple(
                f"{row.quantity}: printed {row.printed}, computed {row.computed:.10g}"
                for row in printed
                if not row.agrees
            ),
        )
