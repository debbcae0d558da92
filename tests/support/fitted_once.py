"""A cache for fits, wall searches, labels in the reference grasps and diagnoses, each of which takes up to seconds.

Commands, studies and reports repeat them in one process.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from typing import Any
from unittest.mock import patch

from zwidth.analysis import cautions, diagnosis, recommendation
from zwidth.analysis.scene import Scene
from zwidth.identification import columns, device_fit, onset_fit

_results: dict[tuple[str, bytes], Any] = {}


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Cache a function by its arguments; the results are immutable."""

    @wraps(function)
    def compute_once(*arguments: Any, **options: Any) -> Any:
        try:
            # A copy of a scene has no cached properties, which would make the keys of equal scenes differ.
            values = [replace(value) if isinstance(value, Scene) else value for value in arguments]
            key = function.__name__, pickle.dumps((values, sorted(options.items())))
        except (pickle.PicklingError, TypeError, AttributeError):
            return function(*arguments, **options)
        if key not in _results:
            _results[key] = function(*arguments, **options)
        return _results[key]

    return compute_once


_fit_log, _fit_buzz, _diagnose = _once(columns.fit_log), _once(onset_fit.fit_buzz), _once(diagnosis.diagnose)
_choose_controller, _judge_grasps = _once(recommendation.choose_controller), _once(cautions.judge_grasps)
_find_safe_wall = _once(device_fit.find_safe_wall)


@contextmanager
def fitting_once() -> Iterator[None]:
    """Make commands and studies fit equal logs and walls, and choose, label and diagnose equal walls, only once.

    `zwidth.fit_log` and any functions imported before are not cached.
    """
    with (
        patch.object(columns, "fit_log", _fit_log),
        patch.object(onset_fit, "fit_buzz", _fit_buzz),
        patch.object(diagnosis, "diagnose", _diagnose),
        patch.object(recommendation, "choose_controller", _choose_controller),
        patch.object(cautions, "choose_controller", _choose_controller),
        patch.object(recommendation, "judge_grasps", _judge_grasps),
        patch.object(cautions, "judge_grasps", _judge_grasps),
        patch.object(device_fit, "find_safe_wall", _find_safe_wall),
    ):
        yield
