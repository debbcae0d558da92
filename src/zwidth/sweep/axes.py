"""The axes of a sweep: the values that each parameter takes, alone or together with others in a table of devices."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar

from pydantic import Field, create_model

from zwidth.config.axes import Axis, axis_of
from zwidth.config.device_table import TableField
from zwidth.config.faults import LocatedProblem, listing, problem
from zwidth.config.fields import Strict, describe_parameter
from zwidth.config.scenes import find_second_period
from zwidth.words.quantities import NORMALIZED, OF_PARTS, PARAMETERS, PHYSICAL, WALL


def _axis_field(name: str) -> tuple[Any, Any]:
    if name == "devices":
        rows = "Parameters that move together, one row a device: lists of equal length, or a CSV file."
        return TableField | None, Field(default=None, description=rows)  # pyright: ignore[reportOperatorIssue]
    axis: Any = Annotated[Axis, axis_of(name)]
    words = describe_parameter(PARAMETERS[name]) + ("." if name in WALL else "; the scene's where left out.")
    return axis | None, Field(default=None, description=words)


# In the order in which a store keeps what was asked of it.
_OF_WALL, _OF_DEVICE = ("stiffness", "virtual_damping"), ("mass", "damping", "period", "rate", "delay")
_FIELDS: Any = {name: _axis_field(name) for name in (*OF_PARTS, "devices", *NORMALIZED, *_OF_WALL, *_OF_DEVICE)}
# Some of the names have dots, which a class body cannot have.
_Axes: Any = create_model("_Axes", __base__=Strict, **_FIELDS)


class Axes(_Axes):
    """The parameters of a sweep and the values that each of them takes."""

    what: ClassVar[str] = "the axes of a sweep"

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        return _mixed([key for key in raw if key in PARAMETERS], "axes")

    def limits(self) -> Iterable[LocatedProblem]:
        """A parameter that is both an axis and a column, and kinds that only the table's columns show."""
        columns = tuple(self.devices.columns) if self.devices else ()
        own = [name for name in PARAMETERS if getattr(self, name) is not None]
        for name in own:
            if name in columns:
                twice = "given twice, as an axis and as a column of devices"
                yield (name,), problem(twice, "each parameter once", "remove one")
        if columns and not any(name in columns for name in own):
            yield from ((("devices",), what) for _, what in _mixed([*own, *columns], "axes and devices together"))

    @property
    def given(self) -> tuple[str, ...]:
        """The parameters that are axes or columns, in the order of a store's dimensions."""
        columns = self.devices.columns if self.devices else {}
        return tuple(name for name in PARAMETERS if name in columns or getattr(self, name) is not None)

    @property
    def given_of_parts(self) -> tuple[str, ...]:
        """Those of them that belong to a velocity filter, a hand or a coupling."""
        return tuple(name for name in self.given if name in OF_PARTS)

    @property
    def physical(self) -> bool:
        """Whether the parameters are SI quantities."""
        return any(name in PHYSICAL for name in self.given)

    @property
    def delay_in_periods(self) -> bool:
        """Whether the delays count sampling periods."""
        source = self.devices if self.delay is None else self.delay
        return source is not None and source.in_periods

    @property
    def sizes(self) -> dict[str, int]:
        """The dimensions, slow ones first; a single number is none."""
        sizes = {"device": self.devices.size} if self.devices else {}
        for name in PARAMETERS:
            axis = getattr(self, name)
            if axis is not None and axis.form != "number":
                sizes[name] = axis.size
        return sizes

    def ends(self, name: str) -> tuple[float, float]:
        """The smallest and the largest value of a parameter."""
        source = self.devices.columns[name] if self.place(name) == "devices" else getattr(self, name).entries
        return min(source), max(source)

    def place(self, name: str) -> str:
        """The key below which a parameter is given."""
        return "devices" if getattr(self, name) is None else name

    @property
    def most_periods(self) -> float:
        """The longest delay in the shortest periods."""
        if "d" in self.given:
            return self.ends("d")[1]
        if "delay" not in self.given:
            return 0.0
        longest = self.ends("delay")[1]
        if self.delay_in_periods:
            return longest
        return longest * (self.ends("rate")[1] if "rate" in self.given else 1.0 / self.ends("period")[0])


def _mixed(keys: list[str], where: str) -> Iterable[LocatedProblem]:
    """What is wrong with a set of parameters."""
    if not keys:
        return
    physical = keys[0] in PHYSICAL
    for key in keys:
        if (key in PHYSICAL) != physical:
            kinds = "physical key, after normalized ones" if not physical else "normalized key, after physical ones"
            allowed = f"{where} are in SI units or normalized, never both"
            remedy = f"choose from {listing(PHYSICAL if physical else NORMALIZED)}"
            yield (key,), problem(kinds, allowed, remedy, on_key=True)
    yield from find_second_period(keys)
