"""What a sweep computes, each output described once: for the reader of the file, the plan and the store."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from zwidth.status import Status

Family: TypeAlias = Literal["wall", "device"]
"""Whether an output belongs to each wall, or to each device and delay whatever its wall."""

NOT_COMPUTED = 255
"""The status of a point whose chunk is not there yet; the other codes are those of `zwidth.Status`."""


@dataclass(frozen=True)
class Output:
    """One variable of a store.

    Args:
        name: its name in files and stores.
        family: what it belongs to.
        dtype: how it is kept.
        long_name: its definition, for people.
        units: its unit in a normalized sweep.
        physical_units: its unit in a sweep over SI quantities; None where that is the same.
        physical_only: whether a normalized sweep cannot have it.
        attributes: more CF attributes.
    """

    name: str
    family: Family
    dtype: Literal["bool", "float64", "uint8"]
    long_name: str
    units: str = "1"
    physical_units: str | None = None
    physical_only: bool = False
    attributes: dict[str, Any] = field(default_factory=dict)

    def units_in(self, physical: bool) -> str:
        """The unit that the store states."""
        return self.physical_units if physical and self.physical_units else self.units


_KINDS = {"flag_values": [0, 1, NOT_COMPUTED], "flag_meanings": "smooth corner unknown"}


def _flags(no: str, yes: str) -> dict[str, Any]:
    return {"flag_values": [0, 1], "flag_meanings": f"{no} {yes}"}


_ALL = (
    Output(
        "stable",
        "wall",
        "bool",
        "whether every pole lies strictly inside the unit circle",
        attributes=_flags("unstable", "stable"),
    ),
    Output("spectral_radius", "wall", "float64", "largest pole magnitude"),
    Output("margin", "wall", "float64", "1 - spectral radius, positive for a stable wall"),
    Output(
        "decay_rate",
        "wall",
        "float64",
        "rate at which the slowest pole decays, -ln(spectral radius); negative where it grows",
        units="1/period",
        physical_units="1/s",
    ),
    Output(
        "gain_margin", "wall", "float64", "factor by which stiffness and damping together may grow; below 1: must fall"
    ),
    Output("phase_margin", "wall", "float64", "phase above -180 degrees at the gain crossover", units="degree"),
    Output(
        "delay_margin",
        "wall",
        "float64",
        "delay that the wall bears beyond its own; 0 for an unstable wall",
        units="sampling periods",
        physical_units="s",
    ),
    Output("modulus_margin", "wall", "float64", "least distance of the open loop from -1"),
    Output(
        "passive",
        "wall",
        "bool",
        "whether the wall is passive at its delay",
        attributes=_flags("not_passive", "passive"),
    ),
    Output(
        "passivity_margin",
        "wall",
        "float64",
        "physical damping in excess of what a passive wall needs, in units of delta",
    ),
    Output(
        "settling_time",
        "wall",
        "float64",
        "time in which the slowest pole decays to 2 %, ln(50)/decay_rate; infinite for an unstable wall",
        units="sampling periods",
        physical_units="s",
    ),
    Output("alpha_max", "device", "float64", "largest normalized stiffness that some virtual damping makes stable"),
    Output("beta_at_max", "device", "float64", "normalized virtual damping of that wall"),
    Output(
        "kind",
        "device",
        "uint8",
        "kind of that optimum: smooth, or a corner with a double pole at z = -1",
        attributes=_KINDS,
    ),
    Output("stiffness_max", "device", "float64", "largest stable stiffness K", "N/m", physical_only=True),
    Output(
        "virtual_damping_at_max", "device", "float64", "virtual damping B of that wall", "N s/m", physical_only=True
    ),
)
OUTPUTS = {output.name: output for output in _ALL}

RADIUS_OUTPUTS = frozenset({"spectral_radius", "margin", "decay_rate", "settling_time"})
MARGIN_OUTPUTS = frozenset({"gain_margin", "phase_margin", "delay_margin", "modulus_margin"})
"""NaN there means that the wall has no such margin, as `zwidth.margins` says."""

STATUS_OF: dict[Family, str] = {"wall": "status", "device": "ridge_status"}
"""The variable that says for each point of a family why it has the values it has."""


def status_flags() -> dict[str, Any]:
    """The CF description of a status."""
    meanings = [*(status.name.lower() for status in Status), "not_computed"]
    return {
        "long_name": "why a point has its values",
        "flag_values": [*(int(status) for status in Status), NOT_COMPUTED],
        "flag_meanings": " ".join(meanings),
    }
