"""Compute the studies of a configuration into a folder of stores, tables, figures and texts, and write reports."""

from zwidth.runs.run import ProgressCallback, RunResult, StudyEvent, StudyResult, plan_run, run

__all__ = ["ProgressCallback", "RunResult", "StudyEvent", "StudyResult", "plan_run", "run"]
