"""Registry of quantities: every parameter and every output of a sweep, with unit, range, symbol and description.

Configurations, options of the command line, stores and figures are generated from the entries.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeAlias

from zwidth.words.status import Status
from zwidth.words.unit_system import UnitSystem


class Range(NamedTuple):
    """The admissible values of a number; the ends belong to it unless open."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def holds(self, value: Any) -> Any:
        """Whether finite values are admissible, elementwise."""
        above = value > self.low if self.low_open else value >= self.low
        if self.high == math.inf:
            return above
        return above & (value < self.high if self.high_open else value <= self.high)

    def __str__(self) -> str:
        ends = []
        if self.low > -math.inf:
            ends.append(f"{'greater than' if self.low_open else 'at least'} {self.low:g}")
        if self.high < math.inf:
            ends.append(f"{'less than' if self.high_open else 'at most'} {self.high:g}")
        return " and ".join(ends)


ANY = Range()
NOT_NEGATIVE = Range(low=0.0)
POSITIVE = Range(low=0.0, low_open=True)
FRACTION = Range(0.0, 1.0, low_open=True, high_open=True)
# Wide enough for any sampled loop, narrow enough that T^2 and 1/T^2 stay within float64.
PERIODS = Range(1e-12, 1e9)
RATES = Range(1e-9, 1e12)
# Range of the model: SI quantities, alpha and beta are 0 or of these magnitudes; largest delta and d.
SI_RANGE = (1e-30, 1e30)
WALL_RANGE = (1e-60, 1e60)
LARGEST_DAMPING = 1e12
LONGEST_DELAY = 1e5
SIZES = {"alpha": WALL_RANGE, "beta": WALL_RANGE, "delta": (0.0, LARGEST_DAMPING), "d": (0.0, LONGEST_DELAY)}
MAX_DELAY_PERIODS = 10_000.0  # longest delay in files; a longer one is a wrong unit
MOST_POLES = 4000  # largest degree for all poles, which takes minutes and 0.3 GB
# Stiffness of a recommended wall over that of the stiffest stable one.
RECOMMENDED_SHARE = 0.75


@dataclass(frozen=True)
class Parameter:
    """One quantity of the loop."""

    name: str  # in files and stores; of a part beside device and timing, with the part's name and a dot
    long_name: str  # what it is, for the readers of a store, of a schema and of the command line's help
    symbol: str  # in mathtext, without dollar signs
    allowed: Range  # its admissible values, in its unit
    unit: str = "1"  # SI base unit; "1" for a normalized quantity
    slider: tuple[float, float] | None = None  # where the explorer moves it, in its unit; None where it is no slider
    note: str = ""  # more for the readers of a schema and of the command line's help
    short_name: str = ""  # what a figure and the explorer call it, where that is another
    definition: str = ""  # of a normalized quantity, in mathtext
    whole: bool = False  # whether only whole numbers are admissible

    @cached_property
    def sign(self) -> Range:
        """The values that the model takes: files and axes have ends of their own beside it."""
        if self.allowed.low < 0:
            return ANY
        return POSITIVE if self.allowed.low > 0 or self.allowed.low_open else NOT_NEGATIVE

    @property
    def variable(self) -> str:
        """Its name in a store: CF has no dots in names."""
        return self.name.replace(".", "_")

    @property
    def words(self) -> str:
        """What a figure and the explorer call it."""
        return self.short_name or self.long_name

    def words_in(self, system: UnitSystem) -> str:
        """Return the name in figures; "inertia" replaces "mass" for rotary devices."""
        return self.words.replace("mass", "inertia") if system.rotary else self.words

    def symbol_in(self, system: UnitSystem) -> str:
        """Return the symbol in mathtext; J replaces m for rotary devices."""
        return re.sub(r"^m(?=_|$)", "J", self.symbol) if system.rotary else self.symbol

    def label_in(self, system: UnitSystem) -> str:
        """Return the label of a figure axis: name, symbol and definition."""
        definition = f" = {self.definition}" if self.definition else ""
        definition = definition.replace("/m", "/J") if system.rotary else definition
        return f"{self.words_in(system)}  ${self.symbol_in(system)}{definition}$"

    @property
    def sentence(self) -> str:
        """What it is, with a capital letter."""
        return self.long_name[0].upper() + self.long_name[1:]


MOST_MODES = 3  # modes in files, on axes and on the command line; in Python there is no limit


def _describe_mode(path: str, name: str, index: str) -> tuple[Parameter, ...]:
    """The numbers of a mode."""
    ratios = Range(0.0, 10.0, low_open=True)
    return (
        Parameter(f"{path}.frequency", f"frequency of {name}", f"f_{{{index}}}", POSITIVE, "Hz"),
        Parameter(f"{path}.damping_ratio", f"damping ratio of {name}", rf"\zeta_{{{index}}}", ratios),
        Parameter(f"{path}.mass", f"modal mass of {name}", f"m_{{{index}}}", ANY, "kg", note="negative beyond a node"),
    )


# In the order of a store's dimensions, the wall last, so that a plane of walls is contiguous.
_PARAMETERS = (
    Parameter("period", "sampling period T", "T", PERIODS, "s", (5e-5, 0.02), short_name="sampling period"),
    Parameter("rate", "sampling rate 1/T", "1/T", RATES, "Hz", None, "in place of the period", "sampling rate"),
    Parameter(
        "delay", "delay t_d from a sample to the moment its force acts", "t_d", NOT_NEGATIVE, "s", (0.0, 0.02),
        "or in sampling periods, as '1.5 periods'", "delay",
    ),
    Parameter("mass", "mass m of the device", "m", POSITIVE, "kg", (1e-3, 10.0), short_name="mass"),
    Parameter(
        "damping", "physical damping b of the device", "b", NOT_NEGATIVE, "N s/m", (0.0, 100.0),
        short_name="physical damping",
    ),
    Parameter(
        "d", "delay in sampling periods, t_d/T", "d", Range(0.0, MAX_DELAY_PERIODS), slider=(0.0, 10.0),
        short_name="delay in periods", definition="t_d/T",
    ),
    Parameter(
        "delta", "normalized damping of the device, b T/m", r"\delta", Range(0.0, LARGEST_DAMPING), slider=(0.0, 5.0),
        short_name="normalized physical damping", definition="b\\,T/m",
    ),
    Parameter(
        "velocity.cutoff", "cut-off of the velocity filter", "f_c", POSITIVE, "Hz", (1.0, 5e3),
        "below half the sampling rate", "cut-off",
    ),
    Parameter(
        "velocity.time_constant", "time constant of the velocity filter", r"\tau", POSITIVE, "s", (2e-5, 0.2),
        "in place of the cut-off", "time constant",
    ),
    Parameter(
        "velocity.samples", "window of the velocity estimate", "n", Range(1, 1000), slider=(1.0, 50.0),
        note="in sampling periods", short_name="window", whole=True,
    ),
    Parameter(
        "velocity.order", "order of the velocity filter", "n_f", Range(1, 8), slider=(1.0, 8.0),
        note="of a low-pass 1 or 2", short_name="filter order", whole=True,
    ),
    Parameter(
        "velocity.coded_period", "period written into the velocity estimate", "T_c", POSITIVE, "s",
        note="default: that of the loop", short_name="coded period",
    ),
    Parameter("operator.mass", "mass of the hand", "m_h", NOT_NEGATIVE, "kg", (0.0, 2.0), "> 0 behind a spring"),
    Parameter(
        "operator.damping", "damping of the hand to ground", "b_h", NOT_NEGATIVE, "N s/m", (0.0, 50.0),
        short_name="damping of the hand",
    ),
    Parameter(
        "operator.stiffness", "stiffness of the hand to ground", "k_h", NOT_NEGATIVE, "N/m", (0.0, 1e3),
        short_name="stiffness of the hand",
    ),
    Parameter(
        "operator.coupling_stiffness", "stiffness of the spring between hand and device", "k_g", POSITIVE, "N/m",
        (10.0, 100e3), "a rigid grasp where left out", "stiffness of the grasp",
    ),
    Parameter(
        "operator.coupling_damping", "damping of the damper between hand and device", "c_g", NOT_NEGATIVE, "N s/m",
        (0.0, 50.0), "beside that spring", "damping of the grasp",
    ),
    Parameter(
        "coupling.mass", "mass beyond the coupling of the device", "m_2", POSITIVE, "kg", (1e-3, 1.0),
        short_name="mass of the tip",
    ),
    Parameter("coupling.stiffness", "stiffness of the coupling", "k", POSITIVE, "N/m", (100.0, 1e6)),
    Parameter("coupling.damping", "damping of the coupling", "c", NOT_NEGATIVE, "N s/m", (0.0, 50.0)),
    Parameter(
        "actuator.cutoff", "corner frequency of the actuator", "f_a", POSITIVE, "Hz", (10.0, 5e3),
        short_name="corner of the actuator",
    ),
    Parameter(
        "actuator.time_constant", "time constant of the actuator", r"\tau_a", POSITIVE, "s", (2e-5, 0.02),
        "in place of the corner frequency", "time constant of the actuator",
    ),
    Parameter(
        "actuator.order", "order of the actuator", "n_a", Range(1, 2), note="1 or 2", whole=True,
    ),
    Parameter(
        "actuator.damping_ratio", "damping ratio of the actuator", r"\zeta_a", POSITIVE, slider=(0.05, 2.0),
        note="of second order",
    ),
    *(each for k in range(MOST_MODES) for each in _describe_mode(f"modes.{k}", f"mode {k}", str(k))),
    Parameter("stiffness", "stiffness K of the virtual wall", "K", ANY, "N/m", (0.0, 50e3), short_name="stiffness"),
    Parameter(
        "alpha", "normalized stiffness of the virtual wall, K T^2/m", r"\alpha", ANY, slider=(0.0, 1.0),
        short_name="normalized stiffness", definition=r"K\,T^2\!/m",
    ),
    Parameter(
        "virtual_damping", "damping B of the virtual wall", "B", ANY, "N s/m", (-20.0, 100.0),
        short_name="virtual damping",
    ),
    Parameter(
        "beta", "normalized damping of the virtual wall, B T/m", r"\beta", ANY, slider=(-0.5, 1.5),
        short_name="normalized virtual damping", definition="B\\,T/m",
    ),
)  # fmt: skip
PARAMETERS = {parameter.name: parameter for parameter in _PARAMETERS}
NORMALIZED = ("alpha", "beta", "delta", "d")
PHYSICAL = tuple(name for name in PARAMETERS if name not in NORMALIZED)
OF_PARTS = tuple(name for name in PARAMETERS if "." in name)  # paths of the parameters of parts, as in a scene
VARIABLES = {parameter.variable: parameter for parameter in _PARAMETERS}  # parameters by their names in a store
_NOISE = Parameter("velocity.noise", "largest error of a measured position", "", POSITIVE, "m", note="one count")
# Arguments of simulations.
_OF_MOTIONS = (
    Parameter(
        "start_position", "where the motion starts", "x_0", ANY, "m",
        note="the wall's surface is at 0 and positive is into the wall",
    ),
    Parameter("start_velocity", "its velocity there", "v_0", ANY, "m/s"),
    Parameter("push", "constant force of the hand on the device", "F", ANY, "N"),
    Parameter(
        "resolution", "one count of the encoder", r"\Delta", NOT_NEGATIVE, "m", short_name="resolution of the encoder"
    ),
    Parameter("noise", "standard deviation of the measured position", r"\sigma", NOT_NEGATIVE, "m"),
    Parameter("coulomb", "dry friction while the device slips", "F_c", NOT_NEGATIVE, "N", short_name="dry friction"),
    Parameter(
        "static", "dry friction that holds the device", "F_s", NOT_NEGATIVE, "N",
        note="at least coulomb, the default",
    ),
    Parameter("max_force", "the most that the motor gives", "F_m", POSITIVE, "N", note="without one no limit"),
    Parameter("max_rate", "the fastest that the command changes", "R_m", POSITIVE, "N/s", note="without one no limit"),
)  # fmt: skip
OF_MOTIONS = tuple(parameter.name for parameter in _OF_MOTIONS)
# Encoder, friction and motor: arguments of `zwidth.diagnose` and `zwidth.simulate`.
HARDWARE = ("resolution", "coulomb", "static", "max_force", "max_rate")
FIELDS = PARAMETERS | {each.name: each for each in (_NOISE, *_describe_mode("mode", "a mode", "i"), *_OF_MOTIONS)}
WALL = ("alpha", "beta", "stiffness", "virtual_damping")


class Choice(NamedTuple):
    """What a part has that is no number: one of a few names."""

    names: tuple[str, ...]
    sentence: str


_KINDS = ("backward_difference", "windowed_difference", "low_pass", "butterworth")
CHOICES = {
    "velocity.kind": Choice(_KINDS, "Velocity estimate; told by the options below where it can be"),
    "coupling.sensor": Choice(("motor", "tip"), "Where the position is measured; at the motor by default"),
}

OF_LOGS = {  # options of log files
    "time": "Time column: its header, or HEADER:ms; HEADER:s+HEADER:ns for two columns. Default: by the headers.",
    "position": "Column of the position: its header, or HEADER:mm, :counts, :deg.",
    "force": "Column of the commanded force: its header, or HEADER:mN; a torque with :mN m.",
    "resolution": "Encoder step, as 0.03mm, 0.09deg or '4000 counts/rev'.",
    "motor_constant": "What an ampere of a force in A makes, as 5N/A.",
}

Family: TypeAlias = Literal["wall", "device"]  # an output per wall, or per device and delay
# Color scales: truth values; numbers with a good and a bad side; other numbers; positive numbers; unbounded ones.
Look: TypeAlias = Literal["truth", "diverging", "sequential", "logarithmic", "steep"]
NOT_COMPUTED = 255  # status of points whose chunk does not exist yet; the other codes are those of `zwidth.Status`


@dataclass(frozen=True)
class Output:
    """One variable of a store."""

    name: str  # in files and stores
    long_name: str  # its definition, for the readers of a store
    symbol: str = ""  # what a figure writes behind its words, in mathtext
    look: Look = "truth"  # how its values become colors
    family: Family = "wall"
    dtype: Literal["bool", "float64", "uint8"] = "float64"
    units: str = "1"  # in a normalized sweep
    physical_units: str | None = None  # in a sweep over SI quantities; None where that is the same
    physical_only: bool = False  # whether a normalized sweep cannot have it
    with_parts: bool = False  # whether it is known of devices with a velocity filter, a hand or a coupling
    source: str = ""  # the output that it follows from at no cost; itself where left out
    rates: tuple[float, float] = (1e6, 10.0)  # points a second on one core, roughly: of rigid devices, and with parts
    label: str = ""  # what a figure calls it; its name where left out
    center: float = 0.0  # where a diverging quantity changes sides: the edge of what is stable or passive
    below: bool = False  # whether the good side lies below the center
    flags: dict[str, Any] = field(default_factory=dict)  # meanings of codes and truth values, by CF's attributes

    @property
    def words(self) -> str:
        """What a figure calls it."""
        return self.label or self.name.replace("_", " ")

    @property
    def logarithmic(self) -> bool:
        """Whether its axes and colors are in equal ratios; where it is 0 it has no place on them."""
        return self.look in ("logarithmic", "steep")

    def units_in(self, physical: bool) -> str:
        return self.physical_units if physical and self.physical_units else self.units


def _flags(values: list[int], meanings: str) -> dict[str, Any]:
    return {"flag_values": values, "flag_meanings": meanings}


_OUTPUTS = (
    Output(
        "stable", "whether every pole lies strictly inside the unit circle", dtype="bool", with_parts=True,
        rates=(3e8, 3e8), flags=_flags([0, 1], "unstable stable"),
    ),
    Output(
        "spectral_radius", "largest pole magnitude", r"\rho", "diverging", with_parts=True, rates=(1e6, 5e4),
        center=1.0, below=True,
    ),
    Output(
        "margin", "1 - spectral radius, positive for a stable wall", r"1 - \rho", "diverging", source="spectral_radius"
    ),
    Output(
        "decay_rate", "rate at which the slowest pole decays, -ln(spectral radius); negative where it grows",
        r"-\ln\rho", "diverging", units="1/period", physical_units="1/s", source="spectral_radius",
        label="rate of decay",
    ),
    Output(
        "gain_margin", "factor by which stiffness and damping together may grow; below 1: must fall", "g_m",
        "logarithmic", rates=(2e5, 0.0),
    ),
    Output(
        "phase_margin", "phase above -180 degrees at the gain crossover", r"\varphi_m", "diverging", units="degree",
        source="gain_margin",
    ),
    Output(
        "delay_margin", "delay that the wall bears beyond its own; 0 for an unstable wall", r"\tau_m", "logarithmic",
        units="sampling periods", physical_units="s", rates=(2e4, 0.0),
    ),
    Output(
        "modulus_margin", "least distance of the open loop from -1", "s_m", "sequential", rates=(2e4, 0.0)
    ),
    Output(
        "passive", "whether the wall is passive at its delay", dtype="bool", with_parts=True, rates=(4e6, 100.0),
        flags=_flags([0, 1], "not_passive passive"),
    ),
    Output(
        "passivity_margin", "physical damping in excess of what a passive wall needs, in units of delta", r"\delta",
        "diverging", source="passive", label="passivity margin, in units of",
    ),
    Output(
        "settling_time",
        "time in which the slowest pole decays to 2 %, ln(50)/decay_rate; infinite for an unstable wall", r"t_{2\%}",
        "steep", units="sampling periods", physical_units="s", source="spectral_radius", label="decay time to 2 %",
    ),
    Output(
        "alpha_max", "largest normalized stiffness that some virtual damping makes stable", r"\alpha_{\max}",
        "logarithmic", "device", label="maximum stable stiffness",
    ),
    Output(
        "beta_at_max", "normalized virtual damping of that wall", r"\beta", "sequential", "device",
        source="alpha_max", label="virtual damping of that wall",
    ),
    Output(
        "kind", "kind of that optimum: smooth, or a corner with a double pole at z = -1", family="device",
        dtype="uint8", source="alpha_max", flags=_flags([0, 1, NOT_COMPUTED], "smooth corner unknown"),
    ),
    Output(
        "stiffness_max", "largest stable stiffness K", r"K_{\max}", "logarithmic", "device", units="N/m",
        physical_only=True, with_parts=True, source="alpha_max", label="maximum stable stiffness",
    ),
    Output(
        "virtual_damping_at_max", "virtual damping B of that wall", "B", "sequential", "device", units="N s/m",
        physical_only=True, with_parts=True, source="alpha_max", label="virtual damping of that wall",
    ),
)  # fmt: skip
OUTPUTS = {output.name: output for output in _OUTPUTS}

RADIUS_OUTPUTS = frozenset(name for name, output in OUTPUTS.items() if "spectral_radius" in (name, output.source))
# NaN means that the wall has no such margin (`zwidth.margins`).
MARGIN_OUTPUTS = frozenset({"gain_margin", "phase_margin", "delay_margin", "modulus_margin"})
OUTPUTS_WITH_PARTS = tuple(name for name, output in OUTPUTS.items() if output.with_parts)

# Name of the status variable of each family.
STATUS_OF: dict[Family, str] = {"wall": "status", "device": "ridge_status"}


def status_flags() -> dict[str, Any]:
    codes = [*(int(status) for status in Status), NOT_COMPUTED]
    meanings = " ".join([*(status.name.lower() for status in Status), "not_computed"])
    return {"long_name": "why a point has its values", **_flags(codes, meanings)}
