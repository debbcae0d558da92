"""What the page shows of a scene, as plain arrays, part by part; nothing here knows of a browser.

K and B stand for alpha and beta where the scene is normalized (m = 1, T = 1).
"""

from __future__ import annotations

from collections.abc import Iterator
from math import atan2, ceil, floor, inf, isfinite, log10, nan, pi
from threading import Lock
from typing import Any

import numpy as np

from zwidth.loops.linear.passivity import find_unsupported_reason
from zwidth.pages.verdict import write_check
from zwidth.pages.words import list_slopes, pole_words, row, spell_radius, word_of
from zwidth.parts.device import Device
from zwidth.scenes.assessment import Assessment, assess, limits_of, passive_edge, round_margin
from zwidth.scenes.scene import Scene
from zwidth.simulation.ending import describe_ending
from zwidth.words.formatting import plain, round_safely, tell_apart

Curve = tuple[np.ndarray, np.ndarray]
Range = tuple[float, float]
# What a part of the page shows: the columns of a source, or a text, by name.
Update = dict[str, Any]

LEVELS = (0.7, 0.8, 0.9, 0.95, 0.98, 0.99)
# By how many poles a radius takes; so few points that no compiler is asked for (`arrays.evaluate.FEW`).
_GRIDS = ((1, (72, 56)), (12, (48, 40)), (inf, (36, 30)))
_DIRECTIONS, _RIDGE_POINTS, _MOST_DAMPING = 181, 61, 4.0
_SHORTEST, _LONGEST = 30, 3000
_IMPACT, _APPROACH = 0.1, 5.0


def show_outlines(scene: Scene) -> Update:
    """All outlines, closed, as one line and as one area, what lies within two of them being a hole; and islands."""
    pieces = scene.stable_region()
    lines = [piece.stiffness for piece in pieces], [piece.virtual_damping for piece in pieces]
    xs, ys = ([np.append(line, line[:1]) for line in each] for each in lines)
    x, y = (np.concatenate([np.append(ring, np.nan) for ring in rings] or [np.empty(0)]) for rings in (xs, ys))
    return {"area": {"xs": [[xs]], "ys": [[ys]]}, "edge": {"x": x, "y": y}, "islands": name_islands(scene)}


def frame(curve: Curve, wall: tuple[float, float]) -> tuple[Range, Range]:
    """Round axis ranges that hold a curve, and the wall where it is not far beyond it."""
    ranges = []
    for axis in (0, 1):
        values = np.append(curve[axis][np.isfinite(curve[axis])], 0.0)
        low, high, place = float(values.min()), float(values.max()), wall[axis]
        size = (high - low) or abs(place) or 1.0
        step = 10.0 ** floor(log10(size)) / 4.0
        low, high = step * floor(low / step - 0.2), step * ceil(high / step + 0.2)
        if low - 2.0 * size <= place <= high + 2.0 * size:
            # Its mark has room, too.
            low, high = min(low, step * floor(place / step - 0.2)), max(high, step * ceil(place / step + 0.2))
        ranges.append((low, high))
    return ranges[0], ranges[1]


def point_at(wall: tuple[float, float], across: Range, up: Range) -> dict[str, list[Any]]:
    """An arrow at the border of a chart towards a wall that lies beyond it; nothing where the chart holds the wall."""
    sides = [int(value > high) - int(value < low) for value, (low, high) in zip(wall, (across, up), strict=True)]
    if not any(sides):
        return {"x": [], "y": [], "angle": [], "text": [], "align": []}
    ends = [(low + 0.03 * (high - low), high - 0.03 * (high - low)) for low, high in (across, up)]
    place = [min(max(value, low), high) for value, (low, high) in zip(wall, ends, strict=True)]
    # A triangle points upwards before it is turned.
    turn, align = atan2(sides[1], sides[0]) - 0.5 * pi, "left" if place[0] < 0.5 * sum(across) else "right"
    return {"x": [place[0]], "y": [place[1]], "angle": [turn], "text": ["your wall"], "align": [align]}


def name_islands(scene: Scene) -> dict[str, list[Any]]:
    """A name above each island of stable walls, in the order in which the verdict notes them."""
    islands = scene.islands()
    names = [f"island {k}" if len(islands) > 1 else "island" for k, _ in enumerate(islands, start=1)]
    x, y = [0.5 * sum(one.stiffness) for one in islands], [one.virtual_damping[1] for one in islands]
    return {"x": x, "y": y, "text": names}


def open_loop(scene: Scene, verdict: Assessment) -> dict[str, dict[str, Any]]:
    """The open loop L up to half the sampling rate as Nyquist curve and Bode plot, and where margins are taken."""
    cross, turned = verdict.gain_crossover, verdict.phase_crossover
    marked = np.array([cross, turned])
    # Next to a resonance L turns far from a point to the next.
    frequency = np.union1d(np.geomspace(1e-4, 1.0, 600) * 0.5 / scene.timing.period, marked[marked > 0])
    curve, at = scene.frequency_response(frequency=frequency), frequency == cross
    # Between two points a long delay turns by more than half a turn: it is known, and left out meanwhile.
    delayed = 2.0 * np.pi * frequency * scene.timing.delay
    phase = np.unwrap(np.angle(curve * np.exp(1j * delayed))) - delayed
    # At the lowest frequency from -270 to 90 degrees.
    phase = np.degrees(phase - 2.0 * np.pi * np.floor((phase[0] / np.pi + 1.5) / 2.0))
    with np.errstate(divide="ignore"):
        gain = 20.0 * np.log10(np.abs(curve))
    drawn = {"x": np.real(curve), "y": np.imag(curve), "hertz": frequency, "gain": gain, "phase": phase}
    return {
        "nyquist": {"x": np.real(curve), "y": np.imag(curve)},
        "bode": {"x": frequency, "gain": gain, "phase": phase},
        "crossover": {name: column[at] for name, column in drawn.items()},
        "turned": {"hertz": [turned], "gain": [-20.0 * log10(verdict.gain_margin) if turned > 0 else nan]},
    }


def length_of(scene: Scene, verdict: Assessment) -> int:
    """How many periods show the wall's slowest motion: six of its time constants, if that is neither few nor many."""
    periods = 6.0 * abs(verdict.time_constant) / scene.timing.period
    return int(min(max(periods, _SHORTEST), _LONGEST)) if isfinite(periods) else 10 * _SHORTEST


def step_motion(scene: Scene, periods: int) -> Curve:
    """Time and position at the samples under a force of 1 that sets in at 0, with the wall on both sides."""
    return np.arange(periods + 1) * scene.timing.period, scene.state_space().step(periods + 1)


def passive_set(scene: Scene) -> Curve | None:
    """The edge of the passive walls, None where no condition is known; empty where no wall is passive."""
    if find_unsupported_reason(**vars(scene.device)):
        return None
    return passive_edge(scene, min(_DIRECTIONS, 1 + scene.loop.draws // 5))


def ridge_path(scene: Scene) -> Curve:
    """The stiffest stable wall as the device's damping grows from none to four times what it is."""
    most = _MOST_DAMPING * (float(scene.device.damping) or 0.25 * scene.units.virtual_damping)
    dampings = np.linspace(0.0, most, min(_RIDGE_POINTS, 1 + scene.loop.draws // 25))
    return scene.loop.vary({"damping": dampings}).stiffest()


def contact_motion(scene: Scene, periods: int) -> tuple[Any, Any, Any, str]:
    """Time, position and wall force of the device that hits the wall, and what comes of it in words."""
    # From five periods before the wall at a tenth of a meter a second, or half the way on which damping stops the
    # device; the normalized one at as many units.
    start = -_APPROACH * _IMPACT * scene.timing.period / max(1.0, 2.0 * _APPROACH * float(scene.delta))
    hit = scene.simulate(start_position=start, start_velocity=_IMPACT, contact="unilateral", periods=periods)
    return hit.time, hit.position, hit.wall_force, f"({describe_ending(hit)})"


def contours(scene: Scene, across: Range, up: Range) -> dict[str, list[Any]]:
    """The lines on which the spectral radius is one of the `LEVELS`, and where to write which."""
    from contourpy import contour_generator

    points = next(grid for most, grid in _GRIDS if scene.loop.poles_sought <= most)
    x, y = (np.linspace(*ends, count) for ends, count in zip((across, up), points, strict=True))
    radius = np.asarray(scene.spectral_radius(x, y[:, None]))
    generator = contour_generator(x, y, np.ma.masked_invalid(radius))
    found: dict[str, list[Any]] = {"xs": [], "ys": [], "x": [], "y": [], "text": []}
    for k, level in enumerate(LEVELS):
        lines: Any = generator.lines(level)
        for line in sorted(lines, key=len, reverse=True):
            # Below the ridge, where no other line runs, each nearer to the tip than the last one, so that names part;
            # of several pieces the longest one has the name.
            named = line[np.argmax(line[:, 0] / np.ptp(across) - (2.0 - 0.35 * k) * line[:, 1] / np.ptp(up))]
            text = f"{level:g}" if line is max(lines, key=len) else ""
            # A piece without a name and smaller than two cells of the grid is a speck.
            if not text and all(np.ptp(line, axis=0) < (2.0 * (x[1] - x[0]), 2.0 * (y[1] - y[0]))):
                continue
            for name, value in zip(found, (line[:, 0], line[:, 1], *named, text), strict=True):
                found[name].append(value)
    return found


def caption_poles(poles: np.ndarray, word: str) -> str:
    """Where the poles lie, in words that agree with the verdict's."""
    outside, count = int((np.abs(poles) > 1.0).sum()), poles.size
    if word == "stable":
        return f"Stable: all {count} lie inside the circle."
    if word == "marginal" and np.abs(poles - 1.0).min(initial=np.inf) > 1e-9:
        return f"Marginal: some of the {count} poles lie on the circle, none outside."
    if word == "marginal":
        return f"Marginal: of {count}, one stands on the circle, at z = 1; without stiffness nothing pulls back."
    return f"Unstable: {outside} of {count} outside of the circle." if outside else "Not stable: one on the circle."


def caption_curves(verdict: Assessment, normalized: bool) -> dict[str, str]:
    """What Nyquist curve, Bode plot and step response of a wall show, by the names of their captions."""
    word, hertz, margins = word_of(verdict).capitalize(), "per period" if normalized else "Hz", []
    around = "leave the cross at −1 outside" if verdict.stable else "go around the cross at −1"
    if isfinite(verdict.phase_margin):
        phase = plain(round_margin("phase_margin", verdict, verdict.stable, 3), 3)
        margins.append(f"phase {phase}° at {plain(verdict.gain_crossover)} {hertz} (circle)")
    if verdict.gain_margin > 0 and isfinite(verdict.phase_crossover):
        decibel = plain(round_margin("gain_margin", verdict, verdict.stable, 3, decibel=True), 3)
        margins.append(f"gain {decibel} dB at {plain(verdict.phase_crossover)} {hertz} (diamond)")
    slowest = pole_words(verdict.time_constant, verdict.frequency)
    if normalized and isfinite(verdict.time_constant):
        verb = "decays" if verdict.time_constant >= 0 else "grows"
        slowest = f"{verb} with time constant {plain(abs(verdict.time_constant))} periods"
    curve = "a pole at z = 1" if verdict.marginal else f"curve and mirror image {around}"
    return {
        "nyquist_words": f"{word}: {curve}.",
        "bode_words": f"Margins: {', '.join(margins) or 'none, |L| is never 1 or the wall has no stiffness'}.",
        "step_words": f"Under a constant push from 0 on, in the wall. The slowest motion {slowest}.",
    }


def normalized_lines(verdict: Assessment) -> list[str]:
    """The verdict on a normalized wall, whose units are the period and the mass."""
    span = " to ".join(tell_apart(verdict.virtual_damping_lower, verdict.virtual_damping_upper))
    gain, phase, delay, modulus = (
        plain(round_margin(f"{name}_margin", verdict, verdict.stable)) for name in ("gain", "phase", "delay", "modulus")
    )
    limit, spare, most = (
        plain(round_safely(end, "below"))
        for end in (verdict.stiffness_limit, verdict.passivity_margin, verdict.alpha_max)
    )
    rows = {
        "verdict": f"{word_of(verdict)}, {spell_radius(verdict.spectral_radius)}",
        "stable alpha": f"up to {limit} at this beta",
        "stable beta": f"{span} at this alpha",
        "passive": f"{'yes' if verdict.passive else 'no'}, margin {spare} of delta",
        "stiffest stable wall": f"alpha_max = {most} at beta = {plain(verdict.beta_at_max)}",
        "slowest pole": f"time constant {plain(verdict.time_constant)} periods",
        "margins": f"gain {gain}, phase {phase} degrees, delay {delay} periods, modulus {modulus}",
    }
    return [row(*each) for each in rows.items()]


# Held while JAX is being imported: what looks for it meanwhile would find half of it.
IMPORTING = Lock()


def compute_details(
    scene: Scene, across: Range, up: Range, *, normalized: bool, of_device: bool, contact: bool
) -> Iterator[Update]:
    """What takes longer than a drag, part by part; whoever asks may stop after each."""
    # Contours cover ``across`` and ``up``. Wanted may be what hangs on the device alone, and a hit of the wall.
    # The page shows millimeters.
    length = 1.0 if normalized else 1e3
    verdict = assess(scene)
    own = normalized_lines(verdict) if normalized else None
    text = "\n".join(own) if own else write_check(scene, verdict, None)
    word = word_of(verdict)
    captions = {"poles_words": caption_poles(scene.poles(), word), **caption_curves(verdict, normalized)}
    time, position = step_motion(scene, length_of(scene, verdict))
    curves = {
        **open_loop(scene, verdict),
        "step": {"x": time, "y": position * length},
        "best": {"x": [verdict.stiffness_max], "y": [verdict.virtual_damping_at_max]},
    }
    yield {"word": word, "verdict": text, **captions, **curves}
    if of_device:
        x, y = passive_set(scene) or (np.empty(0), np.empty(0))
        yield {"passive": {"x": x, "y": y}, "contours": contours(scene, across, up)}
    if not own:
        yield {"verdict": write_check(scene, verdict, limits_of(scene))}
    # Of a linear system no damping is known that could grow, and no place to hit the wall from.
    bodies = isinstance(scene.device, Device)
    if of_device:
        x, y = ridge_path(scene) if bodies else (np.empty(0), np.empty(0))
        yield {"ridge": {"x": x, "y": y}}
        yield {"slopes": "\n".join([] if normalized else [slope.line() for slope in list_slopes(scene)])}
    if contact and not bodies:
        empty = {"x": [], "position": [], "force": []}
        yield {"contact": empty, "contact_words": "(a linear system has no body that comes with a velocity)"}
    elif contact:
        with IMPORTING:
            import jax  # noqa: F401
        time, position, force, text = contact_motion(scene, 2 * length_of(scene, verdict))
        position = position * length
        yield {"contact": {"x": time, "position": position, "force": force}, "contact_words": text}
