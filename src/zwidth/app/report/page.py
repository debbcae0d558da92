"""Write the report of a run: an HTML page with its results, methods, package versions and configuration.

The page has one *section* per study. Each output of a sweep over two or more parameters is shown as an interactive
*map*: a color image over two parameters, the *axes*, with a slider for every other parameter. A *slice* is the part of
the output at one setting of all sliders. The page contains the values of the maps, encoded in single precision, and
draws them with the script ``report.js``. The *record* of a run is the content of its file ``run.json``, with one
*entry* per study (`runs.record`).
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex

from zwidth.config.study import KINDS
from zwidth.core.errors import StoreError
from zwidth.core.status import Status
from zwidth.io.files import write_atomically
from zwidth.plotting.color_scale import ColorScale, choose_scale
from zwidth.plotting.grid import choose_axes, in_order
from zwidth.plotting.plane import Edges
from zwidth.plotting.style import pick_evenly, save, style_sheet, units, write_unit
from zwidth.plotting.table import is_of_rotary
from zwidth.runs.draw import list_figures, make_edges
from zwidth.runs.record import CONFIG_FILE, INPUTS, RUN_FILE, Record, hash_file
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import SUFFIX, Store
from zwidth.units.formatting import format_interval
from zwidth.units.outputs import OUTPUTS, STATUS_OF
from zwidth.units.quantities import VARIABLES
from zwidth.units.unit_system import SYSTEMS

if TYPE_CHECKING:
    import xarray

FILE = "report.html"
_GRAY = "infinite, or no result"  # explanation of gray in the caption of a map
_LINES = " Lines: exact boundary of the stable walls; dashed: of the passive walls."  # sentence of the caption
MAX_ALONG_AXIS = 120  # largest number of values of a map along each of its two axes
MAX_ALONG_SLIDER = 9  # largest number of values of each slider
MAX_VALUES = 120_000  # largest number of values of a map with all its slices, which take half a megabyte
_COLORS = 21  # number of colors of a map; odd, so that they include the center of a diverging colormap


def write_report(folder: str | os.PathLike[str], out: str | os.PathLike[str] | None = None) -> Path:
    """Write the report of a finished run: one HTML file with figures, maps, methods, versions and configuration.

    The file needs no server and no network, which a strict content security policy enforces in the browser.

    Args:
        folder: Folder of the run, with its ``run.json``.
        out: The file; by default ``report.html`` in the folder. An existing file is replaced.

    Returns:
        The path of the file.

    Raises:
        StoreError: The folder contains no run, no study of the run is done, or a file is damaged or missing.

    References:
        West, Barth, Veditz 2016, Content Security Policy Level 2 (W3C).

    Example:
        >>> import tempfile, zwidth
        >>> studies = [{"kind": "ridge", "name": "top", "delta": [0, 1], "d": 1}]
        >>> config = {"version": 1, "name": "example", "studies": studies}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = zwidth.run(config, out=folder)
        ...     zwidth.write_report(folder).name
        'report.html'
    """
    where = Path(os.fsdecode(folder))
    record = Record(where)
    if not record.exists:
        raise StoreError(f"{where}: contains no run (no run.json); name a folder written by zwidth run")
    done = [entry for entry in record.content["studies"] if entry.get("state") == "done"]
    if not done and not record.damaged:
        raise StoreError(f"{where}: no study of the run is done; continue it with 'zwidth run CONFIG --resume'")
    _check_files(record, done)
    target = where / FILE if out is None else Path(os.fsdecode(out))
    write_atomically(target, _write_page(where, record.content, done).encode())
    return target


def _check_files(record: Record, done: list[dict[str, Any]]) -> None:
    """Raise `StoreError` if files of the finished studies ``done`` are damaged or missing.

    The content of stores is checked later, when it is read.
    """
    faults = [f"{RUN_FILE} is damaged"] if record.damaged else []
    for entry in () if record.damaged else done:
        faults += record.faults(entry["name"])
        stores = [file for file in entry["files"] if file.endswith(SUFFIX)]
        faults += [f"{store} is missing" for store in stores if not (record.folder / store).is_dir()]
    config, recorded = record.folder / CONFIG_FILE, record.content.get("config_file") == CONFIG_FILE
    if recorded and not record.damaged and hash_file(config) != record.content["config_sha256"]:
        faults.append(f"{CONFIG_FILE} is {'damaged' if config.exists() else 'missing'}")
    if faults:
        raise StoreError(f"{record.folder}: {', '.join(faults)}; create again with 'zwidth run CONFIG --resume'")


def _write_page(where: Path, content: dict[str, Any], done: list[dict[str, Any]]) -> str:
    """Return the HTML page of a run.

    Args:
        where: Folder of the run.
        content: Record of the run.
        done: Entries of the finished studies.
    """
    html, style, script = (
        files("zwidth.app.report").joinpath(f"report.{kind}").read_text(encoding="utf-8")
        for kind in ("html", "css", "js")
    )
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)]
    path = where / CONFIG_FILE
    config = path.read_text(encoding="utf-8") if path.is_file() and not path.is_symlink() else ""
    versions = content["versions"]
    rows = [f'<th scope="row">{escape(name)}</th><td>{escape(str(each))}</td>' for name, each in versions.items()]
    facts = {name: content[name] for name in ("name", "description", "precision", "config_sha256")}
    # Print the start of the run without seconds, in UTC as in the record; the page states the time zone.
    facts["started"] = content["started"][:16].replace("T", " at ")
    # Create an entry for each planned study without one, because an interrupted run did not begin all studies.
    begun = {entry["name"]: entry for entry in content["studies"]}
    planned = [begun.get(name, {"name": name}) for name in content.get("planned", begun)]
    return Template(html).substitute(
        {name: escape(str(each)) for name, each in facts.items()},
        release=escape(str(versions["zwidth"])),
        style=style,
        script=script,
        style_digest=digests[0],
        script_digest=digests[1],
        missing="".join(_write_absence(entry) for entry in planned if entry not in done),
        contents="".join(f'<li><a href="#{escape(each["name"])}">{escape(each["name"])}</a></li>' for each in done),
        sections="".join(_write_section(where, entry) for entry in done),
        inputs=f" Copy the folder <code>{INPUTS}</code> of the run next to it." if content.get("inputs") else "",
        versions=_write_table("Versions", rows),
        config=f'<h3>Configuration</h3><pre tabindex="0">{escape(config)}</pre>' if config else "",
    )


def _write_absence(entry: dict[str, Any]) -> str:
    """Return the paragraph that states that a study is missing on the page, with the reason."""
    reason = f"it failed: {entry['error']}" if entry.get("error") else "it is not finished"
    remedy = "'zwidth run CONFIG --resume' computes it"
    return f"<p><strong>{escape(entry['name'])} is missing</strong> because {escape(reason)}; {remedy}.</p>"


def _write_section(where: Path, entry: dict[str, Any]) -> str:
    """Return the HTML section of a study, from the folder of the run and the entry of the study."""
    kind, name = str(entry["kind"]), escape(str(entry["name"]))
    remarks = [*entry.get("answer", ()), *entry.get("notes", ())]
    notes = f'<div class="notes">{"".join(f"<p>{escape(str(each))}</p>" for each in remarks)}</div>' if remarks else ""
    method = f'<p class="soft">{escape(KINDS[kind].method)}</p>' if kind in KINDS and KINDS[kind].method else ""
    body = "".join(_write_contents(where, entry))
    listed = ", ".join(escape(file) for file in sorted(entry.get("files", {})))
    beside = f'<p class="soft">Files in the folder of the run: {listed}</p>' if listed else ""
    kind, seconds = escape(kind), float(entry.get("seconds", 0.0))
    head = f'<h2 id="{name}">{name} <small class="soft">({kind}, {seconds:.2g} s)</small></h2>'
    return f"<section>{head}{method}{notes}{body}{beside}</section>"


def _write_contents(where: Path, entry: dict[str, Any]) -> Iterator[str]:
    """Yield the figures, tables and maps of a study as HTML."""
    for file in sorted(entry.get("files", {})):
        path = where / file
        if file.endswith(".svg"):
            yield _embed_figure(path, entry["name"])
        elif entry.get("kind") == "published" and file.endswith(".json"):
            yield _write_comparison(json.loads(path.read_text(encoding="utf-8")))
        elif file.endswith(SUFFIX) and path.is_symlink():
            # Do not follow links, because their targets may contain files of other users.
            yield f'<p class="soft">{escape(file)} is a link and is not shown.</p>'
        elif file.endswith(SUFFIX):
            with open_dataset(path) as data:
                if not data.attrs["complete"]:
                    raise StoreError(f"{path}: chunks are missing; 'zwidth run CONFIG --resume' computes them")
                edges = make_edges(Store(path))
                with style_sheet(system=SYSTEMS[is_of_rotary(data)]):
                    shown = [*find_slices(data, edges), *_draw_curves(data, entry["name"])]
                yield "".join(shown) or (
                    '<p class="soft">No output varies over one or two parameters of numbers; zwidth export writes a '
                    "table of the results.</p>"
                )


def _embed_figure(path: Path, study: str) -> str:
    """Return an SVG figure of a study as an HTML figure with an embedded image."""
    data, text = base64.b64encode(path.read_bytes()).decode(), f"Figure {path.stem} of the study {study}"
    image = f'<img alt="{escape(text)}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(path.stem)}</figcaption></figure>"


def _draw_curves(data: xarray.Dataset, study: str) -> Iterator[str]:
    """Yield the outputs of a sweep over one parameter as HTML figures, drawn as by the command `zwidth figures`."""
    data = data.reset_coords(drop=True)
    with TemporaryDirectory() as folder:
        for name, draw in list_figures(data):
            if name in OUTPUTS and len(choose_axes(data, name)) == 1:
                (file,) = save(draw(), Path(folder) / f"{study}_{name}", ("svg",))
                yield _embed_figure(file, study)


_AGREEMENT = {True: "agrees", False: "differs", None: "cited"}


def _format_computed(row: dict[str, Any]) -> str:
    """Return the computed value of a row of the comparison with the paper; the note of the row if it has no value."""
    return escape(row["note"]) if row["computed"] is None else f"{row['computed']:.10g}"


def _write_comparison(content: dict[str, Any]) -> str:
    """Return the HTML table that compares the numbers printed in the paper with computed ones."""
    rows = [
        f"<td>{escape(row['quantity'])}</td><td>{escape(row['where'])}</td><td>{escape(str(row['printed']))}</td>"
        f'<td class="number">{_format_computed(row)}</td><td>{_AGREEMENT[row["agrees"]]}</td>'
        for row in content["published"]
    ]
    head = "".join(f'<th scope="col">{word}</th>' for word in ("quantity", "location", "printed", "computed", ""))
    title = "Printed and computed numbers"
    return f"<h3>{title}</h3>{_write_table(title, rows, f'<thead><tr>{head}</tr></thead>')}"


def _write_table(name: str, rows: list[str], head: str = "") -> str:
    """Return an HTML table that can be scrolled horizontally on narrow pages, by mouse and by keyboard.

    Args:
        name: Accessible name of the table.
        rows: Cells of each row as HTML.
        head: Head of the table as HTML.
    """
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    table = f"<table>{head}<tbody>{body}</tbody></table>"
    return f'<div class="wide" tabindex="0" role="region" aria-label="{name}">{table}</div>'


def find_slices(data: xarray.Dataset, edges: Edges | None = None) -> Iterator[str]:
    """Yield the maps of a sweep as HTML.

    The function ``edges`` computes the exact boundaries of the stable and the passive walls, which are drawn on them.
    """
    data = in_order(data)
    # Use the order of `OUTPUTS`, because the order in which a store lists its variables differs between file systems.
    for name in (name for name in OUTPUTS if name in data and name != "kind"):
        axes = choose_axes(data, name)
        if len(axes) == 2 and "device" not in axes:
            values = data[name]
            if OUTPUTS[name].dtype == "bool":
                # Set the Boolean values of undecided walls to NaN, because False would mean that the walls are
                # unstable.
                values = values.astype(np.float32).where(data[STATUS_OF[OUTPUTS[name].family]] == Status.OK)
            yield _write_map(values, name, (axes[0], axes[1]), edges or (lambda part: {}))


def _write_map(values: xarray.DataArray, name: str, axes: tuple[str, str], edges: Edges) -> str:
    """Return the map of an output as HTML, with a slider per further parameter and the values as JSON.

    Args:
        values: The output over all parameters of the sweep.
        name: Name of the output.
        axes: Horizontal and vertical parameter.
        edges: Function that computes the exact boundaries of one slice.
    """
    x, y = axes
    output = OUTPUTS[name]
    others = [str(dim) for dim in values.dims if dim not in (x, y)]
    slices = max(1, np.prod([min(values.sizes[dim], MAX_ALONG_SLIDER) for dim in others]))
    along = min(MAX_ALONG_AXIS, int(np.sqrt(MAX_VALUES / slices)))
    most = {dim: along if dim in (x, y) else MAX_ALONG_SLIDER for dim in map(str, values.dims)}
    sample = values.isel({dim: pick_evenly(values.sizes[dim], count) for dim, count in most.items()})
    sample = sample.transpose(*others, y, x).load()
    with np.errstate(over="ignore"):
        numbers, sizes = sample.values.astype(np.float32), [sample.sizes[dim] for dim in others]
    scale = choose_scale(output, numbers[np.isfinite(numbers)].astype(float))
    content = {
        "name": name,
        "unit": _format_unit(sample),
        "truth": output.dtype == "bool",
        "scale": "log" if scale.logarithmic else "linear",
        "low": scale.low,
        "high": scale.high,
        "extend": scale.extend,
        "colors": _list_colors(scale.colormap),
        "x": _describe_axis(sample, x),
        "y": _describe_axis(sample, y),
        "others": [_describe_axis(sample, dim) for dim in others],
        "edges": [
            _encode_edges(sample.isel(dict(zip(others, index, strict=True))), x, edges) for index in np.ndindex(*sizes)
        ],
        # Encode values that overflow in single precision as NaN, because they must not be shown as infinite.
        "values": _encode(np.where(np.isfinite(numbers) | np.isinf(sample.values), numbers, np.nan)),
    }
    caption = f"{output.long_name} over {_describe_dim(x)} (horizontal) and {_describe_dim(y)} (vertical)"
    sliders = "".join(
        f'<label>{escape(_describe_dim(dim))}: <span></span><input type="range" min="0" '
        f'max="{sample.sizes[dim] - 1}" value="0"></label>'
        for dim in others
    )
    colors = (
        f"Dark: not {name}; bright: {name}" if output.dtype == "bool" else _explain_colors(scale, _format_unit(sample))
    )
    thinned = "" if sample.size == values.size else f" The map shows {sample.size:,} of {values.size:,} values."
    # Escape "<", because "</script>" in the JSON would end the script element.
    embedded = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<div class="slices"><h3>{escape(name)}</h3><p class="soft">{escape(caption)}. '
        f"{colors}; gray: {'0, ' if scale.logarithmic else ''}{_GRAY}."
        f"{_LINES if any(content['edges']) else ''}{thinned} "
        "Point at the map, or focus it and use the arrow keys, to read a value.</p>"
        f'{sliders}<canvas tabindex="0" role="img" aria-label="{escape(caption)}"></canvas><output aria-live="polite">'
        f'</output><script type="application/json">{embedded}</script></div>'
    )


def _list_colors(colormap: str) -> list[str]:
    """Return evenly spaced colors of a colormap in hexadecimal RGB, between which the script interpolates."""
    return [to_hex(color)[1:] for color in matplotlib.colormaps[colormap](np.linspace(0.0, 1.0, _COLORS))]


def _explain_colors(scale: ColorScale, unit: str) -> str:
    """Return a sentence on the range of the color bar and, if it has arrows at its ends, on their meaning."""
    ends = {
        "neither": "",
        "min": "; lower values: arrow",
        "max": "; higher values: arrow",
        "both": "; values outside: arrows",
    }
    return f"Color bar: {' to '.join(format_interval(scale.low, scale.high))} {unit}".rstrip() + ends[scale.extend]


def _encode_edges(part: xarray.DataArray, x: str, edges: Edges) -> dict[str, list[str]]:
    """Return the exact boundaries of the stable and the passive walls of one slice by name, encoded for the script.

    Args:
        part: Values of the slice.
        x: Horizontal parameter. Points of the boundaries are encoded as pairs (x, y) in the units of the axes.
        edges: Function that computes the boundaries.
    """
    for dim in map(str, part.coords):
        part[dim].attrs.setdefault("factor", 1.0)
    over = slice(None, None, 1 if x in ("alpha", "stiffness") else -1)
    outlines_by_name = edges(part.to_dataset(name="values")).items()
    return {name: [_encode(points[:, over]) for points, _ in outlines] for name, outlines in outlines_by_name}


def _encode(numbers: np.ndarray) -> str:
    """Encode numbers for the script: in single precision, little-endian, as base-64 text."""
    return base64.b64encode(numbers.astype("<f4").tobytes()).decode()


def _describe_axis(values: xarray.DataArray, dim: str) -> dict[str, Any]:
    """Return the name, unit and values of a parameter as JSON for the script."""
    along = values[dim]
    labels = along.dtype.kind not in "biuf"
    steps = [str(label) for label in along.values] if labels else np.asarray(along.values, float).tolist()
    return {"name": _describe_dim(dim), "unit": "" if labels else _format_unit(along), "values": steps}


def _format_unit(values: xarray.DataArray) -> str:
    """Return the unit of a variable as text without TeX."""
    unit = write_unit(str(values.attrs.get("units", "")))
    return unit.replace("$", "")


def _describe_dim(dim: str) -> str:
    """Return the name of a parameter in words, for example "sampling period"."""
    return VARIABLES[dim].words_in(units()) if dim in VARIABLES else dim
