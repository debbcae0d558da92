"""Runs: a configuration in, a folder of stores, tables, figures and texts out."""

from zwidth.runs.result import ProgressCallback, RunResult, StudyEvent, StudyResult
from zwidth.runs.run import plan_run, run

__all__ = ["ProgressCallback", "RunResult", "StudyEvent", "StudyResult", "plan_run", "run"]
