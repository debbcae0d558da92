"""Registry of the outputs of sweeps, with unit, color scale, symbol and description of each.

An *output* is a result per wall or per device, such as the spectral radius. A *store* is the Zarr group with the
results of one sweep. The outputs of configurations, the variables of stores and the labels of figures are generated
from the entries.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from zwidth.core.status import Status

Family: TypeAlias = Literal["wall", "device"]  # an output has one value per wall, or one value per device and delay
# Kinds of color scales: "truth" for truth values, "diverging" for numbers that are good on one side of a limit and bad
# on the other, "logarithmic" for positive numbers, "steep" for positive numbers that may be infinite, "sequential" for
# other numbers.
ColorScale: TypeAlias = Literal["truth", "diverging", "sequential", "logarithmic", "steep"]
NOT_COMPUTED = 255  # status of points that are not computed yet; all other codes are those of `zwidth.Status`


@dataclass(frozen=True)
class Output:
    """An output of a sweep: a variable of a store."""

    name: str  # name in files and stores
    long_name: str  # description in stores, a noun phrase
    symbol: str = ""  # symbol in figures, in mathtext
    color_scale: ColorScale = "truth"  # kind of the color scale in figures
    family: Family = "wall"
    dtype: Literal["bool", "float64", "uint8"] = "float64"
    units: str = "1"  # unit in a normalized sweep
    physical_units: str | None = None  # unit in a sweep over SI quantities; None if equal to ``units``
    physical_only: bool = False  # True if a normalized sweep cannot compute it
    with_parts: bool = False  # True if it can be computed for devices with a velocity filter, a hand or a coupling
    source: str = ""  # other output from which this one is computed at no cost; "" if there is none
    # Approximate speeds in points per second and core: for rigid devices, and for devices with parts.
    rates: tuple[float, float] = (1e6, 10.0)
    label: str = ""  # name in figures, if it differs from ``name``
    center: float = 0.0  # limit of stability or passivity, which separates good from bad values
    below: bool = False  # True if values below the center are good
    flags: dict[str, Any] = field(default_factory=dict)  # attributes of the CF conventions that explain the codes

    @property
    def words(self) -> str:
        """The name of the output in figures."""
        return self.label or self.name.replace("_", " ")

    @property
    def logarithmic(self) -> bool:
        """True if figures show the output on a logarithmic scale, which cannot represent the value 0."""
        return self.color_scale in ("logarithmic", "steep")

    def units_in(self, physical: bool) -> str:
        """Return the unit of the output, in a sweep over SI quantities (``physical``) or in a normalized sweep."""
        return self.physical_units if physical and self.physical_units else self.units


def _flags(values: list[int], meanings: str) -> dict[str, Any]:
    """Return the attributes that the CF conventions require for a variable whose values are codes.

    ``meanings`` lists the meanings of the codes, separated by blanks.
    """
    return {"flag_values": values, "flag_meanings": meanings}


_OUTPUTS = (
    Output(
        "stable", "true if every pole lies strictly inside the unit circle", dtype="bool", with_parts=True,
        rates=(3e8, 3e8), flags=_flags([0, 1], "unstable stable"),
    ),
    Output(
        "spectral_radius", "largest pole magnitude", r"\rho", "diverging", with_parts=True, rates=(1e6, 5e4),
        center=1.0, below=True,
    ),
    Output(
        "margin", "1 - spectral radius, positive for a stable wall", r"1 - \rho", "diverging", with_parts=True,
        source="spectral_radius",
    ),
    Output(
        "decay_rate", "decay rate of the dominant pole, -ln(spectral radius); negative for an unstable wall",
        r"-\ln\rho", "diverging", units="1/period", physical_units="1/s", with_parts=True,
        source="spectral_radius",
    ),
    Output(
        "pole_angle", "angle of the dominant pole, from 0 to pi", r"\omega T", "sequential", units="rad/period",
        with_parts=True, source="spectral_radius", label="angle of the dominant pole",
    ),
    Output(
        "frequency", "frequency of the dominant pole; 0 if the response does not oscillate", "f", "sequential",
        units="Hz", physical_only=True, with_parts=True, source="spectral_radius",
        label="frequency of the dominant pole",
    ),
    Output(
        "gain_margin", "common factor of stiffness and damping at the limit of stability; below 1 for an unstable wall",
        "g_m", "logarithmic", with_parts=True, rates=(2e5, 300.0),
    ),
    Output(
        "phase_margin", "phase of the open loop above -180 degrees at the gain crossover", r"\varphi_m", "diverging",
        units="degree", with_parts=True, source="gain_margin",
    ),
    Output(
        "delay_margin", "largest additional delay with which the wall is stable; 0 for an unstable wall", r"\tau_m",
        "logarithmic", units="sampling periods", physical_units="s", with_parts=True, rates=(2e4, 100.0),
    ),
    Output(
        "modulus_margin", "smallest distance of the open loop from -1", "s_m", "sequential", with_parts=True,
        rates=(2e4, 300.0),
    ),
    Output(
        "passive", "true if the wall is passive", dtype="bool", with_parts=True, rates=(4e6, 100.0),
        flags=_flags([0, 1], "not_passive passive"),
    ),
    Output(
        "passivity_margin", "normalized physical damping in excess of the smallest one for which the wall is passive",
        r"\delta", "diverging", source="passive", label="passivity margin, in units of",
    ),
    Output(
        "settling_time",
        "time in which the dominant pole decays to 2 %, ln(50)/decay_rate; infinite for an unstable wall", r"t_{2\%}",
        "steep", units="sampling periods", physical_units="s", with_parts=True, source="spectral_radius",
        label="decay time to 2 %",
    ),
    Output(
        "alpha_max", "largest normalized stiffness of a stable wall, with the best virtual damping", r"\alpha_{\max}",
        "logarithmic", "device", label="maximum stable stiffness",
    ),
    Output(
        "beta_at_max", "normalized virtual damping of the wall with alpha_max", r"\beta", "sequential", "device",
        source="alpha_max", label="virtual damping of the stiffest wall",
    ),
    Output(
        "kind", "kind of the optimum at alpha_max: smooth, or a corner with a double pole at z = -1", family="device",
        dtype="uint8", source="alpha_max", flags=_flags([0, 1, NOT_COMPUTED], "smooth corner unknown"),
    ),
    Output(
        "stiffness_max", "largest stiffness K of a stable wall, with the best virtual damping", r"K_{\max}",
        "logarithmic", "device", units="N/m", physical_only=True, with_parts=True, source="alpha_max",
        label="maximum stable stiffness",
    ),
    Output(
        "virtual_damping_at_max", "virtual damping B of the wall with stiffness_max", "B", "sequential", "device",
        units="N s/m", physical_only=True, with_parts=True, source="alpha_max",
        label="virtual damping of the stiffest wall",
    ),
)  # fmt: skip
OUTPUTS = {output.name: output for output in _OUTPUTS}

RADIUS_OUTPUTS = frozenset(name for name, output in OUTPUTS.items() if "spectral_radius" in (name, output.source))
# Stability margins (`zwidth.margins`). They can be NaN without an error, because some walls do not have each margin.
MARGIN_OUTPUTS = frozenset({"gain_margin", "phase_margin", "delay_margin", "modulus_margin"})
OUTPUTS_WITH_PARTS = tuple(name for name, output in OUTPUTS.items() if output.with_parts)

# Name of the status variable for each family: outputs per wall, and outputs per device and delay.
STATUS_OF: dict[Family, str] = {"wall": "status", "device": "ridge_status"}


def status_flags() -> dict[str, Any]:
    """Return the attributes of a status variable: the status codes and their meanings, as in the CF conventions."""
    codes = [*(int(status) for status in Status), NOT_COMPUTED]
    meanings = " ".join([*(status.name.lower() for status in Status), "not_computed"])
    return {"long_name": "status of each point", **_flags(codes, meanings)}
