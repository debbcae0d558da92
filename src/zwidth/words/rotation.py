"""Rotary devices: the mathematics of linear ones in other units. This is the one table of them.

What reads and writes units asks `own_unit`, within `use_kind` for the kind of the device in question.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from zwidth.words.errors import InputError

ROTARY = {
    "kg": "kg m^2",
    "N s/m": "N m s/rad",
    "N/m": "N m/rad",
    "N": "N m",
    "m": "rad",
    "m/s": "rad/s",
    "m/N": "rad/(N m)",
    "N/s": "N m/s",
}
"""The SI unit of a linear device, and that of a rotary one in its place."""

_rotary: ContextVar[bool] = ContextVar("rotary", default=False)

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def is_rotary() -> bool:
    """Whether units are now those of a rotary device."""
    return _rotary.get()


def own_unit(unit: str) -> str:
    """The SI unit of the kind of device in question, where that of a linear one is given: also of ``N/m per kg``."""
    if not _rotary.get() or not unit:
        return unit
    return " per ".join(ROTARY.get(part, part) for part in unit.split(" per "))


@contextmanager
def use_kind(rotary: bool) -> Iterator[None]:
    """Read and write the units of rotary devices, or of linear ones, within."""
    token = _rotary.set(bool(rotary))
    try:
        yield
    finally:
        _rotary.reset(token)


def in_own_units(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a function of a scene, its method too, read and write the units of the scene's device.

    The first argument is a scene, several of one kind, or a result that knows its kind.
    """
    if inspect.isgeneratorfunction(function):
        raise TypeError("its units would be those of who asks for the next item")

    @wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with use_kind(find_kind_of(args[0] if args else next(iter(kwargs.values()), None))):
            return function(*args, **kwargs)

    return within


def find_kind_of(owner: Any) -> bool:
    """Whether a scene, several scenes or a result are of a rotary device; what knows no kind has that in question."""
    holds = getattr(getattr(owner, "dtype", None), "hasobject", False)
    several = owner.values() if isinstance(owner, Mapping) else owner.flat if holds else owner
    if isinstance(owner, list | Mapping) or several is not owner:
        kinds = {find_kind_of(each) for each in several}
        if len(kinds) == 2:
            raise InputError("scenes: got rotary devices beside linear ones; ask of those of one kind at a time")
        return kinds.pop() if kinds else is_rotary()
    known = getattr(owner, "in_rotary_units", None)
    if known is None:
        known = getattr(getattr(owner, "device", None), "rotary", None)
    return is_rotary() if known is None else bool(known)


def wrap_methods(kind: type, *, of: type | None = None, but: Collection[str] = ()) -> None:
    """Let every public method of a class, and of those that it is made of, read and write its own units."""
    for name in dir(of or kind):
        method = inspect.getattr_static(of or kind, name)
        if inspect.isfunction(method) and not name.startswith("_") and name not in but:
            setattr(kind, name, in_own_units(method))
