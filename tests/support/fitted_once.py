"""Logs and walls that commands, studies and pages fit again and again, fitted once a process: a fit takes seconds."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from zwidth.identification import columns
from zwidth.identification import onset_fit as buzz
from zwidth.identification.device_fit import DeviceFit

_fitted: dict[tuple[str, bytes], DeviceFit] = {}


def _once(fit: Callable[..., DeviceFit]) -> Callable[..., DeviceFit]:
    """A fit whose answers are kept: it gives the same one to the same numbers, and nobody can change it."""

    @wraps(fit)
    def fit_once(*given: Any, **options: Any) -> DeviceFit:
        key = fit.__name__, pickle.dumps((given, sorted(options.items())))
        if key not in _fitted:
            _fitted[key] = fit(*given, **options)
        return _fitted[key]

    return fit_once


_fit_log, _fit_buzz = _once(columns.fit_log), _once(buzz.fit_buzz)


@contextmanager
def fitting_once() -> Iterator[None]:
    """Meanwhile, commands and studies fit equal logs and walls once.

    `zwidth.fit_log` fits whenever it is asked, and so does a `fit_buzz` that was imported before.
    """
    with patch.object(columns, "fit_log", _fit_log), patch.object(buzz, "fit_buzz", _fit_buzz):
        yield
