"""What is said of a motion's end, beside the same motion simulated 20 times as long.

As a program, ``python tests/properties/test_motion_labels.py COUNT SEED`` prints the labels of so many motions of every
kind, how many of them the longer motion belies, and how many are left unclear.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import random_motions

import zwidth
from zwidth.simulation.result import MotionKind

SEED, PERIODS, LONGER = 7, 2000, 20
# What is at rest moves by so little, as a share of the widest motion; what is steady keeps its width so nearly.
AT_REST, STEADY = 1e-8, 1.5
# The parts of a motion beside the linear loop, by the arguments that they are, and what they are without.
PARTS: dict[str, dict[str, Any]] = {
    "contact": {"contact": "bilateral"},
    "encoder": {"resolution": 0.0},
    "friction": {"coulomb": 0.0, "static": 0.0},
    "limits": {"max_force": np.inf, "max_rate": np.inf},
}


class Kind(NamedTuple):
    """A kind of motion: the kinds of scenes, and the parts that it always and may have."""

    scenes: tuple[str, ...]
    always: tuple[str, ...]
    maybe: tuple[str, ...] = ()


KINDS = {
    "linear": Kind(("rigid",), ()),
    "contact": Kind(("rigid",), ("contact",)),
    "encoder": Kind(("rigid",), ("encoder",)),
    "contact and encoder": Kind(("rigid",), ("contact", "encoder")),
    "limited motor": Kind(("rigid",), ("limits",), ("contact", "encoder")),
    "friction": Kind(("rigid",), ("friction",), ("contact", "encoder", "limits")),
    "parts": Kind(("tip", "motor", "hand", "coupled hand"), (), ("contact", "encoder", "limits")),
    "filters": Kind(("filter",), (), ("contact", "encoder", "limits", "friction")),
}


def has_part(part: str, arguments: dict[str, Any]) -> bool:
    """Whether a motion has the part."""
    return any(arguments[name] != without for name, without in PARTS[part].items())


def draw_motion(kind: Kind, rng: np.random.Generator) -> tuple[Any, dict[str, Any]]:
    """A scene and the arguments of its simulation."""
    while True:
        motion = random_motions.random_motion(str(rng.choice(kind.scenes)), rng)
        arguments = {name: value for name, value in motion.arguments.items() if name != "jitter_samples"}
        for part in PARTS.keys() - {*kind.always, *kind.maybe}:
            arguments |= PARTS[part]
        # No device is without damping, and whom no one pushes does not stay.
        damped = motion.scene.device.damping > 0 and (arguments["push"] > 0 or not has_part("contact", arguments))
        if damped and all(has_part(part, arguments) for part in kind.always):
            arguments |= {"start_position": arguments.pop("position"), "start_velocity": arguments.pop("velocity")}
            return motion.scene, arguments


def simulate(drawn: list[tuple[Any, dict[str, Any]]], periods: int, tail: int) -> list[zwidth.Motion]:
    """Each motion; those of one contact together."""
    told: dict[int, zwidth.Motion] = {}
    for contact in {arguments["contact"] for _, arguments in drawn}:
        those = [k for k, (_, arguments) in enumerate(drawn) if arguments["contact"] == contact]
        columns: dict[str, Any] = {
            name: [drawn[k][1][name] for k in those] for name in drawn[0][1] if name != "contact"
        }
        found = zwidth.simulate(
            [drawn[k][0] for k in those],
            **columns, contact=contact, periods=periods, tail=tail, record=False,
        )  # fmt: skip
        for place, k in enumerate(those):
            told[k] = found.__class__(
                **{name: None if part is None else part[place] for name, part in vars(found).items()}
            )
    return [told[k] for k in range(len(drawn))]


def is_wrong(now: Any, later: Any, arguments: dict[str, Any]) -> bool:
    """Whether the longer motion belies what was said of the shorter one."""
    kind, then = MotionKind(int(now.outcome)), MotionKind(int(later.outcome))
    scale = max(abs(arguments["start_position"]), float(now.penetration), float(now.amplitude))
    still = later.amplitude <= AT_REST * scale
    # A width is known to the steps it is read by.
    blur = 2.0 * arguments["resolution"]
    if kind == MotionKind.REST:
        return not still
    if kind == MotionKind.DECAYING:
        return not (still or later.amplitude < now.amplitude) or then in (MotionKind.GROWING, MotionKind.DIVERGED)
    if kind == MotionKind.RESTLESS:
        return still or then in (MotionKind.REST, MotionKind.DECAYING)
    if kind == MotionKind.GROWING:
        return not later.amplitude > now.amplitude
    if kind == MotionKind.STEADY:
        near = now.amplitude / STEADY - blur <= later.amplitude <= now.amplitude * STEADY + blur
        return not near or then in (MotionKind.REST, MotionKind.DIVERGED)
    return False


class Label(NamedTuple):
    """What was said of a motion, and whether a longer one belies it."""

    kind: str
    label: MotionKind
    wrong: bool
    scene: Any
    arguments: dict[str, Any]
    now: Any
    later: Any


def label_motions(kind: str, count: int, seed: int, periods: int = PERIODS) -> list[Label]:
    """The labels of so many motions of a kind; the longer ones have a tail as long."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    drawn = [draw_motion(KINDS[kind], rng) for _ in range(count)]
    short, long = (simulate(drawn, many * periods, periods // 4) for many in (1, LONGER))
    pairs = zip(drawn, short, long, strict=True)
    return [
        Label(kind, MotionKind(int(now.outcome)), is_wrong(now, later, arguments), scene, arguments, now, later)
        for (scene, arguments), now, later in pairs
    ]


def tabulate(labels: list[Label]) -> Iterator[str]:
    """How many have which label, and how many of these are wrong, in Markdown."""
    names = [kind for kind in MotionKind if any(label.label == kind for label in labels)]
    yield f"| kind | {' | '.join(name.name for name in names)} |"
    yield "|---|" + "--:|" * len(names)
    for kind in (*KINDS, "all"):
        those = [label for label in labels if kind in (label.kind, "all")]
        given, wrong = (Counter(label.label for label in part) for part in (those, [one for one in those if one.wrong]))
        cells = [f"{given[name]}" + (f" ({wrong[name]} wrong)" if wrong[name] else "") for name in names]
        yield f"| {kind} | {' | '.join(cells)} |"


def test_a_longer_motion_belies_no_label():
    labels = [
        label
        for kind in ("linear", "contact and encoder", "friction")
        for label in label_motions(kind, 12, SEED, PERIODS // 4)
    ]
    assert [label for label in labels if label.wrong] == []
    assert not any(label.label == MotionKind.UNCLEAR for label in labels if label.kind == "linear")
    # Half of the walls are unstable: whether one of these with friction ever sticks for good is not shown.
    assert sum(label.label == MotionKind.UNCLEAR for label in labels) <= 0.25 * len(labels)
    assert not any(label.label == MotionKind.UNCLEAR for label in labels if label.kind == "contact and encoder")


if __name__ == "__main__":
    count, seed = map(int, sys.argv[1:3])
    told = []
    for name in sys.argv[3:] or KINDS:
        told += label_motions(name, count, seed)
        print("\n".join(tabulate(told)), flush=True)
    for label in told:
        if label.wrong:
            shown = {name: getattr(part, name) for part in (label.now,) for name in ("amplitude", "trend", "frequency")}
            later = label.later
            print(label.kind, label.label.name, shown, float(later.amplitude), MotionKind(int(later.outcome)).name)
            print("   ", label.scene, label.arguments)
