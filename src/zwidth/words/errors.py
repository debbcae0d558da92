"""Exceptions raised by zwidth, all below one base class.

A message names the field, the value received, what is allowed and the remedy.
"""

from __future__ import annotations


class ZwidthError(Exception):
    """Base class of every error that zwidth raises on purpose."""


class InputError(ZwidthError, ValueError):
    """An argument that cannot be used as given.

    Every public function raises it where an argument is no real number, a single number is beyond its range, shapes do
    not broadcast, or a name is not one of those listed. A bad entry of an array becomes NaN and spoils no other.
    """


class UnusableValueError(InputError):
    """One value that cannot be used: what it is, what is allowed, and the remedy; who raises it knows no field."""

    def __init__(self, what: str, allowed: str = "", remedy: str = "") -> None:
        super().__init__(what, allowed, remedy)
        self.parts = what, allowed, remedy

    def __str__(self) -> str:
        return "; ".join(part for part in self.parts if part)


class ConfigError(ZwidthError, ValueError):
    """A configuration file that cannot be used; the message lists every fault with its place."""


class StoreExistsError(ZwidthError, FileExistsError):
    """An output folder that already holds a run."""


class StoreError(ZwidthError):
    """A store that cannot be used: damaged, of another configuration, or of another version."""


class StoreBusyError(StoreError):
    """A folder of results in which another run computes."""


class ResourceError(ZwidthError):
    """Work that does not fit into the memory or onto the disk there is."""


class PrecisionWarning(UserWarning):
    """A transformation of JAX in which zwidth computes in float32, because JAX's default precision holds there."""


class TracedDelayError(ZwidthError, TypeError):
    """A traced delay where the number of poles, hence an array shape, depends on its value."""


# Common names of quantities, and the names of the corresponding fields.
SYNONYMS = {"weight": "mass", "inertia": "mass", "frequency": "rate", "latency": "delay", "dead_time": "delay"}


def how_to_install(extra: str) -> str:
    """Return the command that installs an optional dependency in the current environment."""
    import sys
    from pathlib import Path

    project = Path(__file__).resolve().parents[3]
    by_script = (project / "scripts" / "setup").is_file() and Path(sys.prefix) == project / ".venv"
    return f"scripts/setup {extra}" if by_script else f"pip install 'zwidth[{extra}]'"


def describe_choice(value: object, allowed: tuple[str, ...]) -> str:
    """Say which values are allowed and which of them looks most like the one received."""
    import difflib

    meant = SYNONYMS.get(str(value))
    nearest = [meant] if meant in allowed else difflib.get_close_matches(str(value), allowed, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    return f"got {value!r}, allowed are {', '.join(repr(name) for name in allowed)}{hint}"


def check_choice(field: str, value: object, allowed: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{field}: {describe_choice(value, allowed)}")
