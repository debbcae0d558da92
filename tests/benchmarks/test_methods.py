"""The benchmark's own parts: problems with proved answers, a tiny run, and what is written of it."""

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.text import Text

from methods import problems, report, suite
from methods.baselines import available
from methods.pareto import Mark, draw_pareto
from zwidth.cli.commands import cli
from zwidth.core.errors import InputError, ResourceError


def test_labels_near_the_boundary_are_those_of_their_side():
    truth = problems.near_boundary(1.0, 240)
    assert 200 < truth.stable.size <= 240
    assert 0.3 < truth.stable.mean() < 0.7
    # By roots of 60 digits and more, which the certified method does not use.
    some = np.arange(0, truth.stable.size, 9)
    for wall, stable in zip(zip(*(part[some] for part in truth.walls), strict=True), truth.stable[some], strict=True):
        assert (problems.exact_radius(*map(float, wall)) < 1) == stable


def test_long_polynomials_have_the_radius_of_all_their_roots():
    """The refined pole beside isolation of all roots, another algorithm."""
    walls, radius = problems.with_radius(4.0, 8)
    for wall, exact in zip(zip(*walls, strict=True), radius, strict=True):
        assert abs(problems.refined_radius(*map(float, wall)) - exact) <= 2e-16 * exact


def test_the_damping_needed_without_delay_is_that_of_eq_21():
    walls, needed = problems.with_needed_damping(0.0, 10)
    np.testing.assert_allclose(needed, walls.alpha / 2 + np.abs(walls.beta), rtol=1e-15)


def test_every_tool_finds_the_same_radii():
    walls, radius = problems.with_radius(1.0, 20)
    for name, tool in available().items():
        np.testing.assert_allclose(tool.radius(walls), radius, rtol=1e-10, err_msg=name)


@pytest.fixture(scope="module")
def rows():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(suite, "_SECONDS", 0.0)
        patch.setattr(suite, "_LEAST", 1)
        # It takes seconds to compile, and tests of its own hold it against the other method.
        patch.setattr(suite, "_LONGEST", {"companion": 50, "kkt": -1})
        return suite.measure(suite.Sizes((0.0,), 6_400, 10_000, 60, 10))


def test_a_tiny_run_measures_every_method(rows):
    methods = {(row.quantity, row.method) for row in rows if not row.baseline}
    assert methods == {
        *(("stable", name) for name in ("crossover", "companion", "certified")),
        *(("spectral_radius", name) for name in ("newton", "companion", "aberth")),
        *(("spectral_radius", f"map to {accuracy}") for accuracy in ("0.01", "0.0001", "1e-06", "1e-09")),
        ("passive", "worst frequency"),
        ("alpha_max", "newton"),
    }
    assert {row.method for row in rows if row.baseline} == set(available())
    for row in rows:
        assert row.rate > 0
        assert row.first_seconds >= 0
        assert row.error < 1e-2
        if row.method == "certified":
            assert row.wrong == 0


def test_what_is_written_can_be_read(rows, tmp_path):
    report.write(rows, tmp_path)
    document = json.loads((tmp_path / "bench.json").read_text())
    assert len(document["rows"]) == len(rows)
    assert document["environment"]["jax"]
    text = (tmp_path / "bench.md").read_text()
    assert text.count("|\n") > len(rows)
    assert "np.linalg.eigvals" in (tmp_path / "summary.txt").read_text()
    assert (tmp_path / "pareto.png").stat().st_size > 10_000


def test_the_figure_has_a_panel_for_each_delay_and_a_mark_for_each_method():
    marks = [Mark("stable", "crossover", "map", d, 1e9, 0.0) for d in (0.0, 1.0, 4.0, 8.0, 50.0)] + [
        Mark("stable", "companion", "scattered", 0.0, 1e8, 1e-4)
    ]
    axes = draw_pareto(marks)
    titles = ["d = 0", "d = 1", "d = 4", "d = 8", "d = 50"]
    assert [ax.get_title(loc="left") for ax in axes] == titles
    # Below a panel without a neighbor, too.
    assert [bool(ax.get_xlabel()) for ax in axes] == [False, False, True, True, True]
    drawn = [line.get_data() for line in axes[0].lines if len(line.get_xdata()) == 1]
    assert [float(y[0]) for _, y in drawn] == [1e9, 1e8]


def test_results_are_not_overwritten(tmp_path):
    (tmp_path / "bench.json").write_text("{}")
    with pytest.raises(InputError, match="--overwrite"):
        CliRunner().invoke(cli, ["bench", "--out", str(tmp_path)], catch_exceptions=False)
    with pytest.raises(InputError, match="not a folder"):
        CliRunner().invoke(cli, ["bench", "--out", str(tmp_path / "bench.json" / "x")], catch_exceptions=False)


def test_without_a_checkout_one_line_says_what_is_needed(monkeypatch, tmp_path):
    monkeypatch.setattr("zwidth.cli.runs.__file__", str(tmp_path / "lib" / "zwidth" / "cli" / "bench.py"))
    with pytest.raises(ResourceError, match=r"bench: requires a checkout .*zwidth bench$"):
        CliRunner().invoke(cli, ["bench"], catch_exceptions=False)


def test_names_of_methods_are_apart_and_on_the_page():
    kept = Path(__file__).parents[2] / "benchmarks" / "results" / "bench.json"
    rows = [row for row in json.loads(kept.read_text(encoding="utf-8"))["rows"] if row["layout"] != "one"]
    axes = draw_pareto([Mark(*(row[name] for name in Mark._fields)) for row in rows])
    figure = axes[0].figure
    figure.draw_without_rendering()
    for ax in axes:
        boxes = [Text.get_window_extent(name) for name in ax.texts]
        assert len(boxes) > 3
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(figure.bbox.contains(box.x0, box.y0) and figure.bbox.contains(box.x1, box.y1) for box in boxes)
        # None lies on a mark, nor below the panel.
        assert min(box.x0 for box in boxes) > ax.get_window_extent().x1
        assert min(box.y0 for box in boxes) > ax.get_window_extent().y0 - max(box.height for box in boxes)
