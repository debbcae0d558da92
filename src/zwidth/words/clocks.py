"""Times as texts: of a calendar, ISO 8601, of a day, and durations with their unit, as "0.001 sec"."""

from __future__ import annotations

import re
from contextlib import suppress

import numpy as np

# 2024-05-01T12:00:00.001, also with a blank or a time zone; or the time of a day alone.
CLOCK = re.compile(r"(\d{4}-\d\d-\d\d[T ])?(\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)(Z|[+-]\d\d:?\d\d)?")
_DAY = "1970-01-01T"
_BATCH = 20_000  # texts converted together; texts take much memory
# Durations as MATLAB's timetables write them.
_DURATION = re.compile(r"([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s+(sec|min|hr)")
_SECONDS = {"sec": 1.0, "min": 60.0, "hr": 3600.0}


def read_duration(cell: str) -> str:
    """Return the seconds of a duration such as "0.001 sec", as a text; any other cell unchanged."""
    match = _DURATION.fullmatch(cell)
    return cell if match is None else repr(float(match[1]) * _SECONDS[match[2]])


def is_time(text: str) -> bool:
    """Return whether a text is a time of the calendar or of a day."""
    with suppress(ValueError):
        return read_clock(np.array([text])).size == 1
    return False


def read_clock(texts: np.ndarray) -> np.ndarray:
    """Return the seconds since the first of several times; raise `ValueError` if a text is no time."""
    days, zones = [], set()
    for part in np.array_split(texts, 1 + texts.size // _BATCH):
        found = [match for text in part.tolist() if (match := CLOCK.fullmatch(text.strip()))]
        zones |= {match[3] for match in found}
        if len(found) < part.size or len(zones) > 1:
            raise ValueError("no time, or another zone")
        days.append(np.array([(match[1] or _DAY) + match[2].replace(",", ".") for match in found], "datetime64[ns]"))
    return to_seconds(np.concatenate(days))


def to_seconds(times: np.ndarray) -> np.ndarray:
    """Return seconds since the first of `numpy.datetime64`; NaN for no time."""
    return (times - times[0]) / np.timedelta64(1, "s") if times.size else times.astype(float)
