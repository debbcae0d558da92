"""A cache for fits of logs and walls that commands, studies and reports repeat in one process, because a fit
takes seconds.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from zwidth.identification import columns, onset_fit
from zwidth.identification.device_fit import DeviceFit

_fitted: dict[tuple[str, bytes], DeviceFit] = {}


def _once(fit: Callable[..., DeviceFit]) -> Callable[..., DeviceFit]:
    """Cache a fit by its arguments; the results are immutable."""

    @wraps(fit)
    def fit_once(*arguments: Any, **options: Any) -> DeviceFit:
        key = fit.__name__, pickle.dumps((arguments, sorted(options.items())))
        if key not in _fitted:
            _fitted[key] = fit(*arguments, **options)
        return _fitted[key]

    return fit_once


_fit_log, _fit_buzz = _once(columns.fit_log), _once(onset_fit.fit_buzz)


@contextmanager
def fitting_once() -> Iterator[None]:
    """Make commands and studies fit equal logs and walls only once.

    `zwidth.fit_log` and any `fit_buzz` imported before are not cached.
    """
    with patch.object(columns, "fit_log", _fit_log), patch.object(onset_fit, "fit_buzz", _fit_buzz):
        yield
