"""How far a question travels: a verdict on one wall passes few functions in few files, so that a reader can follow
it."""

import sys
from collections import Counter
from pathlib import Path

import pytest

import zwidth

PACKAGE = Path(zwidth.__file__).parent
SCENE = zwidth.Scene(zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3))
FILTERED = zwidth.Scene(SCENE.device, SCENE.timing, velocity=zwidth.LowPass(cutoff=100))


def passed(question):
    """The functions of zwidth that a question calls, warm, by file."""
    question()
    files = Counter()

    def note(frame, event, _):
        # Not by the name: the checkout may be called zwidth, too, with all of its environment in it.
        if event == "call" and Path(frame.f_code.co_filename).is_relative_to(PACKAGE):
            files[frame.f_code.co_filename] += 1

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        question()
    finally:
        sys.setprofile(before)
    return files


@pytest.mark.parametrize(
    "question, calls, files",
    [
        (lambda: zwidth.is_stable(0.1, 0.4, 0.1, 1), 40, 5),
        (lambda: SCENE.is_stable(10e3), 80, 8),
        (lambda: SCENE.is_stable(10e3, 40), 80, 8),
        (lambda: FILTERED.is_stable(10e3, 40), 80, 8),
    ],
    ids=["normalized", "spring of a scene", "wall of a scene", "wall behind a filter"],
)
def test_a_verdict_passes_few_functions(question, calls, files):
    found = passed(question)
    assert 0 < found.total() <= calls
    assert 0 < len(found) <= files
