"""Context manager for temporary values of context variables."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Value = TypeVar("Value")


@contextmanager
def set_temporarily(variable: ContextVar[Value], value: Value) -> Iterator[None]:
    """Set a context variable, and restore its previous value when the ``with`` block ends, normally or by an error."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)
