"""The page of a run: what was computed, how, from what, and how to compute it again."""

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
from zwidth.figures.color_scale import ColorScale, choose_scale
from zwidth.figures.grid import choose_axes, in_order
from zwidth.figures.plane import Edges
from zwidth.figures.style import pick_evenly, save, style_sheet, units, write_unit
from zwidth.figures.table import is_of_rotary
from zwidth.runs.draw import figures_of, make_edges
from zwidth.runs.record import CONFIG_FILE, INPUTS, RUN_FILE, Record, file_hash
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import SUFFIX, Store
from zwidth.words.errors import StoreError
from zwidth.words.files import write_whole
from zwidth.words.formatting import tell_apart
from zwidth.words.quantities import OUTPUTS, STATUS_OF, VARIABLES
from zwidth.words.status import Status
from zwidth.words.unit_system import SYSTEMS

if TYPE_CHECKING:
    import xarray

FILE = "report.html"
_GRAY = "not finite, or not known"
_LINES = " Lines: exact edges of the stable walls, dashed of the passive ones."
# Of each axis of a slice, of each other axis, and numbers a map in all: half a megabyte.
_ALONG, _OTHERS, _MOST = 120, 9, 120_000
_COLORS = 21  # colors of a map; odd, so that they include the center of a diverging colormap


def write_report(folder: str | os.PathLike[str], out: str | os.PathLike[str] | None = None) -> Path:
    """Write a finished run as one HTML file: figures, slices of its maps, methods, versions and configuration.

    It needs no server and asks no network for anything; a strict content security policy says so to the browser.

    Args:
        folder: of the run, with its ``run.json``.
        out: the file; ``report.html`` in the folder where left out. What is there is replaced.

    Returns:
        The file.

    Raises:
        StoreError: the folder holds no run, nothing of it is done, or something of it is damaged or missing.

    References:
        West, Barth, Veditz 2016, Content Security Policy Level 2 (W3C).

    Example:
        >>> import tempfile, zwidth
        >>> studies = [{"kind": "ridge", "name": "top", "delta": [0, 1], "d": 1}]
        >>> config = {"version": 1, "name": "example", "studies": studies}
        >>> with tempfile.TemporaryDirectory() as place:
        ...     _ = zwidth.run(config, out=place)
        ...     zwidth.write_report(place).name
        'report.html'
    """
    where = Path(os.fsdecode(folder))
    record = Record(where)
    if not record.exists:
        raise StoreError(f"{where}: holds no run (no run.json); name the folder that zwidth run has written")
    done = [entry for entry in record.content["studies"] if entry.get("state") == "done"]
    if not done and not record.damaged:
        raise StoreError(f"{where}: no study of the run is done; go on with it by zwidth run CONFIG --resume")
    _check(record, done)
    target = where / FILE if out is None else Path(os.fsdecode(out))
    write_whole(target, _page(where, record.content, done).encode())
    return target


def _check(record: Record, done: list[dict[str, Any]]) -> None:
    """Refuse files that are not what the run has written; stores are checked where they are read."""
    faults = [f"{RUN_FILE} is damaged"] if record.damaged else []
    for entry in () if record.damaged else done:
        faults += record.faults(entry["name"])
        stores = [file for file in entry["files"] if file.endswith(SUFFIX)]
        faults += [f"{store} is missing" for store in stores if not (record.folder / store).is_dir()]
    config, own = record.folder / CONFIG_FILE, record.content.get("config_file") == CONFIG_FILE
    if own and not record.damaged and file_hash(config) != record.content["config_sha256"]:
        faults.append(f"{CONFIG_FILE} is {'damaged' if config.exists() else 'missing'}")
    if faults:
        raise StoreError(f"{record.folder}: {', '.join(faults)}; 'zwidth run CONFIG --resume' makes it again")


def _page(where: Path, content: dict[str, Any], done: list[dict[str, Any]]) -> str:
    html, style, script = (
        files("zwidth.runs.report").joinpath(f"report.{kind}").read_text(encoding="utf-8")
        for kind in ("html", "css", "js")
    )
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)]
    path = where / CONFIG_FILE
    config = path.read_text(encoding="utf-8") if path.is_file() and not path.is_symlink() else ""
    versions = content["versions"]
    rows = [f'<th scope="row">{escape(name)}</th><td>{escape(str(each))}</td>' for name, each in versions.items()]
    told = {name: content[name] for name in ("name", "description", "precision", "config_sha256")}
    # Days and minutes say enough to people; in the record they are in UTC.
    told["started"] = content["started"][:16].replace("T", " at ")
    # A study that an interrupted run never began has no entry.
    begun = {entry["name"]: entry for entry in content["studies"]}
    planned = [begun.get(name, {"name": name}) for name in content.get("planned", begun)]
    return Template(html).substitute(
        {name: escape(str(each)) for name, each in told.items()},
        release=escape(str(versions["zwidth"])),
        style=style,
        script=script,
        style_digest=digests[0],
        script_digest=digests[1],
        missing="".join(_miss(entry) for entry in planned if entry not in done),
        contents="".join(f'<li><a href="#{escape(each["name"])}">{escape(each["name"])}</a></li>' for each in done),
        sections="".join(_section(where, entry) for entry in done),
        beside=f" Beside it goes the folder <code>{INPUTS}</code> of the run." if content.get("inputs") else "",
        versions=_scrolling("Versions", rows),
        config=f'<h3>Configuration</h3><pre tabindex="0">{escape(config)}</pre>' if config else "",
    )


def _miss(entry: dict[str, Any]) -> str:
    """What is said of a study that has no section."""
    why = f"it failed: {entry['error']}" if entry.get("error") else "it is not finished"
    remedy = "'zwidth run CONFIG --resume' computes it"
    return f"<p><strong>{escape(entry['name'])} is not here</strong>, for {escape(why)}; {remedy}.</p>"


def _section(where: Path, entry: dict[str, Any]) -> str:
    kind, name = str(entry["kind"]), escape(str(entry["name"]))
    said = [*entry.get("answer", ()), *entry.get("notes", ())]
    notes = f'<div class="told">{"".join(f"<p>{escape(str(each))}</p>" for each in said)}</div>' if said else ""
    method = f'<p class="soft">{escape(KINDS[kind].method)}</p>' if kind in KINDS and KINDS[kind].method else ""
    body = "".join(_contents(where, entry))
    listed = ", ".join(escape(file) for file in sorted(entry.get("files", {})))
    beside = f'<p class="soft">Files beside this report: {listed}</p>' if listed else ""
    kind, seconds = escape(kind), float(entry.get("seconds", 0.0))
    head = f'<h2 id="{name}">{name} <small class="soft">({kind}, {seconds:.2g} s)</small></h2>'
    return f"<section>{head}{method}{notes}{body}{beside}</section>"


def _contents(where: Path, entry: dict[str, Any]) -> Iterator[str]:
    for file in sorted(entry.get("files", {})):
        path = where / file
        if file.endswith(".svg"):
            yield _show_figure(path, entry["name"])
        elif entry.get("kind") == "published" and file.endswith(".json"):
            yield _published(json.loads(path.read_text(encoding="utf-8")))
        elif file.endswith(SUFFIX) and path.is_symlink():
            # Stores are not read through links: what one leads to may be anybody's.
            yield f'<p class="soft">{escape(file)} is a link, and not shown.</p>'
        elif file.endswith(SUFFIX):
            with open_dataset(path) as data:
                if not data.attrs["complete"]:
                    raise StoreError(f"{path}: chunks are missing; 'zwidth run CONFIG --resume' computes them")
                edges = make_edges(Store(path))
                with style_sheet(system=SYSTEMS[is_of_rotary(data)]):
                    shown = [*find_slices(data, edges), *_draw_curves(data, entry["name"])]
                yield "".join(shown) or (
                    '<p class="soft">It holds no plane of numbers and no curve; zwidth export writes its table.</p>'
                )


def _show_figure(path: Path, study: str) -> str:
    data, text = base64.b64encode(path.read_bytes()).decode(), f"Figure {path.stem} of the study {study}"
    image = f'<img alt="{escape(text)}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(path.stem)}</figcaption></figure>"


def _draw_curves(data: xarray.Dataset, study: str) -> Iterator[str]:
    """What a sweep has over one parameter, as `zwidth figures` draws it."""
    data = data.reset_coords(drop=True)
    with TemporaryDirectory() as place:
        for name, draw in figures_of(data):
            if name in OUTPUTS and len(choose_axes(data, name)) == 1:
                (file,) = save(draw(), Path(place) / f"{study}_{name}", ("svg",))
                yield _show_figure(file, study)


_AGREEMENT = {True: "agrees", False: "differs", None: "cited"}


def _computed(row: dict[str, Any]) -> str:
    return escape(row["note"]) if row["computed"] is None else f"{row['computed']:.10g}"


def _published(content: dict[str, Any]) -> str:
    rows = [
        f"<td>{escape(row['quantity'])}</td><td>{escape(row['where'])}</td><td>{escape(str(row['printed']))}</td>"
        f'<td class="number">{_computed(row)}</td><td>{_AGREEMENT[row["agrees"]]}</td>'
        for row in content["published"]
    ]
    head = "".join(f'<th scope="col">{word}</th>' for word in ("quantity", "where", "printed", "computed", ""))
    title = "Printed and computed numbers"
    return f"<h3>Printed numbers beside computed ones</h3>{_scrolling(title, rows, f'<thead><tr>{head}</tr></thead>')}"


def _scrolling(name: str, rows: list[str], head: str = "") -> str:
    """A table that scrolls by itself where the page is narrow, by keyboard as well."""
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    table = f"<table>{head}<tbody>{body}</tbody></table>"
    return f'<div class="wide" tabindex="0" role="region" aria-label="{name}">{table}</div>'


def find_slices(data: xarray.Dataset, edges: Edges | None = None) -> Iterator[str]:
    """The maps of a store, as HTML, with the exact edges of the stable and the passive walls."""
    data = in_order(data)
    # A store lists its variables in any order.
    for name in (name for name in OUTPUTS if name in data and name != "kind"):
        axes = choose_axes(data, name)
        if len(axes) == 2 and "device" not in axes:
            values = data[name]
            if OUTPUTS[name].dtype == "bool":
                # A wall that nothing is known of is not one that is not stable.
                values = values.astype(np.float32).where(data[STATUS_OF[OUTPUTS[name].family]] == Status.OK)
            yield _draw(values, name, (axes[0], axes[1]), edges or (lambda part: {}))


def _draw(values: xarray.DataArray, name: str, axes: tuple[str, str], edges: Edges) -> str:
    x, y = axes
    output = OUTPUTS[name]
    others = [str(dim) for dim in values.dims if dim not in (x, y)]
    along = min(_ALONG, int(np.sqrt(_MOST / max(1, np.prod([min(values.sizes[dim], _OTHERS) for dim in others])))))
    most = {dim: along if dim in (x, y) else _OTHERS for dim in map(str, values.dims)}
    thin = values.isel({dim: pick_evenly(values.sizes[dim], count) for dim, count in most.items()})
    thin = thin.transpose(*others, y, x).load()
    with np.errstate(over="ignore"):
        numbers, sizes = thin.values.astype(np.float32), [thin.sizes[dim] for dim in others]
    scale = choose_scale(output, numbers[np.isfinite(numbers)].astype(float))
    content = {
        "name": name,
        "unit": _unit(thin),
        "truth": output.dtype == "bool",
        "scale": "log" if scale.logarithmic else "linear",
        "low": scale.low,
        "high": scale.high,
        "extend": scale.extend,
        "colors": _list_colors(scale.colormap),
        "x": _axis(thin, x),
        "y": _axis(thin, y),
        "others": [_axis(thin, dim) for dim in others],
        "edges": [_trace(thin.isel(dict(zip(others, place, strict=True))), x, edges) for place in np.ndindex(*sizes)],
        # What is too large for single precision is not infinite.
        "values": _encode(np.where(np.isfinite(numbers) | np.isinf(thin.values), numbers, np.nan)),
    }
    words = f"{output.long_name}, over {_words(x)} (across) and {_words(y)} (up)"
    sliders = "".join(
        f'<label>{escape(_words(dim))}: <span></span><input type="range" min="0" max="{thin.sizes[dim] - 1}" value="0">'
        "</label>"
        for dim in others
    )
    colors = f"Dark: not {name}; bright: {name}" if output.dtype == "bool" else _explain_colors(scale, _unit(thin))
    thinned = "" if thin.size == values.size else f" Shown are {thin.size:,} of {values.size:,} values."
    # As JSON that ends no script element.
    embedded = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<div class="slices"><h3>{escape(name)}</h3><p class="soft">{escape(words)}. '
        f"{colors}; gray: {'0, ' if scale.logarithmic else ''}{_GRAY}."
        f"{_LINES if any(content['edges']) else ''}{thinned} "
        "Point, or focus the map and use the arrow keys, to read a value.</p>"
        f'{sliders}<canvas tabindex="0" role="img" aria-label="{escape(words)}"></canvas><output aria-live="polite">'
        f'</output><script type="application/json">{embedded}</script></div>'
    )


def _list_colors(colormap: str) -> list[str]:
    """Return evenly spaced colors of a colormap as hexadecimal RGB; the page interpolates between them."""
    return [to_hex(color)[1:] for color in matplotlib.colormaps[colormap](np.linspace(0.0, 1.0, _COLORS))]


def _explain_colors(scale: ColorScale, unit: str) -> str:
    ends = {"neither": "", "min": "; below: arrow", "max": "; above: arrow", "both": "; outside: arrows"}
    return f"Color bar: {' to '.join(tell_apart(scale.low, scale.high))} {unit}".rstrip() + ends[scale.extend]


def _trace(part: xarray.DataArray, x: str, edges: Edges) -> dict[str, list[str]]:
    """The outlines of the stable and the passive walls of one slice, across first, in the units of its axes."""
    for dim in map(str, part.coords):
        part[dim].attrs.setdefault("factor", 1.0)
    over = slice(None, None, 1 if x in ("alpha", "stiffness") else -1)
    found = edges(part.to_dataset(name="values")).items()
    return {name: [_encode(points[:, over]) for points, _ in outlines] for name, outlines in found}


def _encode(numbers: np.ndarray) -> str:
    return base64.b64encode(numbers.astype("<f4").tobytes()).decode()


def _axis(values: xarray.DataArray, dim: str) -> dict[str, Any]:
    along = values[dim]
    labels = along.dtype.kind not in "biuf"
    steps = [str(label) for label in along.values] if labels else np.asarray(along.values, float).tolist()
    return {"name": _words(dim), "unit": "" if labels else _unit(along), "values": steps}


def _unit(values: xarray.DataArray) -> str:
    unit = write_unit(str(values.attrs.get("units", "")))
    return unit.replace("$", "")


def _words(dim: str) -> str:
    return VARIABLES[dim].words_in(units()) if dim in VARIABLES else dim
