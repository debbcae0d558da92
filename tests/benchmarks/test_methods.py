"""Benchmark package: problems with proved results, a small run, and its output files."""

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


def test_labels_near_the_boundary_match_exact_spectral_radii():
    truth = problems.near_boundary(1.0, 240)
    assert 200 < truth.stable.size <= 240
    assert 0.3 < truth.stable.mean() < 0.7
    # Against roots of 60 digits and more, which the certified method does not use.
    indices = np.arange(0, truth.stable.size, 9)
    for wall, stable in zip(
        zip(*(part[indices] for part in truth.walls), strict=True), truth.stable[indices], strict=True
    ):
        assert (problems.exact_radius(*map(float, wall)) < 1) == stable


def test_refined_radius_matches_isolation_of_all_roots():
    walls, radius = problems.with_radius(4.0, 8)
    for wall, exact in zip(zip(*walls, strict=True), radius, strict=True):
        assert abs(problems.refined_radius(*map(float, wall)) - exact) <= 2e-16 * exact


def test_required_damping_without_delay_matches_eq_21():
    walls, required = problems.with_needed_damping(0.0, 10)
    np.testing.assert_allclose(required, walls.alpha / 2 + np.abs(walls.beta), rtol=1e-15)


def test_all_baselines_compute_the_same_radii():
    walls, radius = problems.with_radius(1.0, 20)
    for name, tool in available().items():
        np.testing.assert_allclose(tool.radius(walls), radius, rtol=1e-10, err_msg=name)


@pytest.fixture(scope="module")
def rows():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(suite, "_SECONDS", 0.0)
        patch.setattr(suite, "_LEAST", 1)
        # Slow to compile, and compared with the other method by unit tests.
        patch.setattr(suite, "_LONGEST", {"companion": 50, "kkt": -1})
        return suite.measure(suite.Sizes((0.0,), 6_400, 10_000, 60, 10))


def test_small_run_measures_every_method(rows):
    methods = {(row.quantity, row.method) for row in rows if not row.baseline}
    assert methods == {
        *(("stable", name) for name in ("crossover", "companion", "certified")),
        *(("spectral_radius", name) for name in ("newton", "companion", "aberth")),
        *(("spectral_radius", f"map to {accuracy}") for accuracy in ("1e-09", "1e-12")),
        ("passive", "worst frequency"),
        ("alpha_max", "newton"),
        *(("stable", f"jit {precision}") for precision in ("float64", "float32", "mixed")),
        *(
            (quantity, f"jit {dtype}")
            for quantity in ("spectral_radius", "alpha_max")
            for dtype in ("float64", "float32")
        ),
    }
    assert {row.method for row in rows if row.baseline} == set(available())
    for row in rows:
        assert row.rate > 0
        assert row.first_seconds >= 0
        assert row.error < 1e-2
        if row.method == "certified":
            assert row.wrong == 0


def test_output_files_are_complete(rows, tmp_path):
    report.write(rows, tmp_path)
    document = json.loads((tmp_path / "bench.json").read_text())
    assert len(document["rows"]) == len(rows)
    assert document["environment"]["jax"]
    text = (tmp_path / "bench.md").read_text()
    assert text.count("|\n") > len(rows)
    assert "np.linalg.eigvals" in (tmp_path / "summary.txt").read_text()
    assert (tmp_path / "pareto.png").stat().st_size > 10_000


def test_figure_has_a_panel_per_delay_and_a_mark_per_method():
    marks = [Mark("stable", "crossover", "map", d, 1e9, 0.0) for d in (0.0, 1.0, 4.0, 8.0, 50.0)] + [
        Mark("stable", "companion", "scattered", 0.0, 1e8, 1e-4)
    ]
    axes = draw_pareto(marks)
    titles = ["d = 0", "d = 1", "d = 4", "d = 8", "d = 50"]
    assert [ax.get_title(loc="left") for ax in axes] == titles
    # Also for a panel without a neighbor below.
    assert [bool(ax.get_xlabel()) for ax in axes] == [False, False, True, True, True]
    drawn = [line.get_data() for line in axes[0].lines if len(line.get_xdata()) == 1]
    assert [float(y[0]) for _, y in drawn] == [1e9, 1e8]


def test_results_are_not_overwritten(tmp_path):
    (tmp_path / "bench.json").write_text("{}")
    with pytest.raises(InputError, match="--overwrite"):
        CliRunner().invoke(cli, ["bench", "--out", str(tmp_path)], catch_exceptions=False)
    with pytest.raises(InputError, match="not a folder"):
        CliRunner().invoke(cli, ["bench", "--out", str(tmp_path / "bench.json" / "x")], catch_exceptions=False)


def test_bench_without_a_checkout_raises_with_the_requirements(monkeypatch, tmp_path):
    monkeypatch.setattr("zwidth.cli.runs.__file__", str(tmp_path / "lib" / "zwidth" / "cli" / "bench.py"))
    with pytest.raises(ResourceError, match=r"bench: requires a checkout .*zwidth bench$"):
        CliRunner().invoke(cli, ["bench"], catch_exceptions=False)


def test_method_names_do_not_overlap_and_lie_within_the_figure():
    results_file = Path(__file__).parents[2] / "benchmarks" / "results" / "bench.json"
    rows = [row for row in json.loads(results_file.read_text(encoding="utf-8"))["rows"] if row["layout"] != "one"]
    axes = draw_pareto([Mark(*(row[name] for name in Mark._fields)) for row in rows])
    figure = axes[0].figure
    figure.draw_without_rendering()
    for ax in axes:
        boxes = [Text.get_window_extent(name) for name in ax.texts]
        assert len(boxes) > 3
        assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))
        assert all(figure.bbox.contains(box.x0, box.y0) and figure.bbox.contains(box.x1, box.y1) for box in boxes)
        # No name covers a mark or lies below the panel.
        assert min(box.x0 for box in boxes) > ax.get_window_extent().x1
        assert min(box.y0 for box in boxes) > ax.get_window_extent().y0 - max(box.height for box in boxes)
