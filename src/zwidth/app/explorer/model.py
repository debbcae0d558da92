"""Data of the explorer page: curves, contours and captions of a scene, as plain arrays and texts.

The explorer (`zwidth explore`) is a browser page with sliders for the parameters of a scene. Its chart of walls shows
stiffness K (horizontal) over virtual damping B (vertical), or alpha and beta of a normalized scene (m = 1, T = 1). The
verdict and the stability boundary come from `zwidth.analysis`; this module computes the remaining curves of the page:

- open loop: Nyquist curve and Bode plot of L(e^(jwT)), with its gain crossover and phase crossover,
- response to a step of the external force, and a hit on the wall (simulated),
- contours of the spectral radius, boundary of the passive walls, and the ridge (stiffest walls for rising damping).

Results are dicts by the name of a data source or of a text of the page (type `Update`). The module does not depend on a
browser or on Bokeh; `page` draws the results.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import atan2, ceil, floor, inf, isfinite, log10, nan, pi
from threading import Lock
from typing import Any

import numpy as np

from zwidth.analysis.assessment import Assessment, assess, limits_of, round_margin, trace_passivity_boundary
from zwidth.analysis.scene import Scene
from zwidth.analysis.walls import allows_negative
from zwidth.app.printing import format_row, list_slopes, name_verdict, spell_decay, spell_radius
from zwidth.app.verdict import write_check
from zwidth.model.device import Device
from zwidth.simulation.behavior import describe_ending
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.units.formatting import format_interval, plain, round_conservatively

Curve = tuple[np.ndarray, np.ndarray]
Range = tuple[float, float]
# Results for the page by name: the columns of a data source, or a text.
Update = dict[str, Any]

LEVELS = (0.7, 0.8, 0.9, 0.95, 0.98, 0.99)  # spectral radii of the contours
# Grids of K and B for the contours: for each largest number of poles, the points in K and in B. The grids are small
# enough for NumPy, because compiling with JAX would take seconds (`numerics.evaluate.FEW`).
_GRIDS = ((1, (72, 56)), (12, (48, 40)), (inf, (36, 30)))
_DIRECTIONS = 181  # points on the boundary of the passive walls
_RIDGE_POINTS = 61  # points on the ridge
_MOST_DAMPING = 4.0  # largest damping on the ridge, relative to the damping of the device
_SHORTEST = 30  # sampling periods; shortest response
_LONGEST = 3000  # sampling periods; longest response
_IMPACT = 0.1  # speed of a hit on the wall, in m/s; for normalized scenes without a unit
_APPROACH = 5.0  # sampling periods of motion before contact


def show_outlines(scene: Scene) -> Update:
    """Return the outlines of the stable region as data of lines, of areas with holes, and of labels of islands."""
    pieces = scene.stable_region()
    lines = [piece.stiffness for piece in pieces], [piece.virtual_damping for piece in pieces]
    xs, ys = ([np.append(line, line[:1]) for line in each] for each in lines)
    x, y = (np.concatenate([np.append(ring, np.nan) for ring in rings] or [np.empty(0)]) for rings in (xs, ys))
    return {"area": {"xs": [[xs]], "ys": [[ys]]}, "edge": {"x": x, "y": y}, "islands": name_islands(scene)}


def choose_ranges(curve: Curve, wall: tuple[float, float]) -> tuple[Range, Range]:
    """Return rounded axis ranges that contain a curve and, unless it is more than two ranges away, the wall."""
    ranges = []
    for axis in (0, 1):
        values = np.append(curve[axis][np.isfinite(curve[axis])], 0.0)
        low, high, value = float(values.min()), float(values.max()), wall[axis]
        size = (high - low) or abs(value) or 1.0
        step = 10.0 ** floor(log10(size)) / 4.0
        low, high = step * floor(low / step - 0.2), step * ceil(high / step + 0.2)
        if low - 2.0 * size <= value <= high + 2.0 * size:
            # Extend the range beyond the wall, because its marker must be visible.
            low, high = min(low, step * floor(value / step - 0.2)), max(high, step * ceil(value / step + 0.2))
        ranges.append((low, high))
    return ranges[0], ranges[1]


def place_arrow(wall: tuple[float, float], across: Range, up: Range) -> dict[str, list[Any]]:
    """Return the data of an arrow at the border of a chart toward a wall outside the chart; empty for a wall inside."""
    sides = [int(value > high) - int(value < low) for value, (low, high) in zip(wall, (across, up), strict=True)]
    if not any(sides):
        return {"x": [], "y": [], "angle": [], "text": [], "align": []}
    ends = [(low + 0.03 * (high - low), high - 0.03 * (high - low)) for low, high in (across, up)]
    place = [min(max(value, low), high) for value, (low, high) in zip(wall, ends, strict=True)]
    # Subtract a right angle from the direction, because Bokeh's triangle points upwards at angle 0.
    turn, align = atan2(sides[1], sides[0]) - 0.5 * pi, "left" if place[0] < 0.5 * sum(across) else "right"
    return {"x": [place[0]], "y": [place[1]], "angle": [turn], "text": ["your wall"], "align": [align]}


def name_islands(scene: Scene) -> dict[str, list[Any]]:
    """Return the data of labels above the islands of stable walls, numbered as in the notes of the verdict."""
    islands = scene.islands()
    names = [f"island {k}" if len(islands) > 1 else "island" for k, _ in enumerate(islands, start=1)]
    x, y = [0.5 * sum(one.stiffness) for one in islands], [one.virtual_damping[1] for one in islands]
    return {"x": x, "y": y, "text": names}


def compute_open_loop(scene: Scene, verdict: Assessment) -> dict[str, dict[str, Any]]:
    """Return L up to the Nyquist frequency as data of Nyquist curve and Bode plot, with both crossovers."""
    gain_crossover, phase_crossover = verdict.gain_crossover, verdict.phase_crossover
    marked = np.array([gain_crossover, phase_crossover])
    # Use a fine grid of frequencies, because the phase of L changes rapidly near a resonance.
    frequency = np.union1d(np.geomspace(1e-4, 1.0, 600) * 0.5 / scene.timing.period, marked[marked > 0])
    curve, crossing = scene.frequency_response(frequency=frequency), frequency == gain_crossover
    # Remove the phase of the delay before unwrapping, because a long delay changes the phase by more than pi between
    # two grid points. Subtract this phase again afterwards.
    delayed = 2.0 * np.pi * frequency * scene.timing.delay
    phase = np.unwrap(np.angle(curve * np.exp(1j * delayed))) - delayed
    # Shift the phase by a multiple of 360 degrees, so that at the lowest frequency it lies between -270 and 90 degrees.
    phase = np.degrees(phase - 2.0 * np.pi * np.floor((phase[0] / np.pi + 1.5) / 2.0))
    with np.errstate(divide="ignore"):
        gain = 20.0 * np.log10(np.abs(curve))
    drawn = {"x": np.real(curve), "y": np.imag(curve), "hertz": frequency, "gain": gain, "phase": phase}
    return {
        "nyquist": {"x": np.real(curve), "y": np.imag(curve)},
        "bode": {"x": frequency, "gain": gain, "phase": phase},
        "crossover": {name: column[crossing] for name, column in drawn.items()},
        "turned": {
            "hertz": [phase_crossover],
            "gain": [-20.0 * log10(verdict.gain_margin) if phase_crossover > 0 else nan],
        },
    }


def count_periods(scene: Scene, verdict: Assessment) -> int:
    """Return the number of sampling periods to simulate: six time constants of the dominant pole, within limits."""
    periods = 6.0 * abs(verdict.time_constant) / scene.timing.period
    return int(min(max(periods, _SHORTEST), _LONGEST)) if isfinite(periods) else 10 * _SHORTEST


def compute_step_response(scene: Scene, periods: int) -> Curve:
    """Return times and positions of the response to a step of the external force of 1, with a bilateral wall."""
    return np.arange(periods + 1) * scene.timing.period, scene.state_space().step(periods + 1)


def find_passive_boundary(scene: Scene) -> Curve | None:
    """Return points on the boundary of the passive walls; None for a device without a passivity condition."""
    if find_obstacle(scene):
        return None
    return trace_passivity_boundary(scene, min(_DIRECTIONS, 1 + scene.loop.draws // 5))


def compute_ridge(scene: Scene) -> Curve:
    """Return the stiffest stable walls as the damping of the device rises from 0 to four times its current value."""
    most = _MOST_DAMPING * (float(scene.device.damping) or 0.25 * scene.units.virtual_damping)
    dampings = np.linspace(0.0, most, min(_RIDGE_POINTS, 1 + scene.loop.draws // 25))
    return scene.loop.vary({"damping": dampings}).stiffest(allows_negative(scene, None))[:2]


def simulate_hit(scene: Scene, periods: int) -> tuple[Any, Any, Any, str]:
    """Return times, positions and wall forces of a simulated hit, and a phrase on its final behavior."""
    # Start the hit at the distance that the device covers in five periods. If damping would stop the device within
    # twice this distance, start at half of its stopping distance.
    start = -_APPROACH * _IMPACT * scene.timing.period / max(1.0, 2.0 * _APPROACH * float(scene.delta))
    hit = scene.simulate(start_position=start, start_velocity=_IMPACT, contact="unilateral", periods=periods)
    return hit.time, hit.position, hit.wall_force, f"({describe_ending(hit)})"


def find_contours(scene: Scene, across: Range, up: Range) -> dict[str, list[Any]]:
    """Return the contours of the spectral radius at `LEVELS`, with the positions and texts of their labels."""
    from contourpy import contour_generator

    points = next(grid for most, grid in _GRIDS if scene.loop.poles_sought <= most)
    x, y = (np.linspace(*ends, count) for ends, count in zip((across, up), points, strict=True))
    radius = np.asarray(scene.spectral_radius(x, y[:, None]))
    generator = contour_generator(x, y, np.ma.masked_invalid(radius))
    columns: dict[str, list[Any]] = {"xs": [], "ys": [], "x": [], "y": [], "text": []}
    for k, level in enumerate(LEVELS):
        lines: Any = generator.lines(level)
        for line in sorted(lines, key=len, reverse=True):
            # Label only the longest contour line of a level, at a point with large K and small B: where K minus a
            # multiple of B is largest, both relative to the ranges of the axes. The multiple decreases with the level,
            # which separates the labels of different levels.
            named = line[np.argmax(line[:, 0] / np.ptp(across) - (2.0 - 0.35 * k) * line[:, 1] / np.ptp(up))]
            text = f"{level:g}" if line is max(lines, key=len) else ""
            # Drop unlabeled lines smaller than two cells of the grid, because the grid does not resolve them.
            if not text and all(np.ptp(line, axis=0) < (2.0 * (x[1] - x[0]), 2.0 * (y[1] - y[0]))):
                continue
            for name, value in zip(columns, (line[:, 0], line[:, 1], *named, text), strict=True):
                columns[name].append(value)
    return columns


def caption_poles(poles: np.ndarray, word: str) -> str:
    """Return the caption of the figure of poles: their numbers inside, on and outside the unit circle."""
    outside, count = int((np.abs(poles) > 1.0).sum()), poles.size
    if word == "stable":
        return f"Stable: all {count} lie inside the circle."
    if word == "marginal" and np.abs(poles - 1.0).min(initial=np.inf) > 1e-9:
        return f"Marginal: some of the {count} poles lie on the circle, none outside."
    if word == "marginal":
        return f"Marginal: one of {count} lies on the circle, at z = 1; no stiffness restores the position."
    return f"Unstable: {outside} of {count} lie outside the circle." if outside else "Not stable: one is on the circle."


def caption_curves(verdict: Assessment, normalized: bool) -> dict[str, str]:
    """Return the captions of Nyquist curve, Bode plot and step response, by their names on the page."""
    word, hertz, margins = name_verdict(verdict).capitalize(), "per period" if normalized else "Hz", []
    around = "do not encircle the cross at −1" if verdict.stable else "encircle the cross at −1"
    if isfinite(verdict.phase_margin):
        phase = plain(round_margin("phase_margin", verdict, verdict.stable, 3), 3)
        margins.append(f"phase {phase}° at {plain(verdict.gain_crossover)} {hertz} (circle)")
    if verdict.gain_margin > 0 and isfinite(verdict.phase_crossover):
        decibel = plain(round_margin("gain_margin", verdict, verdict.stable, 3, decibel=True), 3)
        margins.append(f"gain {decibel} dB at {plain(verdict.phase_crossover)} {hertz} (diamond)")
    slowest = spell_decay(verdict.time_constant, verdict.frequency)
    if normalized and isfinite(verdict.time_constant):
        verb = "decays" if verdict.time_constant >= 0 else "grows"
        slowest = f"{verb} with time constant {plain(abs(verdict.time_constant))} periods"
    curve = "a pole at z = 1" if verdict.marginal else f"curve and mirror image {around}"
    return {
        "nyquist_words": f"{word}: {curve}.",
        "bode_words": f"Margins: {', '.join(margins) or 'none, because |L| is never 1 or the wall has no stiffness'}.",
        "step_words": f"Response in the wall to a constant force that starts at 0. The slowest mode {slowest}.",
    }


def format_normalized_verdict(verdict: Assessment) -> list[str]:
    """Return the printed lines of the verdict on a normalized wall, whose units are sampling period and mass."""
    span = " to ".join(format_interval(verdict.virtual_damping_lower, verdict.virtual_damping_upper))
    gain, phase, delay, modulus = (
        plain(round_margin(f"{name}_margin", verdict, verdict.stable)) for name in ("gain", "phase", "delay", "modulus")
    )
    limit, spare, most = (
        plain(round_conservatively(end, "below"))
        for end in (verdict.stiffness_limit, verdict.passivity_margin, verdict.alpha_max)
    )
    rows = {
        "verdict": f"{name_verdict(verdict)}, {spell_radius(verdict.spectral_radius)}",
        "stable alpha": f"up to {limit} at this beta",
        "stable beta": f"{span} at this alpha",
        "passive": f"{'yes' if verdict.passive else 'no'}, margin {spare} of delta",
        "stiffest stable wall": f"alpha_max = {most} at beta = {plain(verdict.beta_at_max)}",
        "dominant pole": f"time constant {plain(verdict.time_constant)} periods",
        "margins": f"gain {gain}, phase {phase} degrees, delay {delay} periods, modulus {modulus}",
    }
    return [format_row(*each) for each in rows.items()]


# Lock held during the import of JAX, because a thread that imports it at the same time would receive an incomplete
# module.
IMPORTING = Lock()


def compute_details(
    scene: Scene, across: Range, up: Range, *, normalized: bool, of_device: bool, contact: bool
) -> Iterator[Update]:
    """Yield, one after another, the results that are too slow to follow a dragged slider.

    Args:
        scene: scene with its wall.
        across: range of K of the contours.
        up: range of B of the contours.
        normalized: True for a scene with m = 1 and T = 1.
        of_device: True to compute also the curves that do not depend on the wall.
        contact: True to simulate a hit on the wall.
    """
    length = 1.0 if normalized else 1e3  # the page shows millimeters
    verdict = assess(scene)
    normalized_text = format_normalized_verdict(verdict) if normalized else None
    text = "\n".join(normalized_text) if normalized_text else write_check(scene, verdict, None)
    word = name_verdict(verdict)
    captions = {"poles_words": caption_poles(scene.poles(), word), **caption_curves(verdict, normalized)}
    time, position = compute_step_response(scene, count_periods(scene, verdict))
    curves = {
        **compute_open_loop(scene, verdict),
        "step": {"x": time, "y": position * length},
        "best": {"x": [verdict.stiffness_max], "y": [verdict.virtual_damping_at_max]},
    }
    yield {"word": word, "verdict": text, **captions, **curves}
    if of_device:
        x, y = find_passive_boundary(scene) or (np.empty(0), np.empty(0))
        yield {"passive": {"x": x, "y": y}, "contours": find_contours(scene, across, up)}
    if not normalized_text:
        yield {"verdict": write_check(scene, verdict, limits_of(scene))}
    # Omit ridge and hit for a linear system, because it has no damping parameter, which the ridge varies, and no body
    # whose velocity the hit could set.
    bodies = isinstance(scene.device, Device)
    if of_device:
        x, y = compute_ridge(scene) if bodies else (np.empty(0), np.empty(0))
        yield {"ridge": {"x": x, "y": y}}
        yield {"slopes": "\n".join([] if normalized else [slope.line() for slope in list_slopes(scene)])}
    if contact and (not bodies or scene.tool is not None):
        reason = "a hit needs a wall, not a simulated tool" if bodies else "a linear system has no body with a velocity"
        empty = {"x": [], "position": [], "force": []}
        yield {"contact": empty, "contact_words": f"(not available: {reason})"}
    elif contact:
        with IMPORTING:
            import jax  # noqa: F401
        time, position, force, text = simulate_hit(scene, 2 * count_periods(scene, verdict))
        position = position * length
        yield {"contact": {"x": time, "position": position, "force": force}, "contact_words": text}
