"""Runs: compute the studies of a configuration into a folder of stores, tables, figures and texts, and report them."""

from zwidth.runs.run import ProgressCallback, RunResult, StudyEvent, StudyResult, plan_run, run

__all__ = ["ProgressCallback", "RunResult", "StudyEvent", "StudyResult", "plan_run", "run"]
