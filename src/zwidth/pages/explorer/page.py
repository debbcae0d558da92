"""The figures of the page and what drives them: controls come in as one message, numbers and texts go out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DoubleTap, PressUp, Tap
from bokeh.models import ColumnDataSource, DataRange1d
from bokeh.plotting import figure

from zwidth.figures import style
from zwidth.pages.explorer import model
from zwidth.pages.explorer.controls import Controls, to_python, to_yaml
from zwidth.pages.words import check_lines, list_slopes
from zwidth.parts.wall import VirtualWall
from zwidth.scenes.assessment import Assessment, assess, limits_of
from zwidth.scenes.scene import Scene
from zwidth.words.errors import ZwidthError

# Held while JAX is being imported: what looks for it meanwhile would find half of it.
IMPORTING = Lock()

# What a part of the page shows: the columns of a source, or a text, by name.
Update = dict[str, Any]
# A message holds some dozen numbers.
_LONGEST_MESSAGE = 4000
_POINTS = ("edge", "passive", "ridge", "best", "wall", "poles", "nyquist", "crossover", "step")
_COLUMNS = dict.fromkeys(_POINTS, ("x", "y")) | {
    "area": ("xs", "ys"),
    "contours": ("xs", "ys", "x", "y", "text"),
    "contact": ("x", "position", "force"),
}
# What hangs on the device and takes its time: another device's is taken away at once.
_OF_DEVICE = ("contours", "passive", "ridge", "best")
# Ink, edge, passive, ridge and the rest on a light page and on a dark one.
_LIGHT = {"ink": style.BLACK, "faint": "#565656", "edge": style.BLUE, "passive": "#00735A", "ridge": style.VERMILION}
_DARK = {"ink": "#F2F2F2", "faint": "#A6A6A6", "edge": style.SKY, "passive": "#2FC79C", "ridge": style.ORANGE}
_TURN = np.linspace(0.0, 2.0 * np.pi, 361)


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
        yield show_outlines(model.outlines(scene))
    verdict = assess(scene)
    own = model.normalized_lines(verdict) if wish.normalized else None
    lines = own or check_lines(scene, verdict, [])
    yield {"word": model.word_of(verdict), "verdict": "\n".join(lines), **_wall_curves(wish, verdict)}
    if wish.outline:
        passive = model.passive_set(scene)
        x, y = passive if passive is not None else (np.empty(0), np.empty(0))
        yield {"passive": {"x": x, "y": y}, "contours": model.contours(scene, wish.across, wish.up)}
    if not own:
        yield {"verdict": "\n".join(check_lines(scene, verdict, limits_of(scene)))}
    if wish.contact or (wish.costly and not quick):
        with IMPORTING:
            import jax  # noqa: F401
    if quick or wish.costly:
        x, y = model.ridge_path(scene)
        yield {"ridge": {"x": x, "y": y}}
        yield {"slopes": "\n".join([] if wish.normalized else [slope.line() for slope in list_slopes(scene)])}
    if wish.contact:
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
    curve, cross = model.nyquist_curve(scene), model.crossover(scene, verdict)
    time, position = model.step_motion(scene, model.length_of(scene, verdict))
    best = verdict.stiffness_max, verdict.virtual_damping_at_max
    return {
        "nyquist": {"x": np.real(curve), "y": np.imag(curve)},
        "crossover": {"x": [cross.real], "y": [cross.imag]},
        "step": {"x": time, "y": position * _length(wish)},
        "best": {"x": [best[0]], "y": [best[1]]},
    }


class Page:
    """One open page."""

    def __init__(self, document: Document, controls: Controls, executor: Executor) -> None:
        self.document, self.controls, self.executor = document, controls, executor
        self.generation, self.serial, self.dark = 0, 0, False
        self.device: tuple[Any, ...] = ()
        self.drawn = False
        self.options = {"contact": False, "costly": False}
        self.sources = {
            name: ColumnDataSource({column: [] for column in columns}, name=f"{name} data")
            for name, columns in _COLUMNS.items()
        }
        self.inputs = ColumnDataSource({"json": []}, name="inputs")
        self.answer = ColumnDataSource({"json": []}, name="answer")
        self.inputs.on_change("data", lambda _, __, data: self.receive(data))
        self.inks: list[tuple[Any, str, str]] = []
        self.frame: tuple[model.Range, model.Range] | None = None
        self.plots = {
            "plane": self._draw_plane(),
            "poles": self._draw_poles(),
            "nyquist": self._draw_nyquist(),
            "step": self._draw_motion("step", "y"),
            "contact": self._draw_motion("contact", "position"),
            "force": self._draw_motion("contact", "force"),
        }
        self.plots["plane"].tags = [self.inputs, self.answer]
        # A click within 0.3 s of the last one, wherever that was, and a slow one have names of their own.
        for click in (Tap, DoubleTap, PressUp):
            self.plots["plane"].on_event(click, self._tap)
        for name, plot in self.plots.items():
            plot.name = name
            document.add_root(plot)
        self._paint()

    def _new(self, height: int, **keywords: Any) -> figure:
        tools = "pan,wheel_zoom,box_zoom,reset"
        plot = figure(height=height, sizing_mode="stretch_width", tools=tools, output_backend="canvas", **keywords)
        plot.toolbar.logo, plot.toolbar.autohide, plot.toolbar.active_drag = None, True, None  # pyright: ignore
        plot.background_fill_color = plot.border_fill_color = None  # pyright: ignore
        plot.outline_line_color = None  # pyright: ignore
        return plot

    def _add(self, plot: figure, glyph: str, source: str, color: str, *, parts: str = "line", **keywords: Any) -> Any:
        """A glyph whose colors follow the light."""
        drawn = getattr(plot, glyph)(source=self.sources.get(source) or ColumnDataSource(), **keywords)
        self.inks += [(drawn.glyph, f"{part}_color", color) for part in parts.split()]
        return drawn

    def _draw_plane(self) -> figure:
        plot = self._new(460, x_range=(0, 1), y_range=(0, 1))
        # Lines alone carry the meaning; what is filled is pale.
        area = {"line_color": None, "fill_alpha": 0.13}
        self._add(plot, "multi_polygons", "area", "edge", parts="fill", xs="xs", ys="ys", legend_label="stable", **area)
        self._add(plot, "multi_line", "contours", "faint", xs="xs", ys="ys", legend_label="spectral radius")
        small = {"text_font_size": "10px", "x_offset": 2, "text_baseline": "bottom"}
        self._add(plot, "text", "contours", "faint", parts="text", x="x", y="y", text="text", **small)
        self._add(plot, "line", "edge", "edge", x="x", y="y", line_width=2.5, legend_label="stable")
        dashed = {"line_width": 2, "line_dash": [8, 3, 2, 3], "legend_label": "passive"}
        self._add(plot, "line", "passive", "passive", x="x", y="y", **dashed)
        dotted = {"line_width": 2, "line_dash": [4, 4], "legend_label": "stiffest as b grows"}
        self._add(plot, "line", "ridge", "ridge", x="x", y="y", **dotted)
        mark = {"x": "x", "y": "y", "fill_color": None, "line_width": 2}
        self._add(plot, "scatter", "best", "ridge", marker="diamond", size=13, legend_label="stiffest", **mark)
        self._add(plot, "scatter", "wall", "ink", marker="circle_cross", size=17, legend_label="your wall", **mark)
        legend = plot.legend[0]
        legend.update(ncols=2, label_text_font_size="11px", background_fill_alpha=0.0, border_line_color=None)
        legend.update(padding=2, spacing=2, margin=0, glyph_height=16)
        plot.add_layout(legend, "above")
        return plot

    def _draw_circle(self, seen: list[str]) -> figure:
        """A plane of complex numbers with the unit circle; the ranges hold what is named."""
        plot = self._new(280, match_aspect=True)
        circle = plot.line(np.cos(_TURN), np.sin(_TURN), line_width=1.5)
        self.inks.append((circle.glyph, "line_color", "faint"))
        plot.x_range, plot.y_range = (DataRange1d(renderers=[circle]) for _ in "xy")
        plot.tags = seen
        return plot

    def _draw_poles(self) -> figure:
        plot = self._draw_circle(["poles"])
        poles = self._add(plot, "scatter", "poles", "edge", x="x", y="y", marker="x", size=11, line_width=2.5)
        for axis in (plot.x_range, plot.y_range):
            axis.renderers = [*axis.renderers, poles]  # pyright: ignore[reportAttributeAccessIssue]
        plot.xaxis.axis_label, plot.yaxis.axis_label = "Re z", "Im z"
        return plot

    def _draw_nyquist(self) -> figure:
        plot = self._draw_circle(["crossover"])
        self._add(plot, "line", "nyquist", "edge", x="x", y="y", line_width=2)
        critical = plot.scatter([-1.0], [0.0], marker="cross", size=13, line_width=2.5)
        self.inks.append((critical.glyph, "line_color", "ridge"))
        mark = {"marker": "circle", "size": 11, "fill_color": None, "line_width": 2}
        self._add(plot, "scatter", "crossover", "ink", x="x", y="y", **mark)
        plot.xaxis.axis_label, plot.yaxis.axis_label = "Re L", "Im L"
        return plot

    def _draw_motion(self, source: str, column: str) -> figure:
        plot = self._new(220)
        self._add(plot, "line", source, "edge", x="x", y=column, line_width=2)
        return plot

    def _paint(self) -> None:
        inks = _DARK if self.dark else _LIGHT
        for glyph, name, ink in self.inks:
            setattr(glyph, name, inks[ink])
        for plot in self.plots.values():
            for axis in plot.axis:
                axis.axis_label_text_color = axis.major_label_text_color = inks["ink"]
                axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = inks["faint"]
                axis.axis_label_text_font_style = "normal"
            plot.grid.grid_line_color, plot.grid.grid_line_alpha = inks["faint"], 0.25
        self.plots["plane"].legend.label_text_color = inks["ink"]

    def _name_axes(self) -> None:
        normalized = self.controls.normalized
        names = {
            "plane": ("alpha", "beta") if normalized else ("stiffness K in N/m", "damping B in N s/m"),
            "step": ("time in periods", "position") if normalized else ("time in s", "position in mm/N"),
            "contact": ("time in periods", "position") if normalized else ("time in s", "position in mm"),
            "force": ("time in periods", "wall force") if normalized else ("time in s", "wall force in N"),
        }
        for name, (x, y) in names.items():
            self.plots[name].xaxis.axis_label, self.plots[name].yaxis.axis_label = x, y

    def receive(self, data: Any) -> None:
        """Take what the page sends: changed values, whether the slider rests, what else is wanted."""
        try:
            (text,) = data["json"]
            message = json.loads(text) if isinstance(text, str) and len(text) <= _LONGEST_MESSAGE else None
            if not isinstance(message, dict) or not isinstance(message.get("set", {}), dict):
                raise ValueError(text)
        except (ValueError, TypeError, KeyError, RecursionError):
            self.tell({"error": "the page sent something that is no message; reload it"})
            return
        self.serial = message.get("serial", 0)
        if message.get("dark") in (True, False) and message["dark"] != self.dark:
            self.dark = message["dark"]
            self._paint()
        for name in self.options:
            self.options[name] = bool(message.get(name, self.options[name]))
        self.update(message.get("set", {}), rest=bool(message.get("rest")))

    def _tap(self, event: Any) -> None:
        names = ("alpha", "beta") if self.controls.normalized else ("stiffness", "virtual_damping")
        place = [float(f"{value:.4g}") if isinstance(value, int | float) else value for value in (event.x, event.y)]
        self.update(dict(zip(names, place, strict=True)), rest=True)

    def update(self, changes: dict[str, Any], *, rest: bool) -> None:
        """Show what follows a drag at once, and have the rest computed where the slider rests."""
        self.generation += 1
        try:
            with IMPORTING:
                controls = self.controls.change(changes)
                self._show_at_once(controls, rest)
        except Exception as error:
            self.tell({"error": _explain(error), "state": self.controls.shown(), "busy": False})
            return
        if rest:
            assert self.frame is not None, "it has just been shown"
            wish = Wish(controls.scene, controls.normalized, *self.frame, outline=not self.drawn, **self.options)
            self.executor.submit(self._compute, self.generation, wish)

    def _show_at_once(self, controls: Controls, rest: bool) -> None:
        scene = controls.scene
        edge = model.quick_edge(scene)
        stable, poles = model.judge_quickly(scene)
        device = replace(scene, wall=VirtualWall(0.0)), controls.normalized
        if device != self.device:
            self.device, self.drawn = device, False
            # What has gaps has no inside; the outlines come when the slider rests.
            moving = {"area": {"xs": [], "ys": []}, "edge": {"x": edge[0], "y": edge[1]}}
            self._fill(show_outlines([edge]) if np.isfinite(edge).all() else moving)
            self._fill({name: {column: [] for column in _COLUMNS[name]} for name in _OF_DEVICE})
            self.tell({"slopes": ""})
        self.controls = controls
        self._name_axes()
        wall = {"x": [controls.wall[0]], "y": [controls.wall[1]]}
        self._fill({"wall": wall, "poles": {"x": np.real(poles), "y": np.imag(poles)}})
        frame = model.frame(edge, controls.wall)
        if frame != self.frame:
            self.frame = frame
            for axis, (low, high) in zip(
                (self.plots["plane"].x_range, self.plots["plane"].y_range), frame, strict=True
            ):
                axis.update(start=low, end=high)
        word = "stable" if stable else "UNSTABLE"
        radius = f"spectral radius {np.abs(poles).max():.6f}"
        recipes = {"yaml": to_yaml(controls), "python": to_python(controls)} if rest else {}
        said = {"error": "", "word": word, "radius": radius, "busy": True, **recipes}
        self.tell({**said, "state": controls.shown(), "frame": frame})

    def _fill(self, update: Update) -> None:
        for name, columns in update.items():
            self.sources[name].data = columns

    def tell(self, texts: dict[str, Any]) -> None:
        """Send texts and numbers that the page writes by itself."""
        self.answer.data = {"json": [json.dumps({"serial": self.serial, **texts})]}

    def _compute(self, generation: int, wish: Wish) -> None:
        """In the worker's thread: compute part by part, unless something newer is wanted."""
        try:
            for update in compute_details(wish):
                if generation != self.generation:
                    return
                self._hand_over(generation, update)
            self._hand_over(generation, {"busy": False})
        except Exception as error:
            self._hand_over(generation, {"error": _explain(error), "busy": False})

    def close(self) -> None:
        self.generation += 1

    def _hand_over(self, generation: int, update: Update) -> None:
        self.document.add_next_tick_callback(lambda: self._take(generation, update))

    def _take(self, generation: int, update: Update) -> None:
        if generation != self.generation:
            return
        self._fill({name: columns for name, columns in update.items() if name in self.sources})
        texts = {name: text for name, text in update.items() if name not in self.sources}
        if "contours" in update:
            self.drawn = True
        if texts:
            self.tell(texts)


def _explain(error: Exception) -> str:
    """What the page says of an error; whatever it is, the page stays."""
    return str(error) if isinstance(error, ZwidthError) else f"{type(error).__name__}: {error}"
