"""Identify the time, position and force columns of a log, and their units, by the headers.

The *quantities* are time, position and force. A header is first compared with the names of a quantity as a whole, then
word by word. For example, ``tau_cmd_mNm`` is identified as a commanded torque in mN m, and ``__time`` as a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from zwidth.core.errors import InputError
from zwidth.units.formatting import suggestion
from zwidth.units.parsing import ANGLE, COUNTS, FORCE, LENGTH, TIME, TORQUE, Dimension, split_head, split_title

QUANTITIES = ("time", "position", "force")
# Dimensions that each quantity may have: first that for a linear axis, then that for a rotary axis.
DIMENSIONS: dict[str, tuple[Dimension, ...]] = {"time": (TIME,), "position": (LENGTH, ANGLE), "force": (FORCE, TORQUE)}
# Names of each quantity in lower case. A header that equals such a name identifies the quantity.
_NAMES = {
    "time": ("time", "t", "clock", "timestamp", "stamp", "zeit"),
    "position": ("position", "pos", "x", "encoder", "angle", "phi", "theta", "q"),
    "force": ("force", "f", "torque", "tau"),
}
# Words in lower case that identify a quantity if they occur in a longer header.
_WORDS = {
    "time": (*_NAMES["time"], "millis", "micros", "nanos", "elapsed", "uhrzeit"),
    "position": ("position", "pos", "encoder", "enc", "angle", "phi", "theta", "winkel", "weg"),
    "force": ("force", "torque", "tau", "effort", "kraft", "moment"),
}
# Endings of compound words that identify a quantity, as in the German "Sollmoment".
_ENDINGS = {"time": (), "position": ("winkel", "position"), "force": ("moment", "kraft")}
# Words for commanded and for measured values. Columns of commanded forces are preferred and those of measured forces
# excluded, because the fit requires the commanded force; for positions, measured ones are preferred.
_COMMANDED = ("cmd", "command", "commanded", "des", "desired", "ref", "reference", "target", "setpoint", "soll", "goal")
_MEASURED = ("meas", "measured", "actual", "sensed", "sensor", "est", "estimated", "ist")
# Words for derivatives, errors and temperatures. A header with such a word identifies neither a position nor a force.
_DERIVED = ("error", "err", "vel", "velocity", "speed", "dot", "acc", "rate", "temp")
# Words of headers that imply a rotary axis, and words that imply a linear axis.
_ROTARY_WORDS = ("angle", "phi", "theta", "winkel", "torque", "tau", "moment", "drehmoment", "sollmoment")
_LINEAR_WORDS = ("force", "f", "kraft", "sollkraft", "weg")
# Names of columns that can replace a missing position (a velocity) or force (a current), and the unit that is assumed
# if the header has none.
_INSTEAD = {
    "position": (("velocity", "vel", "speed"), "m/s"),
    "force": (("current", "iq", "i_q"), "A"),
}
# Words in a header that stand for a unit of time.
_UNIT_WORDS = {"millis": "ms", "micros": "us", "nanos": "ns", "secs": "s", "seconds": "s"}
# A time may be split into two columns: whole seconds and fractions. The header of the column of fractions ends with one
# of these words, each of which implies the unit of the fractions.
_PARTS: dict[str, str] = dict.fromkeys(("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds", "ns"), "ns")
_PARTS |= dict.fromkeys(("usec", "usecs", "microsec", "microseconds", "us"), "us")
# Words with which the header of the column of whole seconds may end.
_WHOLE = ("sec", "secs", "seconds", "s")


class Column(NamedTuple):
    """The column of a table that contains a quantity, or the two columns of a time split into seconds and fractions."""

    indices: tuple[int, ...]  # indices of the column or columns in the table, counted from 0
    units: tuple[str, ...]  # unit of each column, "" if neither the user nor the header specifies one
    is_rotary: bool | None  # axis that the header implies: True for rotary, False for linear, None for neither
    guessed: bool = False  # True if the header is not exactly a name of the quantity, so that the user should check it
    header_unit: str = ""  # unit in the header, if the user specified a unit as well; for a note on the difference


def find_columns(
    file: object, heads: Sequence[str], specified: Mapping[str, str | None], wanted: Sequence[str]
) -> dict[str, Column]:
    """Find the column of each quantity, as specified by the user or else by the headers.

    Args:
        file: path of the table, for messages.
        heads: headers of the table.
        specified: for each quantity the column specified by the user, as "NAME" or "NAME:unit"; None to identify the
            column by the headers.
        wanted: the quantities whose columns are returned.

    Raises:
        InputError: a column is missing or ambiguous. One message lists all missing columns.
    """
    columns: dict[str, Column] = {}
    missing, several = [], []
    for name in wanted:
        text = specified.get(name)
        if text is not None:
            columns[name] = _find_asked(file, heads, name, text)
            continue
        column, indices = _find_by_name(heads, name)
        if column is not None:
            columns[name] = column
        elif indices:
            several.append(
                f"{name}: may be any of the columns {list_heads(heads[k] for k in indices)} in {file}; specify one"
            )
        else:
            missing.append(name)
    if missing:
        _refuse_missing(file, heads, missing)
    if several:
        raise InputError(several[0])
    return columns


def has_column(heads: Sequence[str], name: str) -> bool:
    """Return whether the headers of a table identify at least one column of a quantity."""
    column, indices = _find_by_name(heads, name)
    return column is not None or bool(indices)


def _refuse_missing(file: object, heads: Sequence[str], missing: list[str]) -> None:
    """Raise `InputError` with a message that lists the quantities without a column, the headers and the remedy."""
    names = " and ".join((", ".join(missing[:-1]), missing[-1])) if len(missing) > 1 else missing[0]
    if "frequency" in {split_head(head)[0].lower() for head in heads}:
        raise InputError(
            f"{file}: got a frequency response in place of a log; use it as a device: zwidth ridge --device {file}"
        )
    which = f"{missing[0]}: " if len(missing) == 1 else ""
    remedy = ", ".join(f"{name} 'COLUMN:unit'" for name in missing)
    raise InputError(f"{which}no column for {names} recognized in {file} among {list_heads(heads)}; specify {remedy}")


def _find_by_name(heads: Sequence[str], name: str) -> tuple[Column | None, list[int]]:
    """Identify the column of a quantity by the headers.

    Returns:
        The column and an empty list; or, if the headers do not identify exactly one column, None and the indices of
        all candidates.
    """
    if name == "time" and (pair := _find_parts(heads)) is not None:
        return pair, []
    titles = [split_head(head) for head in heads]
    others, usual = _INSTEAD.get(name, ((), ""))
    ranks: dict[int, list[int]] = {}
    for k, (title, _) in enumerate(titles):
        rank = _rank(name, heads[k], title)
        if rank is not None:
            ranks.setdefault(rank, []).append(k)
    if not ranks:
        indices = [k for k, (title, _) in enumerate(titles) if title.lower() in others]
        if len(indices) != 1:
            return None, indices
        return Column((indices[0],), (titles[indices[0]][1] or usual,), None), []
    best = min(ranks)
    if len(ranks[best]) > 1:
        return None, ranks[best]
    (k,) = ranks[best]
    title, unit = titles[k]
    words = _split_words(title)
    unit = unit or next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), "")
    return Column(
        (k,), (unit or (heads[k].strip() if best == _UNIT_ONLY else ""),), _classify_axis(words), best > 0
    ), []


_UNIT_ONLY = 3  # rank (`_rank`) of a header that consists only of a unit


def _rank(name: str, head: str, title: str) -> int | None:
    """Return a number that measures how well a header names a quantity; 0 is the best.

    Args:
        name: the quantity.
        head: the header.
        title: the header without its unit.

    Returns:
        0 if the title equals a name of the quantity; 1 if it contains such a name, and either a word for the preferred
        kind (commanded force, measured position) or no words but those for commanded or measured values; 2 if it
        contains such a name and other words; 3 if the header is only a unit of the quantity. None otherwise.
    """
    if title.lower().strip("_") in _NAMES[name]:
        return 0
    words = _split_words(title)
    excluded = {"position": (*_COMMANDED, *_DERIVED), "force": (*_MEASURED, *_DERIVED), "time": ()}[name]
    if set(words) & set(excluded):
        return None
    core = [word for word in words if word not in (*_COMMANDED, *_MEASURED)]
    if len(core) == 1 < len(words) and core[0] in _NAMES[name]:
        return 1
    if any(word in _WORDS[name] or word.endswith(_ENDINGS[name]) for word in words):
        preferred = {"force": _COMMANDED, "position": _MEASURED, "time": ()}[name]
        return 1 if set(words) & set(preferred) or any(word.startswith("soll") for word in words) else 2
    bare = head.strip()
    if name == "position" and bare.lower() in COUNTS:
        return _UNIT_ONLY
    if (len(bare) > 1 or bare == "N") and any(each.in_base("1", 0, bare) is not None for each in DIMENSIONS[name]):
        return _UNIT_ONLY
    return None


def _split_words(title: str) -> list[str]:
    """Split a header into its words, in lower case and without trailing digits."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", title)
    return [re.sub(r"[0-9]+$", "", word).lower() for word in re.split(r"[\W_]+", spaced) if word]


def _classify_axis(words: Sequence[str]) -> bool | None:
    """Return True if words of a header imply a rotary axis, False if they imply a linear axis, None otherwise."""
    if any(word in _ROTARY_WORDS for word in words):
        return True
    return False if any(word in _LINEAR_WORDS for word in words) else None


def _find_parts(heads: Sequence[str]) -> Column | None:
    """Find the two columns of a time split into seconds and nanoseconds or microseconds; None if none exist."""
    words = [_split_words(head) for head in heads]
    pairs = [
        (i, j)
        for i, whole in enumerate(words)
        for j, part in enumerate(words)
        if i != j and whole and part and whole[-1] in _WHOLE and part[-1] in _PARTS and whole[:-1] == part[:-1]
    ]
    if len(pairs) != 1:
        return None
    (i, j), *_ = pairs
    return Column((i, j), ("s", _PARTS[words[j][-1]]), None)


def _find_asked(file: object, heads: Sequence[str], name: str, wanted: str) -> Column:
    """Find the column of a quantity that the user specified.

    Args:
        file: path of the table, for messages.
        heads: headers of the table.
        name: the quantity.
        wanted: specification of the column, as "NAME" or "NAME:unit"; for a time in two columns "NAME:s+NAME:ns".

    Raises:
        InputError: no column, or more than one, has this name.
    """
    title = wanted.strip()
    if name == "time" and "+" in title and not _match_title(heads, title):
        parts = [_find_asked(file, heads, name, part) for part in title.split("+")]
        units = tuple(unit for part in parts for unit in part.units)
        return Column(tuple(index for part in parts for index in part.indices), units, None)
    unit = None
    matches = _match_title(heads, title)
    if not matches:
        title, _, unit = (part.strip() for part in wanted.rpartition(":"))
        matches = _match_title(heads, title)
    if len(matches) != 1:
        title = title or wanted.strip()
        if matches:
            raise InputError(f"{name}: {file} has {len(matches)} columns {title!r}; rename them, so that one is left")
        names = [*heads, *(split_head(head)[0] for head in heads)]
        hint = suggestion(title, names, f"it has {list_heads(heads)}")
        raise InputError(f"{name}: {file} has no column {title!r}; {hint}")
    (k,) = matches
    base, header_unit = split_head(heads[k])
    words = _split_words(base)
    unit_word = next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), "") if name == "time" else ""
    if unit is not None:
        return Column((k,), (unit,), _classify_axis(words), header_unit=header_unit)
    return Column((k,), (header_unit or unit_word,), _classify_axis(words))


def _match_title(heads: Sequence[str], title: str) -> list[int]:
    """Return the indices of the headers that equal a title; if none does, of those that equal it without their unit."""
    whole = [k for k, head in enumerate(heads) if head == title]
    whole = whole or [k for k, head in enumerate(heads) if title and split_head(head)[0] == title]
    return whole or [k for k, head in enumerate(heads) if title and split_title(head)[0] == title]


def list_heads(heads: Iterable[str]) -> str:
    """Format the first 12 headers for a message: each in quotes, separated by commas."""
    names = [repr(head) for head in heads if head]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
