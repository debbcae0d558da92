"""What takes longer than a drag: the parts of the page that a worker computes one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np

from zwidth.pages.explorer import model
from zwidth.pages.words import check_lines, list_slopes
from zwidth.parts.device import Device
from zwidth.scenes.assessment import Assessment, assess, limits_of
from zwidth.scenes.scene import Scene

# Held while JAX is being imported: what looks for it meanwhile would find half of it.
IMPORTING = Lock()

# What a part of the page shows: the columns of a source, or a text, by name.
Update = dict[str, Any]


@dataclass(frozen=True)
class Wish:
    """What is to be computed."""

    scene: Scene
    normalized: bool
    across: model.Range
    up: model.Range
    outline: bool  # of a device that has changed
    contact: bool
    costly: bool  # what takes seconds in a scene with parts


def compute_details(wish: Wish) -> Iterator[Update]:
    """The parts in the order in which they are wanted; whoever asks may stop after each."""
    scene, quick = wish.scene, wish.scene.loop.outline() is not None
    if wish.outline and not quick:
        yield {**show_outlines(model.outlines(scene)), "islands": model.name_islands(scene)}
    verdict = assess(scene)
    own = model.normalized_lines(verdict) if wish.normalized else None
    lines = own or check_lines(scene, verdict, [])
    word = model.word_of(verdict)
    captions = {
        "poles_words": model.caption_poles(scene.poles(), word),
        **model.caption_curves(verdict, wish.normalized),
    }
    yield {"word": word, "verdict": "\n".join(lines), **captions, **_wall_curves(wish, verdict)}
    if wish.outline:
        passive = model.passive_set(scene)
        x, y = passive if passive is not None else (np.empty(0), np.empty(0))
        yield {"passive": {"x": x, "y": y}, "contours": model.contours(scene, wish.across, wish.up)}
    if not own:
        yield {"verdict": "\n".join(check_lines(scene, verdict, limits_of(scene)))}
    if wish.contact or (wish.costly and not quick):
        with IMPORTING:
            import jax  # noqa: F401
    # Of a linear system no damping is known that could grow, and no place to hit the wall from.
    bodies = isinstance(scene.device, Device)
    if quick or wish.costly:
        x, y = model.ridge_path(scene) if bodies else (np.empty(0), np.empty(0))
        yield {"ridge": {"x": x, "y": y}}
        yield {"slopes": "\n".join([] if wish.normalized else [slope.line() for slope in list_slopes(scene)])}
    if wish.contact and not bodies:
        empty = {"x": [], "position": [], "force": []}
        yield {"contact": empty, "contact_words": "(a linear system has no body that comes with a velocity)"}
    elif wish.contact:
        time, position, force, text = model.contact_motion(scene, 2 * model.length_of(scene, verdict))
        position = position * _length(wish)
        yield {"contact": {"x": time, "position": position, "force": force}, "contact_words": text}


def show_outlines(outlines: list[model.Curve]) -> Update:
    """All outlines, closed, as one line and as one area: what lies within two of them is a hole."""
    xs, ys = ([np.append(outline[axis], outline[axis][:1]) for outline in outlines] for axis in (0, 1))
    x, y = (np.concatenate([np.append(ring, np.nan) for ring in rings] or [np.empty(0)]) for rings in (xs, ys))
    return {"area": {"xs": [[xs]], "ys": [[ys]]}, "edge": {"x": x, "y": y}}


def _length(wish: Wish) -> float:
    """How many of the units of length that the page shows are one of the scene's: it shows millimeters."""
    return 1.0 if wish.normalized else 1e3


def _wall_curves(wish: Wish, verdict: Assessment) -> Update:
    scene = wish.scene
    time, position = model.step_motion(scene, model.length_of(scene, verdict))
    best = verdict.stiffness_max, verdict.virtual_damping_at_max
    return {
        **model.open_loop(scene, verdict),
        "step": {"x": time, "y": position * _length(wish)},
        "best": {"x": [best[0]], "y": [best[1]]},
    }
