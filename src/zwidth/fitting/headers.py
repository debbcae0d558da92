"""Columns of logs by their headers: the time, the position and the force, and their units.

Headers are compared as a whole first, then word by word: ``tau_cmd_mNm`` is a torque in mN m, ``__time`` a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from zwidth.words.errors import InputError
from zwidth.words.formatting import suggestion
from zwidth.words.units import ANGLE, COUNTS, FORCE, LENGTH, TIME, TORQUE, Dimension, split_head, split_title

QUANTITIES = ("time", "position", "force")
# Units of each quantity, those of a linear axis first.
DIMENSIONS: dict[str, tuple[Dimension, ...]] = {"time": (TIME,), "position": (LENGTH, ANGLE), "force": (FORCE, TORQUE)}
# Whole headers, in lower case.
_NAMES = {
    "time": ("time", "t", "clock", "timestamp", "stamp", "zeit"),
    "position": ("position", "pos", "x", "encoder", "angle", "phi", "theta", "q"),
    "force": ("force", "f", "torque", "tau"),
}
# Words of headers, and ends of words as in German compounds.
_WORDS = {
    "time": (*_NAMES["time"], "millis", "micros", "nanos", "elapsed", "uhrzeit"),
    "position": ("position", "pos", "encoder", "enc", "angle", "phi", "theta", "winkel", "weg"),
    "force": ("force", "torque", "tau", "effort", "kraft", "moment"),
}
_ENDINGS = ("moment", "kraft", "winkel", "position")
# A commanded force is the one wanted; a commanded position is not the one measured.
_COMMANDED = ("cmd", "command", "commanded", "des", "desired", "ref", "reference", "target", "setpoint", "soll", "goal")
_MEASURED = ("meas", "measured", "actual", "sensed", "sensor", "est", "estimated", "ist")
_DERIVED = ("error", "err", "vel", "velocity", "speed", "dot", "acc", "rate", "temp")
# Words that say that an axis turns.
_TURNS = ("angle", "phi", "theta", "winkel", "torque", "tau", "moment", "drehmoment", "sollmoment")
_MOVES = ("force", "f", "kraft", "sollkraft", "weg")
# Columns read in place of a position or a force without one, and their unit if the header has none.
_INSTEAD = {
    "position": (("velocity", "vel", "speed"), "m/s"),
    "force": (("current", "iq", "i_q"), "A"),
}
# Headers that are units in words.
_UNIT_WORDS = {"millis": "ms", "micros": "us", "nanos": "ns", "secs": "s", "seconds": "s"}
# The second column of a time in two.
_PARTS: dict[str, str] = dict.fromkeys(("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds", "ns"), "ns")
_PARTS |= dict.fromkeys(("usec", "usecs", "microsec", "microseconds", "us"), "us")
_WHOLE = ("sec", "secs", "seconds", "s")


class Column(NamedTuple):
    """Where a quantity stands in a table."""

    places: tuple[int, ...]  # one column; two of a time in seconds and parts of a second
    units: tuple[str, ...]  # of each, "" without one
    turns: bool | None  # whether the name is that of an angle or a torque, or of a force; None of any axis
    guessed: bool = False  # whether only a word of the header says which quantity it is
    header_unit: str = ""  # the unit in the header, if another one is asked for


def find_columns(
    file: object, heads: Sequence[str], asked: Mapping[str, str | None], wanted: Sequence[str]
) -> dict[str, Column]:
    """Return the columns asked for or found by their names; raise one `InputError` for all that are missing."""
    found: dict[str, Column] = {}
    missing, several = [], []
    for name in wanted:
        text = asked.get(name)
        if text is not None:
            found[name] = _find_asked(file, heads, name, text)
            continue
        column, places = _find_by_name(heads, name)
        if column is not None:
            found[name] = column
        elif places:
            several.append(f"{name}: may be any of {list_heads(heads[k] for k in places)} in {file}; name the column")
        else:
            missing.append(name)
    if missing:
        _refuse_missing(file, heads, missing)
    if several:
        raise InputError(several[0])
    return found


def _refuse_missing(file: object, heads: Sequence[str], missing: list[str]) -> None:
    names = " and ".join((", ".join(missing[:-1]), missing[-1])) if len(missing) > 1 else missing[0]
    if "frequency" in {split_head(head)[0].lower() for head in heads}:
        raise InputError(f"{file}: a table of a response is a device: zwidth ridge --device {file}")
    which = f"{missing[0]}: " if len(missing) == 1 else ""
    remedy = ", ".join(f"{name} 'COLUMN:unit'" for name in missing)
    raise InputError(f"{which}no column for {names} recognized in {file} among {list_heads(heads)}; give {remedy}")


def _find_by_name(heads: Sequence[str], name: str) -> tuple[Column | None, list[int]]:
    """Return the column of a quantity, or None and the columns that may be it."""
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
        places = [k for k, (title, _) in enumerate(titles) if title.lower() in others]
        if len(places) != 1:
            return None, places
        return Column((places[0],), (titles[places[0]][1] or usual,), None), []
    best = min(ranks)
    if len(ranks[best]) > 1:
        return None, ranks[best]
    (k,) = ranks[best]
    title, unit = titles[k]
    words = _split_words(title)
    unit = unit or next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), "")
    return Column((k,), (unit or (heads[k].strip() if best == _UNIT_ONLY else ""),), _is_turning(words), best > 0), []


_UNIT_ONLY = 3


def _rank(name: str, head: str, title: str) -> int | None:
    """Return 0 for a whole header, 1 and 2 for words of it, 3 for a unit alone; None for another quantity."""
    if title.lower().strip("_") in _NAMES[name]:
        return 0
    words = _split_words(title)
    excluded = {"position": (*_COMMANDED, *_DERIVED), "force": (*_MEASURED, *_DERIVED), "time": ()}[name]
    if set(words) & set(excluded):
        return None
    core = [word for word in words if word not in (*_COMMANDED, *_MEASURED)]
    if len(core) == 1 < len(words) and core[0] in _NAMES[name]:
        return 1
    if any(
        word in _WORDS[name] or (name != "time" and word.endswith(_ENDINGS) and _ends(name, word)) for word in words
    ):
        preferred = {"force": _COMMANDED, "position": _MEASURED, "time": ()}[name]
        return 1 if set(words) & set(preferred) or any(word.startswith("soll") for word in words) else 2
    bare = head.strip()
    if name == "position" and bare.lower() in COUNTS:
        return _UNIT_ONLY
    if (len(bare) > 1 or bare == "N") and any(each.in_base("1", 0, bare) is not None for each in DIMENSIONS[name]):
        return _UNIT_ONLY
    return None


def _ends(name: str, word: str) -> bool:
    ends = {"position": ("winkel", "position"), "force": ("moment", "kraft")}[name]
    return word.endswith(ends)


def _split_words(title: str) -> list[str]:
    """Return the words of a header in lower case, without numbers at their ends."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", title)
    return [re.sub(r"[0-9]+$", "", word).lower() for word in re.split(r"[\W_]+", spaced) if word]


def _is_turning(words: Sequence[str]) -> bool | None:
    """Return whether words of a header are of a rotary axis, or of a linear one; None if they say neither."""
    if any(word in _TURNS for word in words):
        return True
    return False if any(word in _MOVES for word in words) else None


def _find_parts(heads: Sequence[str]) -> Column | None:
    """Return a time in two columns, seconds and the rest in nanoseconds or microseconds; None without one."""
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
    """Return the column that is asked for, as "NAME", "NAME:unit", or of a time "NAME:s+NAME:ns"."""
    title = wanted.strip()
    if name == "time" and "+" in title and not _matches(heads, title):
        parts = [_find_asked(file, heads, name, part) for part in title.split("+")]
        units = tuple(unit for part in parts for unit in part.units)
        return Column(tuple(place for part in parts for place in part.places), units, None)
    unit = None
    found = _matches(heads, title)
    if not found:
        title, _, unit = (part.strip() for part in wanted.rpartition(":"))
        found = _matches(heads, title)
    if len(found) != 1:
        title = title or wanted.strip()
        if found:
            raise InputError(f"{name}: {file} has {len(found)} columns {title!r}; give each a name of its own")
        known = [*heads, *(split_head(head)[0] for head in heads)]
        hint = suggestion(title, known, f"it has {list_heads(heads)}")
        raise InputError(f"{name}: {file} has no column {title!r}; {hint}")
    (k,) = found
    words, own = _split_words(split_head(heads[k])[0]), split_head(heads[k])[1]
    unit_word = next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), "") if name == "time" else ""
    if unit is not None:
        return Column((k,), (unit,), _is_turning(words), header_unit=own)
    return Column((k,), (own or unit_word,), _is_turning(words))


def _matches(heads: Sequence[str], title: str) -> list[int]:
    """Return the columns of this header; else those of this name before the brackets or the unit."""
    whole = [k for k, head in enumerate(heads) if head == title]
    whole = whole or [k for k, head in enumerate(heads) if title and split_head(head)[0] == title]
    return whole or [k for k, head in enumerate(heads) if title and split_title(head)[0] == title]


def list_heads(heads: Iterable[str]) -> str:
    """Return the first headers, between quotes."""
    names = [repr(head) for head in heads if head]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
