"""Figures of the explorer page and their updates: receive messages of the browser, and send data and texts.

The explorer (`zwidth explore`) is a browser page with sliders for the parameters of a scene. A `Page` belongs to one
browser tab. Its script (assets/page.js) writes each change as a JSON message into the Bokeh data source ``inputs``; the
page replies through the data source ``answer``, and Bokeh transfers the columns of the figures.

A change has fast and slow results. While a slider moves, the page computes stable region, poles and verdict at once.
When the slider rests, a worker thread computes the other results (`model.compute_details`). Each change increases
``generation``; results of an older generation are discarded.
"""

from __future__ import annotations

import csv
import io
import json
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DoubleTap, PressUp, Tap
from bokeh.models import BasicTickFormatter, ColumnDataSource, DataRange1d, Span
from bokeh.plotting import figure

from zwidth.analysis.scene import Scene
from zwidth.app.explorer import model
from zwidth.app.explorer.controls import Controls, read_link, to_link, to_python, to_yaml
from zwidth.app.explorer.model import IMPORTING, Update, compute_details, show_outlines
from zwidth.app.printing import spell_radius
from zwidth.core.errors import ZwidthError
from zwidth.model.wall import VirtualWall
from zwidth.plotting import style

_LONGEST_MESSAGE = 16_000  # characters; a message contains some dozen numbers, or an address
# Properties of a glyph whose value, unless it is "center", is the name of a column of the data source.
_FROM_SOURCE = ("x", "y", "xs", "ys", "text", "angle", "text_align")
# Data sources of slow results that depend only on the device. If the device changes, they are emptied immediately.
_OF_DEVICE = ("contours", "passive", "ridge", "best")
# Roles of colors in the figures, followed by the colors of these roles on light and on dark pages.
_INKS = ("paper", "ink", "faint", "edge", "passive", "ridge")
_LIGHT = dict(zip(_INKS, ("#FFFFFF", style.BLACK, "#565656", style.BLUE, "#00735A", style.VERMILION), strict=True))
_DARK = dict(zip(_INKS, ("#1E2328", "#F2F2F2", "#A6A6A6", style.SKY, "#2FC79C", style.ORANGE), strict=True))
# Names of the curves in CSV files that differ from the names of their data sources.
_NAMES = {"edge": "stable", "ridge": "stiffest as b grows", "best": "stiffest", "wall": "your wall", "bode": "L"}
_NAMES |= {"nyquist": "L", "crossover": "|L| = 1", "turned": "phase -180 degrees"}
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 361)


class Page:
    """Page in one browser tab: controls, figures, and the computations in progress."""

    def __init__(self, document: Document, controls: Controls, executor: Executor) -> None:
        self.document, self.controls, self.executor = document, controls, executor
        self.start, self.generation, self.serial = controls, 0, 0
        self.dark: bool | None = None
        self.device: tuple[Any, ...] = ()
        self.drawn = False
        self.contact = False
        self.sources: dict[str, ColumnDataSource] = {}
        self.inputs = ColumnDataSource({"json": []}, name="inputs")
        self.answer = ColumnDataSource({"json": []}, name="answer")
        self.inputs.on_change("data", lambda _, __, data: self.receive(data))
        self.inks: list[tuple[Any, str, str]] = []
        # The curves of each figure: name of the data source, column of the horizontal axis, column of the vertical
        # axis.
        self.curves: dict[figure, list[tuple[str, str, str]]] = {}
        self.frame: tuple[model.Range, model.Range] | None = None
        self.plots = {
            "plane": self._draw_plane(),
            "poles": self._draw_poles(),
            "nyquist": self._draw_nyquist(),
            "gain": self._draw_bode("gain", 0.0),
            "phase": self._draw_bode("phase", -180.0),
            "step": self._draw_motion("step", "y"),
            "contact": self._draw_motion("contact", "position"),
            "force": self._draw_motion("contact", "force"),
        }
        self.plots["plane"].tags = [self.inputs, self.answer]
        # Handle three events of a click, because Bokeh reports a second click within 0.3 s and a long click separately.
        for click in (Tap, DoubleTap, PressUp):
            self.plots["plane"].on_event(click, self._tap)
        for axis in (self.plots["plane"].x_range, self.plots["plane"].y_range):
            for end in ("start", "end"):
                axis.on_change(end, lambda attr, old, new: self._point_at_wall())
        # Freeze the document, because Bokeh would otherwise search it for all its models after each added figure.
        with document.models.freeze():
            for name, plot in self.plots.items():
                plot.name = name
                document.add_root(plot)
        self._paint()

    def _new(self, height: int, **keywords: Any) -> figure:
        """Return an empty figure in the style of the page."""
        tools = "pan,wheel_zoom,box_zoom,reset"
        plot = figure(height=height, sizing_mode="stretch_width", tools=tools, output_backend="canvas", **keywords)
        plot.toolbar.logo, plot.toolbar.autohide, plot.toolbar.active_drag = None, True, None  # pyright: ignore
        plot.outline_line_color = None  # pyright: ignore
        for axis in plot.axis:
            # Set the tick labels so that small numbers such as 0.001 have no exponent.
            if isinstance(axis.formatter, BasicTickFormatter):
                axis.formatter.power_limit_low = -6
        self.inks += [(plot, "background_fill_color", "paper"), (plot, "border_fill_color", "paper")]
        return plot

    def _add(self, plot: figure, glyph: str, source: str, color: str, *, parts: str = "line", **keywords: Any) -> Any:
        """Add a glyph whose colors follow the light or dark theme, and return its renderer."""
        data = self.sources.setdefault(source, ColumnDataSource(name=f"{source} data"))
        for name in (name for name in _FROM_SOURCE if keywords.get(name, "center") != "center"):
            data.add([], keywords[name])
        drawn = getattr(plot, glyph)(source=data, **keywords)
        self.inks += [(drawn.glyph, f"{part}_color", color) for part in parts.split()]
        if glyph in ("line", "scatter") and source != "away":
            self.curves.setdefault(plot, []).append((source, keywords["x"], keywords["y"]))
        return drawn

    def _draw_plane(self) -> figure:
        """Return the chart of walls: stable and passive region, contours, ridge, and the wall of the user."""
        plot = self._new(460, x_range=(0, 1), y_range=(0, 1))
        # Fill areas with low opacity, so that the lines remain visible.
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
        # Add the arrow to a wall outside the chart, and the labels of islands.
        arrow = {"marker": "triangle", "angle": "angle", "size": 15, "parts": "line fill"}
        self._add(plot, "scatter", "away", "ink", x="x", y="y", **arrow)
        words = {"x": "x", "y": "y", "text": "text", "parts": "text"}
        beside = {"text_align": "align", "y_offset": 12, "text_baseline": "top", "text_font_size": "12px"}
        self._add(plot, "text", "away", "ink", **words, **beside)
        above = {"text_align": "center", "text_baseline": "bottom", "y_offset": -3, "text_font_size": "12px"}
        self._add(plot, "text", "islands", "edge", **words, **above)
        legend = plot.legend[0]
        legend.update(ncols=2, label_text_font_size="11px", background_fill_alpha=0.0, border_line_color=None)
        legend.update(padding=2, spacing=2, margin=0, glyph_height=16)
        plot.add_layout(legend, "above")
        return plot

    def _draw_circle(self, sources: list[str]) -> figure:
        """Return a figure of the complex plane with the unit circle, whose ranges contain the data of ``sources``."""
        plot = self._new(330, match_aspect=True)
        circle = plot.line(np.cos(_ANGLES), np.sin(_ANGLES), line_width=1.5)
        self.inks.append((circle.glyph, "line_color", "faint"))
        plot.x_range, plot.y_range = (DataRange1d(renderers=[circle]) for _ in "xy")
        plot.tags = sources
        return plot

    def _draw_poles(self) -> figure:
        """Return the figure of the closed-loop poles in the complex plane."""
        plot = self._draw_circle(["poles"])
        poles = self._add(plot, "scatter", "poles", "edge", x="x", y="y", marker="x", size=11, line_width=2.5)
        for axis in (plot.x_range, plot.y_range):
            axis.renderers = [*axis.renderers, poles]  # pyright: ignore[reportAttributeAccessIssue]
        plot.xaxis.axis_label, plot.yaxis.axis_label = "Re z", "Im z"
        return plot

    def _draw_nyquist(self) -> figure:
        """Return the figure of the Nyquist curve with its gain crossover and the critical point -1."""
        plot = self._draw_circle(["crossover"])
        self._add(plot, "line", "nyquist", "edge", x="x", y="y", line_width=2)
        critical = plot.scatter([-1.0], [0.0], marker="cross", size=13, line_width=2.5)
        self.inks.append((critical.glyph, "line_color", "ridge"))
        mark = {"marker": "circle", "size": 11, "fill_color": None, "line_width": 2}
        self._add(plot, "scatter", "crossover", "ink", x="x", y="y", **mark)
        plot.xaxis.axis_label, plot.yaxis.axis_label = "Re L", "Im L"
        return plot

    def _draw_bode(self, column: str, critical: float) -> figure:
        """Return the figure of magnitude or phase of L over frequency, with a line at the value ``critical``."""
        plot = self._new(170, x_axis_type="log")
        self._add(plot, "line", "bode", "edge", x="x", y=column, line_width=2)
        line = Span(location=critical, dimension="width", line_dash=[4, 4], line_width=1.5)
        self.inks.append((line, "line_color", "ridge"))
        plot.add_layout(line)
        mark = {"size": 11, "fill_color": None, "line_width": 2, "x": "hertz"}
        self._add(plot, "scatter", "crossover", "ink", y=column, marker="circle", **mark)
        if column == "gain":
            self._add(plot, "scatter", "turned", "ink", y=column, marker="diamond", **mark)
        return plot

    def _draw_motion(self, source: str, column: str) -> figure:
        """Return the figure of a motion: one column of the data source ``source`` over time."""
        plot = self._new(220)
        self._add(plot, "line", source, "edge", x="x", y=column, line_width=2)
        return plot

    def _paint(self) -> None:
        """Set the colors of all figures to those of the light or dark theme."""
        # Leave the background transparent until the browser has reported its theme.
        inks = (_DARK if self.dark else _LIGHT) | ({"paper": None} if self.dark is None else {})
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
        """Set the labels of all axes, which contain the units of the scene."""
        units = self.controls.scene.unit_system
        spring, damper = units["N/m"], units["N s/m"]
        hertz, time, walls = "frequency in Hz", "time in s", (f"stiffness K in {spring}", f"damping B in {damper}")
        deflection = "angle" if units.rotary else "position"
        place, step = (f"{deflection} in m{units[unit]}" for unit in ("m", "m/N"))
        force = f"wall {'torque' if units.rotary else 'force'} in {units['N']}"
        if self.controls.normalized:
            hertz, time, walls = "cycles per period", "time in periods", ("alpha", "beta")
            place, step, force = "position", "position", "wall force"
        names = {
            "plane": walls,
            "gain": (hertz, "|L| in dB"),
            "phase": (hertz, "phase in degrees"),
            "step": (time, step),
            "contact": (time, place),
            "force": (time, force),
        }
        for name, (x, y) in names.items():
            self.plots[name].xaxis.axis_label, self.plots[name].yaxis.axis_label = x, y

    def receive(self, data: Any) -> None:
        """Process a message from the browser: changed values, end of a drag, theme, or request for a CSV file."""
        try:
            (text,) = data["json"]
            message = json.loads(text) if isinstance(text, str) and len(text) <= _LONGEST_MESSAGE else None
            if not isinstance(message, dict) or not isinstance(message.get("set", {}), dict):
                raise ValueError(text)
        except (ValueError, TypeError, KeyError, RecursionError):
            self.send({"error": "the page sent an invalid message; reload the page"})
            return
        self.serial, figure_name, link = (message.get(name) for name in ("serial", "csv", "open"))
        if figure_name in tuple(self.plots):
            self.send({"csv": self.table(figure_name)})
            return
        if message.get("dark") in (True, False) and message["dark"] != self.dark:
            self.dark = message["dark"]
            self._paint()
        self.contact = bool(message.get("contact", self.contact))
        link = link if isinstance(link, str) else None
        self.update(message.get("set", {}), rest=bool(message.get("rest")), link=link)

    def _tap(self, event: Any) -> None:
        """Set the wall to the position of a click in the chart."""
        names = ("alpha", "beta") if self.controls.normalized else ("stiffness", "virtual_damping")
        place = [float(f"{value:.4g}") if isinstance(value, int | float) else value for value in (event.x, event.y)]
        self.update(dict(zip(names, place, strict=True)), rest=True)

    def update(self, changes: dict[str, Any], *, rest: bool, link: str | None = None) -> None:
        """Show the fast results of changed controls; if the slider rests, start the computation of the slow ones.

        ``link`` is the fragment of the page's address; "" is that of the first visit.
        """
        try:
            with IMPORTING:
                before = self.controls if link is None else read_link(link) if link else self.start
                controls = before.change(changes)
                self._show_at_once(controls, rest)
        except Exception as error:
            self.send({"error": _explain(error), "state": self.controls.shown(), "busy": False})
            return
        # Cancel older computations only after the checks above, because after a refused change their results are still
        # valid.
        self.generation += 1
        if rest:
            assert self.frame is not None, "it has just been shown"
            wanted = {"normalized": controls.normalized, "of_device": not self.drawn, "contact": self.contact}
            self.executor.submit(self._compute, self.generation, controls.scene, *self.frame, **wanted)

    def _show_at_once(self, controls: Controls, rest: bool) -> None:
        """Compute and show the fast results and, if the slider rests, the texts that reproduce the scene."""
        scene = controls.scene
        stable, poles = bool(scene.decide_stability(method="companion").stable), scene.poles()
        device = replace(scene, wall=VirtualWall(0.0)), controls.normalized
        if device != self.device:
            self._fill(show_outlines(scene))
            self.device, self.drawn = device, False
            self._fill({name: {column: [] for column in self.sources[name].data} for name in _OF_DEVICE})
            self.send({"slopes": ""})
        self.controls = controls
        self._name_axes()
        wall = {"x": [controls.wall[0]], "y": [controls.wall[1]]}
        self._fill({"wall": wall, "poles": {"x": np.real(poles), "y": np.imag(poles)}})
        x, y = (np.asarray(self.sources["edge"].data[name], float) for name in "xy")
        frame = model.choose_ranges((x, y), controls.wall)
        if frame != self.frame:
            self.frame = frame
            plane = self.plots["plane"]
            for axis, (low, high) in zip((plane.x_range, plane.y_range), frame, strict=True):
                axis.update(start=low, end=high, reset_start=low, reset_end=high)
        self._point_at_wall()
        word = "stable" if stable else "UNSTABLE"
        texts = {"error": "", "word": word, "radius": spell_radius(np.abs(poles).max()), "busy": True}
        texts |= {"poles_words": model.caption_poles(poles, word.lower()), "state": controls.shown(), "frame": frame}
        recipes = {"yaml": to_yaml, "python": to_python, "link": to_link} if rest else {}
        self.send({**texts, **{name: spell(controls) for name, spell in recipes.items()}})

    def _point_at_wall(self) -> None:
        """Update the arrow that points to a wall outside the visible chart."""
        plane = self.plots["plane"]
        across, up = ((axis.start, axis.end) for axis in (plane.x_range, plane.y_range))  # pyright: ignore
        arrow = model.place_arrow(self.controls.wall, across, up)
        if arrow != self.sources["away"].data:
            self._fill({"away": arrow})

    def table(self, name: str) -> str:
        """Return the points of a figure as CSV text: name of the curve, number of its piece, and coordinates."""
        plot, buffer = self.plots[name], io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(["curve", "piece", plot.xaxis.axis_label, plot.yaxis.axis_label])
        for source, *columns in self.curves[plot]:
            x, y = (np.asarray(self.sources[source].data[column], float) for column in columns)
            finite = np.isfinite(x) & np.isfinite(y)
            # Number the pieces of a curve, which are separated by NaN.
            pieces = 1 + np.cumsum(~finite & np.append(finite[1:], False))
            pieces -= pieces[finite][0] - 1 if finite.any() else 0
            for row in zip(pieces[finite], x[finite], y[finite], strict=True):
                writer.writerow([_NAMES.get(source, source), row[0], *(f"{value:.8g}" for value in row[1:])])
        return buffer.getvalue()

    def _fill(self, update: Update) -> None:
        """Replace the columns of the data sources in ``update``, a dict by the name of the source."""
        for name, columns in update.items():
            self.sources[name].data = columns

    def send(self, texts: dict[str, Any]) -> None:
        """Send texts and numbers to the scripts of the page."""
        self.answer.data = {"json": [json.dumps({"serial": self.serial, **texts})]}

    def _compute(self, generation: int, scene: Scene, *frame: model.Range, **wanted: bool) -> None:
        """Compute the slow results one by one in the worker thread, until a newer change cancels the computation."""
        try:
            for update in compute_details(scene, *frame, **wanted):
                if generation != self.generation:
                    return
                self._schedule_update(generation, update)
            self._schedule_update(generation, {"busy": False})
        except Exception as error:
            # Clear the verdict together with reporting the error, because the verdict belongs to the previous wall.
            self._schedule_update(generation, {"error": _explain(error), "verdict": "", "busy": False})

    def close(self) -> None:
        """Cancel the computation in progress."""
        self.generation += 1

    def _schedule_update(self, generation: int, update: Update) -> None:
        """Schedule an update from the worker for the thread of the document, which alone may change the page."""
        self.document.add_next_tick_callback(lambda: self._apply_update(generation, update))

    def _apply_update(self, generation: int, update: Update) -> None:
        """Show an update, unless a newer change has made it obsolete."""
        if generation != self.generation:
            return
        self._fill({name: columns for name, columns in update.items() if name in self.sources})
        texts = {name: text for name, text in update.items() if name not in self.sources}
        # If the update contains the sensitivities, all curves of the device are drawn, because the sensitivities are
        # computed last.
        self.drawn = self.drawn or "slopes" in update
        if texts:
            self.send(texts)


def _explain(error: Exception) -> str:
    """Return the message that the page shows for an exception of any type, because the page stays open after errors."""
    if isinstance(error, ZwidthError):
        return str(error)
    return f"the computation failed ({type(error).__name__}: {error}); change a number, or reload the page"
