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
from typing import Any

from zwidth.config.study import KINDS
from zwidth.runs.record import CONFIG_FILE, INPUTS, RUN_FILE, Record, file_hash
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.files import write_whole
from zwidth.sweep.store import SUFFIX
from zwidth.words.errors import StoreError

FILE = "report.html"


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
    style, script = (_resource(name) for name in ("report.css", "report.js"))
    name = escape(str(content.get("name", where.name)))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; script-src '{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    contents = "".join(f'<li><a href="#{escape(each["name"])}">{escape(each["name"])}</a></li>' for each in done)
    sections = "".join(_section(where, entry) for entry in done)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="referrer" content="no-referrer">'
        f"<title>{name}: stability of virtual walls</title><style>{style}</style></head><body><main>"
        f"<h1>{name}</h1><p>{escape(str(content.get('description') or ''))}</p>"
        f'<p class="soft">Computed from {escape(str(content.get("started", "")))} on, in '
        f"{escape(str(content.get('precision', 'float64')))}, by zwidth "
        f"{escape(str(content['versions'].get('zwidth', '')))}.</p>"
        f'<nav aria-label="Studies"><ul>{contents}<li><a href="#again">How to compute it again</a></li></ul></nav>'
        f"{sections}{_reproduce(where, content)}</main><script>{script}</script></body></html>\n"
    )


def _section(where: Path, entry: dict[str, Any]) -> str:
    kind, name = str(entry["kind"]), escape(str(entry["name"]))
    notes = "".join(f"<p>{escape(str(note))}</p>" for note in entry.get("notes", ()))
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
            data = base64.b64encode(path.read_bytes()).decode()
            text = f"Figure {path.stem} of the study {entry['name']}"
            yield (
                f'<figure><img alt="{escape(text)}" src="data:image/svg+xml;base64,{data}">'
                f"<figcaption>{escape(path.stem)}</figcaption></figure>"
            )
        elif entry.get("kind") == "published" and file.endswith(".json"):
            yield _published(json.loads(path.read_text(encoding="utf-8")))
        elif file.endswith(SUFFIX) and path.is_symlink():
            # Stores are not read through links: what one leads to may be anybody's.
            yield f'<p class="soft">{escape(file)} is a link, and not shown.</p>'
        elif file.endswith(SUFFIX):
            from zwidth.pages.report.slices import find_slices

            with open_dataset(path) as data:
                if not data.attrs["complete"]:
                    raise StoreError(f"{path}: chunks are missing; 'zwidth run CONFIG --resume' computes them")
                yield from find_slices(data)


def _published(content: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(row['quantity'])}</td><td>{escape(row['where'])}</td><td>{escape(str(row['printed']))}</td>"
        f'<td class="number">{row["computed"]:.10g}</td><td>{"agrees" if row["agrees"] else "differs"}</td></tr>'
        for row in content["published"]
    )
    head = "".join(f'<th scope="col">{word}</th>' for word in ("quantity", "where", "printed", "computed", ""))
    return "<h3>Printed numbers beside computed ones</h3>" + _scrolling(
        "Printed and computed numbers", f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    )


def _reproduce(where: Path, content: dict[str, Any]) -> str:
    versions = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(version))}</td></tr>'
        for name, version in content["versions"].items()
    )
    path = where / CONFIG_FILE
    text = path.read_text(encoding="utf-8") if path.is_file() and not path.is_symlink() else ""
    beside = f" Beside it goes the folder <code>{INPUTS}</code> of the run." if content.get("inputs") else ""
    config = f'<h3>Configuration</h3><pre tabindex="0">{escape(text)}</pre>' if text else ""
    digest = escape(str(content.get("config_sha256", "")))
    return (
        '<section><h2 id="again">How to compute it again</h2>'
        "<p>Save the configuration below as <code>config.yaml</code>, install these versions, and run "
        f"<code>zwidth run config.yaml</code>.{beside} The same versions give the same numbers.</p>"
        f'<p class="soft">SHA-256 of the configuration: {digest}</p>'
        + _scrolling("Versions", f"<tbody>{versions}</tbody>")
        + f"{config}</section>"
    )


def _scrolling(name: str, rows: str) -> str:
    """A table that scrolls by itself where the page is narrow, by keyboard as well."""
    return f'<div class="wide" tabindex="0" role="region" aria-label="{name}"><table>{rows}</table></div>'


def _resource(name: str) -> str:
    return files("zwidth.pages.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
