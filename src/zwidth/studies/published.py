"""The paper's printed numbers beside the computed ones, which a run adds where it repeats figures of the paper."""

from __future__ import annotations

from zwidth.studies import paper_values as report
from zwidth.studies.outcome import Outcome


def compare_published() -> Outcome:
    """Compare every printed number with the computed one, as text and as JSON."""
    printed, sharpened = report.published_numbers(), report.sharpened_numbers()
    return Outcome(
        documents={
            "published.md": report.as_markdown(printed, sharpened),
            "published.json": report.as_json(printed, sharpened),
        },
        notes=tuple(
            f"{row.quantity}: printed {row.printed}, computed {row.computed:.10g}" for row in printed if not row.agrees
        ),
    )
