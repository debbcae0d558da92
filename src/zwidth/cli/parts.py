"""Build the parts of a scene from command-line options: estimates, further feedback and other parts.

The *kind* of an estimate or of further feedback, such as "low_pass", selects its class. If no option gives the kind,
the other options imply it. The parameters of a part are dictionaries keyed by field name.
"""

from __future__ import annotations

import re
from dataclasses import MISSING, fields
from typing import Any

import click

from zwidth.core.errors import InputError
from zwidth.model.parameter_paths import WITH_KIND, spell_kind
from zwidth.model.system_forms import parse_system
from zwidth.model.velocity import ESTIMATES, VelocityFilter

FILTER_HELP = (
    "Velocity estimate as a transfer function in z from position to velocity: 'NUM / DEN', such as '1000 -1000 / 1 0', "
    "'zpk: ZEROS / POLES / GAIN' or 'sos: b0 b1 b2 a0 a1 a2; ..'."
)
# Parameters of low-pass and exponential filters that exclude each other; exactly one of them must be given.
_ONE_OF = {"cutoff", "time_constant", "coefficient"}
_KINDS: dict[str, dict[str, Any]] = {"velocity": ESTIMATES, **WITH_KIND}  # classes by name of the part and by kind
_NOUNS = {"velocity": "a velocity estimate", "position": "a position estimate", "feedback": "feedback"}


def name_option(path: str) -> str:
    """Return the name of the option for a parameter, ``--velocity-cutoff`` for ``velocity.cutoff``."""
    return "--" + path.replace(".", "-").replace("_", "-")


def _list_needed(kind: Any) -> list[str]:
    """Return the names of the required fields, those without default value, of ``kind``, the class of a part."""
    return [item.name for item in fields(kind) if item.default is MISSING]


def make_part(name: str, kind: Any, given: dict[str, Any]) -> Any:
    """Return a part of class ``kind`` with the given fields; raise `click.UsageError` if a field is missing."""
    needed = _list_needed(kind)
    for key in needed:
        if key not in given:
            fields_needed = " and ".join(f"a {each}" for each in needed)
            raise click.UsageError(f"a {name} requires {fields_needed}; give {name_option(f'{name}.{key}')}")
    return kind(**given)


def select_part(given: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the parameters of the part ``name`` from the options, as a dict keyed by field name."""
    return {path.rpartition(".")[2]: value for path, value in given.items() if path.startswith(f"{name}.")}


def imply_kind(owner: str, given: dict[str, Any]) -> str:
    """Return the kind of a part, such as "low_pass", that the given parameters imply.

    Args:
        owner: name of the part, "velocity", "position" or "feedback".
        given: parameters keyed by field name, without ``kind``.
    """
    if owner == "feedback":
        return "integral"
    if owner == "position":
        low = {"order", "coded_period"} & set(given)
        return "pll" if "bandwidth" in given else "low_pass" if low else "exponential"
    low = {"cutoff", "time_constant"} & set(given)
    return "windowed_difference" if "samples" in given else "low_pass" if low else "backward_difference"


def make_kind(owner: str, given: dict[str, Any]) -> Any:
    """Return a velocity estimate, position estimate or further feedback with the given parameters.

    Args:
        owner: name of the part, "velocity", "position" or "feedback".
        given: parameters keyed by field name, and optionally ``kind``.
    """
    given = dict(given)
    if owner == "velocity" and "filter" in given:
        text = given.pop("filter")
        if others := sorted(given):
            raise click.UsageError(f"--velocity-filter: got {name_option(f'velocity.{others[0]}')} too; give only one")
        return VelocityFilter(**parse_system("velocity.filter", text, "z"))
    kind = given.pop("kind", None) or imply_kind(owner, given)
    part = _KINDS[owner][kind]
    needed = _list_needed(part)
    if kind in ("low_pass", "exponential") and not _ONE_OF & set(given):
        needed = ["cutoff"]
    noun = _NOUNS[owner]
    for name in needed:
        if name not in given:
            raise click.UsageError(f"{noun} of kind {kind} requires {name_option(f'{owner}.{name}')}")
    for name in sorted(set(given) - set(part.__dataclass_fields__)):
        raise click.UsageError(f"{name_option(f'{owner}.{name}')} does not belong to {noun} of kind {kind}")
    try:
        return part(**given)
    except InputError as error:
        if owner != "position":
            raise
        # Replace "velocity" by "position" at the start of the message. Low-pass filters are velocity estimates, which
        # are also used as position estimates, and their messages name the velocity.
        raise InputError(re.sub("^velocity", owner, str(error))) from None


def change_kind(owner: str, part: Any, given: dict[str, Any]) -> Any:
    """Return a part of a scene file, changed by the parameters that are given as options.

    Args:
        owner: name of the part, "velocity", "position" or "feedback".
        part: the part in the scene file; None if the file does not contain this part.
        given: parameters keyed by field name, and optionally ``kind``. If the part in the file does not have one of
            these parameters, a new part replaces it.
    """
    kept: dict[str, Any] = {}
    if part is not None and "kind" not in given:
        spelled = spell_kind(part, _KINDS[owner])
        # Replace a filter if --feedback-gain is given, because this option is an integral gain. The field ``gain`` of a
        # filter has another meaning: it belongs to the form of zeros, poles and gain.
        names = {item.name for item in fields(part)} - ({"gain"} if spelled["kind"] == "filter" else set())
        kept = spelled if given.keys() <= names else {}
    if given.keys() & _ONE_OF:
        # If an option sets a parameter in `_ONE_OF`, drop those that the file sets, because they exclude each other.
        kept = {name: value for name, value in kept.items() if name not in _ONE_OF}
    return make_kind(owner, {**kept, **given})
