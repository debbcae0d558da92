"""What takes longer than a drag: the parts of the page that a worker computes one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Lock
from typing import Any

import numpy as np

from zwidth.pages.explorer import model
from zwidth.pages.words import check_lines, list_slopes
from zwidth.parts.device import Device
from zwidth.scenes.assessment import assess, limits_of
from zwidth.scenes.scene import Scene

# Held while JAX is being imported: what looks for it meanwhile would find half of it.
IMPORTING = Lock()

# What a part of the page shows: the columns of a source, or a text, by name.
Update = dict[str, Any]


def compute_details(
    scene: Scene, across: model.Range, up: model.Range, *, normalized: bool, outline: bool, contact: bool, costly: bool
) -> Iterator[Update]:
    """The parts in the order in which they are wanted; whoever asks may stop after each.

    Args:
        scene: the scene with its wall.
        across: the range of stiffness that is shown, for contours.
        up: that of damping.
        normalized: whether its units are those of m = 1 and T = 1.
        outline: whether what hangs on the device is wanted, for it has changed.
        contact: whether a hit of the wall is.
        costly: whether what takes seconds in a scene with parts is.
    """
    quick = scene.loop.outline() is not None
    # The page shows millimeters.
    length = 1.0 if normalized else 1e3
    if outline and not quick:
        yield {**show_outlines(model.outlines(scene)), "islands": model.name_islands(scene)}
    verdict = assess(scene)
    own = model.normalized_lines(verdict) if normalized else None
    lines = own or check_lines(scene, verdict, [])
    word = model.word_of(verdict)
    captions = {"poles_words": model.caption_poles(scene.poles(), word), **model.caption_curves(verdict, normalized)}
    time, position = model.step_motion(scene, model.length_of(scene, verdict))
    curves = {
        **model.open_loop(scene, verdict),
        "step": {"x": time, "y": position * length},
        "best": {"x": [verdict.stiffness_max], "y": [verdict.virtual_damping_at_max]},
    }
    yield {"word": word, "verdict": "\n".join(lines), **captions, **curves}
    if outline:
        x, y = model.passive_set(scene) or (np.empty(0), np.empty(0))
        yield {"passive": {"x": x, "y": y}, "contours": model.contours(scene, across, up)}
    if not own:
        yield {"verdict": "\n".join(check_lines(scene, verdict, limits_of(scene)))}
    if contact or (costly and not quick):
        with IMPORTING:
            import jax  # noqa: F401
    # Of a linear system no damping is known that could grow, and no place to hit the wall from.
    bodies = isinstance(scene.device, Device)
    if quick or costly:
        x, y = model.ridge_path(scene) if bodies else (np.empty(0), np.empty(0))
        yield {"ridge": {"x": x, "y": y}}
        yield {"slopes": "\n".join([] if normalized else [slope.line() for slope in list_slopes(scene)])}
    if contact and not bodies:
        empty = {"x": [], "position": [], "force": []}
        yield {"contact": empty, "contact_words": "(a linear system has no body that comes with a velocity)"}
    elif contact:
        time, position, force, text = model.contact_motion(scene, 2 * model.length_of(scene, verdict))
        position = position * length
        yield {"contact": {"x": time, "position": position, "force": force}, "contact_words": text}


def show_outlines(outlines: list[model.Curve]) -> Update:
    """All outlines, closed, as one line and as one area: what lies within two of them is a hole."""
    xs, ys = ([np.append(outline[axis], outline[axis][:1]) for outline in outlines] for axis in (0, 1))
    x, y = (np.concatenate([np.append(ring, np.nan) for ring in rings] or [np.empty(0)]) for rings in (xs, ys))
    return {"area": {"xs": [[xs]], "ys": [[ys]]}, "edge": {"x": x, "y": y}}
