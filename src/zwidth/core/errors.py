"""Exceptions and warnings of zwidth. All exceptions are subclasses of `ZwidthError`.

A message names the field, the value received, the allowed values and the remedy.
"""

from __future__ import annotations


class ZwidthError(Exception):
    """Base class of all exceptions that zwidth raises deliberately."""


class InputError(ZwidthError, ValueError):
    """An invalid argument.

    Every public function raises this error if an argument is not a real number, a single number is out of range, shapes
    do not broadcast, or a name is not in the list of allowed names. For an invalid entry of an array, functions return
    NaN at this entry instead.
    """


class UnusableValueError(InputError):
    """An invalid value, raised by functions that do not receive the name of the field; their callers add the name.

    Args:
        received: description of the value, "got ...".
        allowed: allowed values.
        remedy: suggested correction.
    """

    def __init__(self, received: str, allowed: str = "", remedy: str = "") -> None:
        super().__init__(received, allowed, remedy)
        self.parts = received, allowed, remedy

    def __str__(self) -> str:
        return "; ".join(part for part in self.parts if part)


class UnknownArgumentError(InputError, TypeError):
    """A keyword argument that a constructor does not have."""


class ConfigError(ZwidthError, ValueError):
    """An invalid configuration file; the message lists all faults with line and column."""


class StoreExistsError(ZwidthError, FileExistsError):
    """An output folder that already contains a run."""


class StoreError(ZwidthError):
    """An unusable store: damaged, of another configuration, or of another version of zwidth."""


class StoreBusyError(StoreError):
    """An output folder in use by another run."""


class ResourceError(ZwidthError):
    """A computation that needs more memory or disk space than is available."""


class PrecisionWarning(UserWarning):
    """Warning: inside a JAX transformation zwidth computes in float32, because that is JAX's default precision."""


class TracedDelayError(ZwidthError, TypeError):
    """A delay that JAX traces, passed to a function whose array shapes depend on the value of the delay.

    The integer part of the delay determines the number of poles, and thus the shapes of arrays with one entry per pole.
    """


# Common names of quantities that are not names of fields, each with the name of the field that messages suggest
# instead.
SYNONYMS = {
    "weight": "mass",
    "inertia": "mass",
    "frequency": "rate",
    "latency": "delay",
    "dead_time": "delay",
    "bandwidth": "cutoff",
}


def format_install_command(extra: str) -> str:
    """Return the shell command that installs an *extra*, a named group of optional dependencies of zwidth."""
    import sys
    from pathlib import Path

    project = Path(__file__).resolve().parents[3]
    by_script = (project / "scripts" / "setup").is_file() and Path(sys.prefix) == project / ".venv"
    return f"scripts/setup {extra}" if by_script else f"pip install 'zwidth[{extra}]'"


def describe_choice(value: object, allowed: tuple[str, ...], similarity: float = 0.6) -> str:
    """Return the part of a message with the received name, the allowed names, and the most similar of these, if any.

    Args:
        value: the received name.
        allowed: the allowed names.
        similarity: least similarity of a suggested name, from 0 to 1 (`difflib.get_close_matches`).
    """
    import difflib

    synonym = SYNONYMS.get(str(value))
    nearest = (
        [synonym] if synonym in allowed else difflib.get_close_matches(str(value), allowed, n=1, cutoff=similarity)
    )
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    return f"got {value!r}, allowed are {', '.join(repr(name) for name in allowed)}{hint}"


def check_choice(field: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise `InputError` if a value is not one of the allowed names."""
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{field}: {describe_choice(value, allowed)}")
