"""A cache for fits, wall searches and diagnoses that commands, studies and reports repeat in one process, because each
takes seconds.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from zwidth.analysis import cautions, diagnosis, recommendation
from zwidth.identification import columns, onset_fit

_results: dict[tuple[str, bytes], Any] = {}


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Cache a function by its arguments; the results are immutable."""

    @wraps(function)
    def compute_once(*arguments: Any, **options: Any) -> Any:
        try:
            key = function.__name__, pickle.dumps((arguments, sorted(options.items())))
        except (pickle.PicklingError, TypeError, AttributeError):
            return function(*arguments, **options)
        if key not in _results:
            _results[key] = function(*arguments, **options)
        return _results[key]

    return compute_once


_fit_log, _fit_buzz, _diagnose = _once(columns.fit_log), _once(onset_fit.fit_buzz), _once(diagnosis.diagnose)
_choose_wall = _once(recommendation.choose_wall)


@contextmanager
def fitting_once() -> Iterator[None]:
    """Make commands and studies fit equal logs and walls, choose equal walls and diagnose them only once.

    `zwidth.fit_log` and any functions imported before are not cached.
    """
    with (
        patch.object(columns, "fit_log", _fit_log),
        patch.object(onset_fit, "fit_buzz", _fit_buzz),
        patch.object(diagnosis, "diagnose", _diagnose),
        patch.object(recommendation, "choose_wall", _choose_wall),
        patch.object(cautions, "choose_wall", _choose_wall),
    ):
        yield
