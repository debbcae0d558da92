"""Runs: a configuration in, a folder of stores, tables, figures and texts out, and the report of it."""

from zwidth.runs.run import ProgressCallback, RunResult, StudyEvent, StudyResult, plan_run, run

__all__ = ["ProgressCallback", "RunResult", "StudyEvent", "StudyResult", "plan_run", "run"]
