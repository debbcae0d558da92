"""Width, format and resolution of a run's figures, from the configuration or the command line."""

import json

import pytest
from click.testing import CliRunner
from matplotlib.text import Text
from PIL import Image

import zwidth
from zwidth.cli.commands import cli
from zwidth.plotting import style
from zwidth.studies.responses import draw

pytestmark = pytest.mark.usefixtures("fitted_once")
SCENE = {"mass": 0.1, "damping": 10, "period": 1e-3, "delay": 1e-3}
STUDIES = [
    {"kind": "recommend", "name": "best"},
    {"kind": "step", "name": "answer", "walls": [{"stiffness": 1e4, "virtual_damping": 40}]},
]
CONFIG = {"version": 1, "name": "small", "scene": SCENE, "studies": STUDIES}


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_figures_have_the_configured_width_and_format(ending, tmp_path):
    result = zwidth.run({**CONFIG, "figure": {"width": "85 mm", "format": ending}}, out=tmp_path / "r")
    assert result.ok
    drawn = sorted(file.name for file in (tmp_path / "r").glob("*.*") if file.suffix in (".png", ".svg", ".pdf"))
    assert drawn == [f"answer.{ending}", f"best.{ending}"]
    if ending == "png":
        for name in drawn:
            with Image.open(tmp_path / "r" / name) as picture:
                assert picture.width == int(85 / 25.4 * style.PNG_DPI)


def test_resolution_is_set_by_configuration_or_command(tmp_path):
    widths = []
    for look, options in (({}, []), ({"dpi": 90}, []), ({}, ["--dpi", "360"]), ({"dpi": 90}, ["--dpi", "360"])):
        file, out = tmp_path / "c.json", tmp_path / f"r{len(widths)}"
        file.with_suffix(".yaml").write_text(json.dumps({**CONFIG, "figure": look}), encoding="utf-8")
        result = CliRunner().invoke(cli, ["run", str(file.with_suffix(".yaml")), "--out", str(out), *options])
        assert result.exit_code == 0, result.output
        with Image.open(out / "best.png") as picture:
            widths.append(picture.width / picture.info["dpi"][0])
            assert round(picture.info["dpi"][0]) == (360 if options else look.get("dpi", 180))
    assert widths == pytest.approx(widths[:1] * 4, rel=0.01)
    result = CliRunner().invoke(cli, ["figures", str(tmp_path / "r0")])
    assert "contains no sweep" in str(result.exception)
    assert "--overwrite --size 85mm --dpi 300" in str(result.exception)


def test_resuming_with_another_figure_format_raises(tmp_path):
    assert zwidth.run(CONFIG, out=tmp_path / "r").ok
    with pytest.raises(zwidth.ZwidthError):
        zwidth.run({**CONFIG, "figure": {"width": 0.085}}, out=tmp_path / "r", resume=True)


def test_text_is_legible_at_column_width():
    """No text is smaller than 7 points, and no label extends beyond the figure."""
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    with style.style_sheet(size=(85 / 25.4, None)):
        axes = draw(scene.recommend())
    figure = style.figure_of(axes)
    assert len(axes) == 2
    assert figure.get_figwidth() == pytest.approx(85 / 25.4)
    # Draw twice, because the layout uses ticks that the first drawing creates.
    for _ in range(2):
        figure.draw_without_rendering()
    for text in figure.findobj(Text):
        if isinstance(text, Text) and text.get_text() and text.get_visible():
            assert float(text.get_fontsize()) >= 7.0, text.get_text()
    for text in [label for ax in axes for label in (ax.xaxis.label, ax.yaxis.label, *ax.texts)]:
        box = text.get_window_extent()
        assert -1 <= box.x0 < box.x1 <= figure.bbox.width + 1, text.get_text()


@pytest.mark.parametrize(
    ("look", "message"),
    [
        ("{width: 85}", "figure.width: got 85 m; it must be at least 0.05"),
        ("{format: jpg}", "figure.format: got 'jpg'; allowed are 'png', 'svg', 'pdf'"),
        ("{size: 3}", "figure.size: unknown key"),
        ("{dpi: 3}", "figure.dpi: got 3; it must be at least 10 and at most 2400"),
        ("wide", "figure: got 'wide'; the look of figures is a mapping"),
    ],
)
def test_invalid_figure_settings_raise(look, message, tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text(f"version: 1\nname: c\nfigure: {look}\nstudies: [{{kind: ridge, name: r, delta: 0.1, d: 1}}]\n")
    with pytest.raises(zwidth.ConfigError, match=message):
        zwidth.load_config(file)


@pytest.mark.parametrize(
    ("size", "wide", "high"), [("4x3", 4, 3), ("85mm", 85 / 25.4, None), ("85x60 mm", 85 / 25.4, 60 / 25.4)]
)
def test_size_on_the_command_line(size, wide, high, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.yaml").write_text(
        "version: 1\nname: c\nstudies: [{kind: ridge, name: r, delta: {linear: {start: 0, stop: 1, num: 5}}, d: 1}]\n"
    )
    result = CliRunner().invoke(cli, ["run", "c.yaml", "--size", size])
    assert result.exit_code == 0, result.output
    with Image.open(tmp_path / "runs" / "c" / "r.png") as picture:
        assert picture.width == int(wide * style.PNG_DPI)
        assert high is None or picture.height == int(high * style.PNG_DPI)
