"""Registry of quantities: all parameters of scenes, with unit, range, symbol and description.

The keys of configurations, the options of the command line, the variables of stores, and the labels of figures and of
the explorer are generated from the entries. Descriptions are noun phrases; a note adds conditions and the default.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from zwidth.units.unit_system import UnitSystem


class Range(NamedTuple):
    """An interval of allowed values; an end is included unless it is open."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False

    def holds(self, value: Any) -> Any:
        """Return whether finite values are in the interval, elementwise."""
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
# These ranges are wide enough for any sampled loop, and T^2 and 1/T^2 neither overflow nor underflow in them.
PERIODS = Range(1e-12, 1e9)  # allowed sampling periods in s
RATES = Range(1e-9, 1e12)  # allowed sampling rates in Hz
# Ranges of the parameters in which results are computed.
SI_RANGE = (1e-30, 1e30)  # magnitudes of nonzero quantities in SI units
WALL_RANGE = (1e-60, 1e60)  # magnitudes of nonzero normalized stiffness alpha and normalized virtual damping beta
LARGEST_DAMPING = 1e12  # largest normalized physical damping delta
LONGEST_DELAY = 1e5  # longest delay d, in periods
# Smallest and largest magnitude of the nonzero values of each normalized parameter.
SIZES = {"alpha": WALL_RANGE, "beta": WALL_RANGE, "delta": (0.0, LARGEST_DAMPING), "d": (0.0, LONGEST_DELAY)}
MAX_DELAY_PERIODS = 10_000.0  # longest delay in files, in periods; a longer one indicates a wrong unit
MOST_POLES = 4000  # largest number of poles that are computed; so many take minutes and 0.3 GB
RECOMMENDED_SHARE = 0.75  # stiffness of a recommended wall, relative to the stiffest stable wall


@dataclass(frozen=True)
class Parameter:
    """A parameter of a scene."""

    name: str  # path in files and stores, such as "mass" or "coupling.mass"
    long_name: str  # description, a noun phrase, in stores, in the schema and in help texts
    symbol: str  # symbol of the quantity, in mathtext without dollar signs
    allowed: Range  # range of allowed values, in the unit of the parameter
    unit: str = "1"  # SI unit on a linear device; "1" for a quantity without unit
    slider: tuple[float, float] | None = None  # range of its slider in the explorer; None without a slider
    note: str = ""  # conditions and default, in the schema and in help texts
    short_name: str = ""  # name in figures and in the explorer, if it differs from ``long_name``
    definition: str = ""  # definition of a normalized quantity, in mathtext
    whole: bool = False  # True if only integers are allowed

    @cached_property
    def sign(self) -> Range:
        """The part of the range that concerns the sign: any value, >= 0 or > 0.

        Functions in Python check only the sign, because the full range is meant for configuration files.
        """
        if self.allowed.low < 0:
            return ANY
        return POSITIVE if self.allowed.low > 0 or self.allowed.low_open else NOT_NEGATIVE

    @property
    def unit_words(self) -> str:
        """The unit in texts: "" for a quantity without unit, and rad/s for a bandwidth."""
        return {"1": "", "1/s": "rad/s"}.get(self.unit, self.unit)

    @property
    def variable(self) -> str:
        """The name of the variable in a store, without dots, because the CF conventions do not allow them."""
        return self.name.replace(".", "_")

    @property
    def words(self) -> str:
        """The name in figures and in the explorer."""
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
        """The description, beginning with a capital letter."""
        return self.long_name[0].upper() + self.long_name[1:]


MOST_MODES = 3  # largest number of modes in files, on axes of sweeps and on the command line; Python has no limit


def _describe_mode(path: str, name: str, index: str) -> tuple[Parameter, ...]:
    """Return the parameters of a structural mode: frequency, damping ratio and modal mass.

    Args:
        path: first part of the dotted paths of the parameters, such as "modes.0".
        name: name of the mode in the descriptions.
        index: subscript of the symbols.
    """
    ratios = Range(0.0, 10.0, low_open=True)
    return (
        Parameter(f"{path}.frequency", f"frequency of {name}", f"f_{{{index}}}", POSITIVE, "Hz"),
        Parameter(f"{path}.damping_ratio", f"damping ratio of {name}", rf"\zeta_{{{index}}}", ratios),
        Parameter(
            f"{path}.mass",
            f"modal mass of {name}",
            f"m_{{{index}}}",
            ANY,
            "kg",
            note="< 0 if actuator and sensor move in opposite directions",
        ),
    )


# The parameters have the order of the dimensions of a store. Those of the wall are last, so that the results for all
# walls of one device are contiguous in memory.
_PARAMETERS = (
    Parameter("period", "sampling period T", "T", PERIODS, "s", (5e-5, 0.02), short_name="sampling period"),
    Parameter("rate", "sampling rate 1/T", "1/T", RATES, "Hz", None, "instead of the period", "sampling rate"),
    Parameter(
        "delay", "delay t_d from a sample to the start of its force", "t_d", NOT_NEGATIVE, "s", (0.0, 0.02),
        "also in sampling periods, e.g. '1.5 periods'", "delay",
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
        "velocity.cutoff", "cut-off frequency of the velocity filter", "f_c", POSITIVE, "Hz", (1.0, 5e3),
        "below half the sampling rate", "cut-off frequency",
    ),
    Parameter(
        "velocity.time_constant", "time constant of the velocity filter", r"\tau", POSITIVE, "s", (2e-5, 0.2),
        "instead of the cut-off frequency", "time constant",
    ),
    Parameter(
        "velocity.samples", "length of the window of the velocity estimate", "n", Range(1, 1000), slider=(1.0, 50.0),
        note="in sampling periods", short_name="window", whole=True,
    ),
    Parameter(
        "velocity.order", "order of the velocity filter", "n_f", Range(1, 8), slider=(1.0, 8.0),
        note="for a low-pass 1 (default) or 2, for a Butterworth filter 1 to 8 (default 2)", short_name="filter order",
        whole=True,
    ),
    Parameter(
        "velocity.coded_period", "sampling period in the formula of the velocity estimate", "T_c", POSITIVE, "s",
        note="default: the period of the loop", short_name="coded period",
    ),
    Parameter(
        "operator.mass", "mass of the hand", "m_h", NOT_NEGATIVE, "kg", (0.0, 2.0),
        "default: 0, but > 0 if a coupling stiffness is given",
    ),
    Parameter(
        "operator.damping", "damping of the hand to ground", "b_h", NOT_NEGATIVE, "N s/m", (0.0, 50.0), "default: 0",
        short_name="damping of the hand",
    ),
    Parameter(
        "operator.stiffness", "stiffness of the hand to ground", "k_h", NOT_NEGATIVE, "N/m", (0.0, 1e3), "default: 0",
        short_name="stiffness of the hand",
    ),
    Parameter(
        "operator.coupling_stiffness", "stiffness of the spring between hand and device", "k_g", POSITIVE, "N/m",
        (10.0, 100e3), "default: a rigid grasp", "stiffness of the grasp",
    ),
    Parameter(
        "operator.coupling_damping", "damping between hand and device", "c_g", NOT_NEGATIVE, "N s/m",
        (0.0, 50.0), "only together with a coupling stiffness, default: 0", "damping of the grasp",
    ),
    Parameter(
        "coupling.mass", "mass of the tip, coupled to the mass of the device", "m_2", POSITIVE, "kg", (1e-3, 1.0),
        short_name="mass of the tip",
    ),
    Parameter("coupling.stiffness", "stiffness of the coupling", "k", POSITIVE, "N/m", (100.0, 1e6)),
    Parameter("coupling.damping", "damping of the coupling", "c", NOT_NEGATIVE, "N s/m", (0.0, 50.0), "default: 0"),
    Parameter(
        "actuator.cutoff", "corner frequency of the actuator", "f_a", POSITIVE, "Hz", (10.0, 5e3),
        short_name="corner frequency of the actuator",
    ),
    Parameter(
        "actuator.time_constant", "time constant of the actuator", r"\tau_a", POSITIVE, "s", (2e-5, 0.02),
        "instead of the corner frequency", "time constant of the actuator",
    ),
    Parameter(
        "actuator.order", "order of the actuator", "n_a", Range(1, 2), note="1 or 2, default: 1", whole=True,
    ),
    Parameter(
        "actuator.damping_ratio", "damping ratio of the actuator", r"\zeta_a", POSITIVE, slider=(0.05, 2.0),
        note="for order 2 only, default: sqrt(1/2)",
    ),
    *(each for k in range(MOST_MODES) for each in _describe_mode(f"modes.{k}", f"mode {k}", str(k))),
    Parameter(
        "position.coefficient", "coefficient a of the exponential filter", "a", Range(0.0, 1.0, low_open=True),
        slider=(0.01, 1.0), note="instead of the cut-off frequency", short_name="coefficient",
    ),
    Parameter(
        "position.cutoff", "cut-off frequency of the position filter", "f_p", POSITIVE, "Hz", (1.0, 5e3),
        short_name="cut-off frequency",
    ),
    Parameter(
        "position.time_constant", "time constant of the position filter", r"\tau_p", POSITIVE, "s", (2e-5, 0.2),
        short_name="time constant",
    ),
    Parameter(
        "position.order", "order of the position filter", "n_p", Range(1, 8), slider=(1.0, 8.0), whole=True,
        short_name="filter order",
    ),
    Parameter("position.coded_period", "sampling period in the formula of the position filter", "T_p", POSITIVE, "s"),
    Parameter(
        "position.bandwidth", "bandwidth of the phase-locked loop", r"\omega_p", POSITIVE, "1/s", (10.0, 1e4),
        short_name="bandwidth",
    ),
    Parameter("feedback.gain", "integral gain", "k_i", ANY, "N/(m s)", (0.0, 1e5)),
    Parameter("feedback.position", "weight of the position estimate in the input of the feedback", "w_p", ANY),
    Parameter("feedback.velocity", "weight of the velocity estimate in the input of the feedback", "w_v", ANY),
    Parameter("tool.mass", "mass of the simulated tool", "M", POSITIVE, "kg", (1e-3, 2.0), "", "mass of the tool"),
    Parameter("tool.damping", "damping of the simulated tool", "c_t", NOT_NEGATIVE, "N s/m", (0.0, 9.0), "default 0"),
    Parameter("tool.stiffness", "stiffness of the simulated tool", "k_t", NOT_NEGATIVE, "N/m", (0.0, 1e3), "default 0"),
    Parameter(
        "tool.every", "sampling periods per step of the simulated tool", "N", Range(1, 1000),
        note="> 1 for a physics engine that is slower than the control program; default 1", whole=True,
    ),
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
OF_PARTS = tuple(name for name in PARAMETERS if "." in name)  # paths of the parameters of velocity estimate and parts
VARIABLES = {parameter.variable: parameter for parameter in _PARAMETERS}  # parameters by their names in a store
_NOISE = Parameter(
    "velocity.noise", "largest error of the measured position", "", POSITIVE, "m", note="one count of an encoder"
)
# Parameters of simulations.
_OF_MOTIONS = (
    Parameter(
        "start_position", "initial position", "x_0", ANY, "m",
        note="the surface of the wall is at 0, and positions inside the wall are positive",
    ),
    Parameter("start_velocity", "initial velocity", "v_0", ANY, "m/s"),
    Parameter("external_force", "constant external force on the device", "F", ANY, "N"),
    Parameter(
        "resolution", "resolution of the encoder, one count", r"\Delta", NOT_NEGATIVE, "m",
        short_name="resolution of the encoder",
    ),
    Parameter("noise", "standard deviation of the noise of the measured position", r"\sigma", NOT_NEGATIVE, "m"),
    Parameter(
        "coulomb", "Coulomb friction while the device moves", "F_c", NOT_NEGATIVE, "N", short_name="Coulomb friction"
    ),
    Parameter(
        "static", "static friction, the largest friction force at rest", "F_s", NOT_NEGATIVE, "N",
        note="at least coulomb, default: coulomb",
    ),
    Parameter("max_force", "largest force of the motor", "F_m", POSITIVE, "N", note="default: no limit"),
    Parameter(
        "max_rate", "largest rate of change of the commanded force", "R_m", POSITIVE, "N/s", note="default: no limit"
    ),
)  # fmt: skip
OF_MOTIONS = tuple(parameter.name for parameter in _OF_MOTIONS)
# Names of the parameters of encoder, friction and motor, which are arguments of `zwidth.diagnose` and
# `zwidth.simulate`.
HARDWARE = ("resolution", "coulomb", "static", "max_force", "max_rate")
FIELDS = PARAMETERS | {each.name: each for each in (_NOISE, *_describe_mode("mode", "a mode", "i"), *_OF_MOTIONS)}
WALL = ("alpha", "beta", "stiffness", "virtual_damping")


class Choice(NamedTuple):
    """A parameter whose value is one of several names."""

    names: tuple[str, ...]
    sentence: str


_KINDS = ("backward_difference", "windowed_difference", "low_pass", "butterworth")
CHOICES = {
    "velocity.kind": Choice(_KINDS, "Velocity estimate; default: implied by the options below"),
    "position.kind": Choice(
        ("exponential", "low_pass", "butterworth", "pll"), "Position estimate; default: implied by the options below"
    ),
    "position.velocity_from": Choice(
        ("position", "measured"), "Input of the velocity estimate: filtered or measured position; default: position"
    ),
    "feedback.rule": Choice(
        ("backward", "forward", "trapezoidal"), "Rule of integration of the integral gain; default: backward"
    ),
    "coupling.sensor": Choice(("motor", "tip"), "Location of the position sensor; default: motor"),
    "tool.integrator": Choice(("semi-implicit", "implicit"), "Euler method of the tool; default: semi-implicit"),
}
