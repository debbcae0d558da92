"""Fits, wall searches and diagnoses that commands and pages repeat, computed once per process: each takes seconds."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from zwidth.analysis import cautions, diagnosis, recommendation
from zwidth.identification import columns
from zwidth.identification import onset_fit as buzz

_results: dict[tuple[str, bytes], Any] = {}


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that keeps its results: equal arguments have equal, immutable results."""

    @wraps(function)
    def compute_once(*given: Any, **options: Any) -> Any:
        try:
            key = function.__name__, pickle.dumps((given, sorted(options.items())))
        except (pickle.PicklingError, TypeError, AttributeError):
            return function(*given, **options)
        if key not in _results:
            _results[key] = function(*given, **options)
        return _results[key]

    return compute_once


_fit_log, _fit_buzz, _diagnose = _once(columns.fit_log), _once(buzz.fit_buzz), _once(diagnosis.diagnose)
_choose_wall = _once(recommendation.choose_wall)


@contextmanager
def fitting_once() -> Iterator[None]:
    """Make commands and studies fit equal logs and walls, choose equal walls and diagnose them only once.

    `zwidth.fit_log` still fits in each call, and functions that were imported before still compute.
    """
    with (
        patch.object(columns, "fit_log", _fit_log),
        patch.object(buzz, "fit_buzz", _fit_buzz),
        patch.object(diagnosis, "diagnose", _diagnose),
        patch.object(recommendation, "choose_wall", _choose_wall),
        patch.object(cautions, "choose_wall", _choose_wall),
    ):
        yield
