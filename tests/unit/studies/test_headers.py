"""Column headers of tables: quantities in SI units have a unit suffix; normalized ones, counts and texts have none."""

from pathlib import Path

import numpy as np
import pytest

from zwidth.studies import Config, load_config
from zwidth.units.formatting import header

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
WORDS = {
    "fitted_to",
    "label",
    "curve",
    "kind",
    "delay_model",
    "estimate",
    "parameter",
    "sufficient_side",
    "status",
    "piece",
}
COUNTS = {"log", "number", "islands", "samples", "best"}
RATIOS = {
    "autocorrelation",
    "band",
    "stiffness_residual",
    "frequency_residual",
    "reserve",
    "stable_share",
    "stable_share_low",
    "stable_share_high",
}
NORMALIZED = {"d", "delta", "omega", "alpha", "beta", "beta_lower", "beta_upper", "alpha_max"}
NORMALIZED |= {"alpha_max_passive", "beta_passive"}
WITHOUT_UNIT = WORDS | COUNTS | RATIOS | NORMALIZED
UNITS = tuple(header("", unit) for unit in ("N/m", "N s/m", "s", "m", "m/s", "N", "Hz", "kg"))


FILTERS = {
    "kind": "filters",
    "name": "f",
    "cutoff": [100],
    "samples": [1],
    "resolution": "20 um",
    "noise_limit": "1 mm/s",
}


def quick_studies():
    """Yield studies of every kind that writes tables, without the slow ones."""
    configs = [
        load_config(CONFIGS / f"{name}.yaml") for name in ("quickstart", "compliance", "requirements", "paper", "fit")
    ]
    scene = {"mass": 0.1, "period": 1e-3}
    configs.append(Config.model_validate({"version": 1, "name": "filters", "scene": scene, "studies": [FILTERS]}))
    for config in configs:
        for study in config.studies:
            if study.name not in ("cutoff", "fig6"):
                yield pytest.param(study, config.scene, id=f"{config.name}-{study.name}")


@pytest.mark.parametrize("study, scene", list(quick_studies()))
def test_every_header_has_its_unit(study, scene):
    outcome = study.compute(scene, True)
    headers = [list(outcome.table)]
    headers += [text.splitlines()[0].split(",") for name, text in outcome.documents.items() if name.endswith(".csv")]
    assert [name for names in headers for name in names if name not in WITHOUT_UNIT and not name.endswith(UNITS)] == []
    text_columns = [name for name in outcome.table if np.asarray(outcome.table[name]).dtype.kind == "U"]
    assert [name for name in text_columns if name not in WORDS and not name.startswith("other_crossings_")] == []


@pytest.mark.parametrize(
    "name, unit, expected",
    [
        ("stiffness", "N/m", "stiffness_N_per_m"),
        ("virtual_damping", "N s/m", "virtual_damping_N_s_per_m"),
        ("delay", "s", "delay_s"),
        ("delay", "sampling periods", "delay"),
        ("alpha", "1", "alpha"),
        ("samples", "", "samples"),
    ],
)
def test_units_in_headers(name, unit, expected):
    assert header(name, unit) == expected
