"""Labels with special characters: shown literally in figures, and escaped in tables against formula injection."""

import csv
import io
import random

import numpy as np
import pytest

import zwidth
from zwidth.config.device_table import files_relative_to, read_table
from zwidth.plotting import style
from zwidth.runs.draw import draw_stores
from zwidth.studies.outcome import csv_text
from zwidth.sweep.dataset import to_csv
from zwidth.units.formatting import from_cell, to_cell

SPECIAL_LABELS = ["$a_$", "$x", "_hidden", r"\frac{$", r"$\nothing{$ and $", "=1+1", "K_max $$", "a\\$b_$^$"]
DEVICE = {"mass": 0.1, "damping": 10, "rate": "1 kHz", "delay": "1 periods"}
FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")


def random_text(rng):
    return "".join(rng.choice("=+-@'\"$_\\{}^,; \t\r\nab1.＝＋－＠") for _ in range(rng.randint(1, 7)))


def test_studies_with_special_labels_are_drawn(tmp_path):
    devices = [{"label": label, **DEVICE} for label in [*SPECIAL_LABELS, "b"]]
    damping = list(range(1, len(devices) + 1))
    studies = [
        {"kind": "step", "name": "step", "devices": devices, "stiffness_fraction": 0.5, "duration": "5 ms"},
        {"kind": "compare", "name": "compare", "devices": devices},
        {"kind": "sweep", "name": "sweep", "outputs": ["stiffness_max"],
         "axes": {"devices": {"label": [*SPECIAL_LABELS, "b"], "mass": [0.1] * len(devices), "damping": damping},
                  "rate": ["1 kHz", "2 kHz"], "delay": "1 periods"}},
    ]  # fmt: skip
    result = zwidth.run({"version": 1, "name": "labels", "studies": studies}, out=tmp_path / "out")
    assert [study.error for study in result.failed] == []
    assert draw_stores(tmp_path / "out")
    page = zwidth.write_report(tmp_path / "out")
    assert page.is_file()


@pytest.mark.parametrize("kind", ["simulate", "limit_cycle"])
def test_walls_and_conditions_with_special_labels_are_drawn(kind, tmp_path):
    scene = {"mass": 0.1, "damping": 1, "period": "1 ms", "delay": "1 periods"}
    extra = {"stiffness_fraction": [0.5], "external_force": 0.5, "duration": "5 ms"}
    if kind == "limit_cycle":
        conditions = [{"label": label, "resolution": "20 um"} for label in SPECIAL_LABELS]
        axes = {"stiffness": [1000, 2000], "virtual_damping": [1, 2]}
        extra = {"axes": axes, "start_position": "0.1 mm", "duration": "20 periods", "conditions": conditions}
    config = {"version": 1, "name": "labels", "scene": scene, "studies": [{"kind": kind, "name": "s", **extra}]}
    result = zwidth.run(config, out=tmp_path / "out")
    assert [study.error for study in result.failed] == []


def test_matplotlib_shows_labels_literally():
    rng = random.Random(2)
    figure, panels = style.new_figure(4.0, 3.0)
    ax = panels[0, 0]
    for text in [*SPECIAL_LABELS, *(random_text(rng) for _ in range(300))]:
        drawn = ax.set_title(style.literal(text))
        shown, is_math = drawn._preprocess_math(drawn.get_text())
        assert not is_math
        characters = [character if character.isprintable() or character == "\n" else " " for character in str(text)]
        assert shown.lstrip("\u200b") == "".join(characters)
    # Next to a formula, labels are not parsed as mathematics.
    for text in [f"{style.literal(label)}  ($\\alpha = 1$)" for label in SPECIAL_LABELS]:
        ax.set_title(text)
        figure.canvas.draw()


def test_cells_are_escaped_and_read_back():
    rng = random.Random(3)
    texts = [*SPECIAL_LABELS, *FORMULA_STARTS, "", "'", "''=", "' =x", *(random_text(rng) for _ in range(20_000))]
    for text in texts:
        cell = to_cell(text)
        assert from_cell(cell) == text
        assert not cell.lstrip(" ").startswith(FORMULA_STARTS)
    assert [to_cell(value) for value in (-1.5, 3, True, "plain")] == [-1.5, 3, True, "plain"]


def test_table_of_a_study_is_read_back_as_devices(tmp_path):
    table = {"label": np.array(["=1+1", "-x", "'=y", "plain"]), "mass": np.array([0.1, 1e-3, 0.3, 0.4]),
             "damping": np.array([1.0, 0.0, 3.5, 1e-5])}  # fmt: skip
    text = csv_text(table)
    rows = list(csv.reader(io.StringIO(text)))
    assert [row[0] for row in rows] == ["label", "'=1+1", "'-x", "''=y", "plain"]
    assert rows[2][1:] == ["0.001", "0.0"]
    assert csv_text({"x": np.array([-1.5, np.nan])}) == "x\n-1.5\nnan\n"
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with files_relative_to(tmp_path):
        read = read_table({"csv": "t.csv"})
    assert read.labels == tuple(table["label"])
    np.testing.assert_array_equal(read.values("mass"), table["mass"])


def test_export_escapes_labels_of_devices(tmp_path):
    axes = {"devices": {"label": ["=a", "b"], "mass": [0.1, 0.2], "damping": [1, 2]}, "period": 1e-3, "delay": "1 ms"}
    study = {"kind": "sweep", "name": "s", "axes": axes, "outputs": ["stiffness_max"]}
    assert zwidth.run({"version": 1, "name": "n", "studies": [study]}, out=tmp_path / "out").ok
    to_csv(tmp_path / "out", tmp_path / "t.csv")
    with open(tmp_path / "t.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [from_cell(row["device"]) for row in rows] == ["=a", "b"]
    assert rows[0]["device"] == "'=a"
    assert all(float(row["stiffness_max_N_per_m"]) > 0 for row in rows)
