"""Conversion of times from text to seconds: ISO 8601 dates and times, times of day, durations such as "0.001 sec"."""

from __future__ import annotations

import re
from contextlib import suppress

import numpy as np

# Pattern of a time of day, optionally with a date before it, separated by T or a blank, and a time zone after it, as in
# 2024-05-01T12:00:00.001Z.
CLOCK = re.compile(r"(\d{4}-\d\d-\d\d[T ])?(\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)(Z|[+-]\d\d:?\d\d)?")
_DAY = "1970-01-01T"  # date assumed for times of day without a date
_BATCH = 20_000  # largest number of texts that are converted at once, to limit the memory
# Pattern of a duration as MATLAB writes it in timetables: a number and a unit, as in "0.001 sec".
_DURATION = re.compile(r"([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s+(sec|min|hr)")
_SECONDS = {"sec": 1.0, "min": 60.0, "hr": 3600.0}  # seconds per unit of a duration


def read_duration(cell: str) -> str:
    """Convert a duration such as "1 min" to its number of seconds as text, "60.0"; return any other text unchanged."""
    match = _DURATION.fullmatch(cell)
    return cell if match is None else repr(float(match[1]) * _SECONDS[match[2]])


def is_time(text: str) -> bool:
    """Return whether a text is a time of day, with or without a date."""
    with suppress(ValueError):
        return read_clock(np.array([text])).size == 1
    return False


def read_clock(texts: np.ndarray) -> np.ndarray:
    """Convert an array of times of day, with or without dates, to an array of the seconds since its first entry.

    Raises:
        ValueError: a text is not a time, or the time zones differ.
    """
    days, zones = [], set()
    for part in np.array_split(texts, 1 + texts.size // _BATCH):
        matches = [match for text in part.tolist() if (match := CLOCK.fullmatch(text.strip()))]
        zones |= {match[3] for match in matches}
        if len(matches) < part.size or len(zones) > 1:
            raise ValueError("not a time, or a different time zone")
        days.append(np.array([(match[1] or _DAY) + match[2].replace(",", ".") for match in matches], "datetime64[ns]"))
    return to_seconds(np.concatenate(days))


def to_seconds(times: np.ndarray) -> np.ndarray:
    """Convert an array of `numpy.datetime64` to seconds since its first entry; NaT becomes NaN."""
    return (times - times[0]) / np.timedelta64(1, "s") if times.size else times.astype(float)
