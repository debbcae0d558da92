"""Labels, legends and units in figures of rotary devices."""

from __future__ import annotations

import zwidth
from zwidth.config.values import read_in_units
from zwidth.plotting import draw_curves, draw_plane
from zwidth.plotting.style import style_sheet
from zwidth.studies import Config
from zwidth.studies.outcome import ComputedStudy
from zwidth.units.unit_system import ROTARY

KNOB = {"mass": "60 g cm^2", "damping": "0.02 mN m s/rad", "rate": "1 kHz", "delay": "0.7 periods"}


def draw(addition="", **study):
    """Return the axes of a study of the knob."""
    with read_in_units(ROTARY), style_sheet(system=ROTARY):
        config = Config.model_validate(
            {"version": 1, "name": "k", "scene": KNOB, "studies": [{"name": "study", **study}]}
        )
        (study_model,) = config.studies
        assert isinstance(study_model, ComputedStudy)
        return study_model.compute(config.scene, True).figures[addition]()


def legend_texts(axes):
    legends = [*axes[0].figure.legends, *(ax.get_legend() for ax in axes if ax.get_legend())]
    return [text.get_text() for legend in legends for text in legend.get_texts()]


FILTERS = {"kind": "filters", "damping": ["0 N m s/rad", "0.02 mN m s/rad"], "cutoff": ["100 Hz", "30 Hz"]}


def test_legends_have_unit_prefixes():
    assert legend_texts(draw(**FILTERS, samples=[2, 5]))[:2] == ["$b$ = 0 N m s/rad", "$b$ = 20.0 µN m s/rad"]
    noisy = draw("_noise", **FILTERS, samples=[2, 5], resolution="0.18 deg", noise_limit="20 deg/s")
    assert legend_texts(noisy)[1].endswith(" mN m/rad")


def test_rotary_device_has_an_inertia():
    (ax,) = draw(kind="design", find="mass", stiffness=["1 N m/rad"], within=["10 g cm^2", "5000 g cm^2"])
    assert ax.get_xlabel() == "inertia  $J$  in g cm$^2$"
    assert "48.3 g cm$^2$ or more" in [text.get_text() for text in ax.texts]
    (ax,) = draw(kind="boundary")
    assert ax.get_xlabel().endswith(r"$\alpha = K\,T^2\!/J$")
    assert ax.get_ylabel().endswith(r"$\beta = B\,T/J$")


def test_sweep_figures_have_readable_units(tmp_path):
    axes = {"stiffness": ["0.1 N m/rad", "0.5 N m/rad"], "virtual_damping": ["1 mN m s/rad", "2 mN m s/rad"]}
    study = {"kind": "sweep", "name": "s", "axes": axes | {"delay": ["0.7 periods", "1 periods"]}}
    masses = {"kind": "sweep", "name": "m", "axes": {"mass": ["60 g cm^2", "90 g cm^2"]}, "outputs": ["stiffness_max"]}
    studies = [study | {"outputs": ["phase_margin"]}, masses]
    zwidth.run({"version": 1, "name": "knob", "scene": KNOB, "studies": studies}, out=tmp_path / "run")
    with zwidth.open_dataset(tmp_path / "run" / "s.zarr") as data:
        panels = draw_plane(data, "phase_margin")
    assert panels[0].figure.axes[-1].get_ylabel().endswith("in degrees")
    titles = [ax.get_title("left") for ax in panels]
    assert titles[0].endswith(r"$t_d = 0.7\,\mathrm{periods}$")
    assert titles[1].endswith(r"$t_d = 1\,\mathrm{period}$")
    report = zwidth.write_report(tmp_path / "run").read_text(encoding="utf-8")
    assert " degrees; gray" in report
    with zwidth.open_dataset(tmp_path / "run" / "m.zarr") as data:
        (ax,) = draw_curves(data, "stiffness_max")
    assert ax.get_xlabel() == "inertia  $J$  in g cm$^2$"
