"""Runs: a configuration in, a folder of tables, figures and texts out.

One kind of study a module; `runner` puts them together.
"""

from zwidth.studies.events import ProgressCallback, RunResult, StudyEvent, StudyResult
from zwidth.studies.runner import run

__all__ = ["ProgressCallback", "RunResult", "StudyEvent", "StudyResult", "run"]
