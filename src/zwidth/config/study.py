"""A study as a configuration describes it: what all kinds have in common."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar, get_args

from pydantic import GetJsonSchemaHandler, PrivateAttr
from pydantic_core import CoreSchema, PydanticCustomError

from zwidth.config.fields import LocatedProblem, Name, Strict, listing, problem
from zwidth.config.parts import NO_LINEAR_FORM, SIMULATED, list_parts
from zwidth.config.scenes import AnyScene, PhysicalDevice, PhysicalScene, SimulatedDevice, is_adaptive
from zwidth.config.values import Axis, get_system
from zwidth.words.unit_system import UnitSystem

MAX_POINTS = 150_000_000
MAX_BYTES = 2**30

KINDS: dict[str, type[Study]] = {}
"""The models of the studies by the name of their kind."""

_Kind = TypeVar("_Kind", bound="type[Study]")


def register(model: _Kind) -> _Kind:
    """Register a kind of study, a `zwidth.studies.ComputedStudy` whose field ``kind`` has one literal: its name."""
    KINDS[model.kind_name()] = model
    if "what" not in vars(model):
        model.what = f"a {model.kind_name()} study"
    return model


def name_parts(parts: Iterable[str]) -> str:
    """Return names of parts in words; the part "device" is a system or response in place of a mass."""
    return " and ".join("a system or response in place of its mass" if name == "device" else name for name in parts)


def refuse_parts(kind: str, parts: Iterable[str], remedy: str = "") -> PydanticCustomError:
    """Return the problem of a device with parts in a study that would ignore them."""
    what = f"got a device with {name_parts(parts)}"
    allowed = f"the kind {kind!r} answers for a rigid mass with the difference of two samples alone"
    kinds = f"use one of the kinds {listing(name for name in sorted(KINDS) if KINDS[name].takes_parts)}"
    return problem(what, allowed, f"{kinds}, or {remedy}" if remedy else kinds)


class Study(Strict):
    """Base of all studies."""

    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d")  # fields whose default is the value of the file's scene
    # True if it computes devices with a velocity filter, a hand or another part; it then has the field device.
    takes_parts: ClassVar[bool] = False
    simulates: ClassVar[bool] = False  # True if it accepts a velocity estimate without a linear form
    method: ClassVar[str] = ""  # method and errors of the results, in a sentence for reports
    point_bytes: ClassVar[int] = 80  # approximate size of the result in bytes per point
    remedy_if_too_large: ClassVar[str] = "use fewer values on an axis, or split the study"

    name: Name
    """Name of the study, unique in the file; its results are stored under it."""

    _system: UnitSystem = PrivateAttr(default_factory=get_system)

    @property
    def unit_system(self) -> UnitSystem:
        """The unit system of the study's devices."""
        return self._system

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Mark the fields that the scene supplies as optional, and describe their default."""
        found = super().__get_pydantic_json_schema__(schema, handler)
        own = handler.resolve_ref_schema(found)
        own["required"] = [name for name in own.get("required", []) if name not in cls.from_scene]
        for field in (own["properties"][name] for name in cls.from_scene):
            field["description"] += " Default: that of the scene."
        return found

    @classmethod
    def kind_name(cls) -> str:
        """Return the name of the kind, the only literal of the field ``kind``."""
        (name,) = get_args(cls.model_fields["kind"].annotation)
        return name

    @classmethod
    def unknown(cls, name: str) -> tuple[str, str, str]:
        what, allowed, remedy = super().unknown(name)
        return what, allowed, "write it at the top of the file" if name in ("figure", "scene") else remedy

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        """Return the keys of a study with absent ones supplied by the scene."""
        absent = cls._list_absent(raw)
        supplied: dict[str, Any] = {"delta": scene.delta, "d": scene.d}
        if isinstance(scene, PhysicalScene):
            supplied |= {"period": scene.period, "delay": scene.delay, "stiffness": scene.stiffness or None}
            supplied |= scene.hardware
            if "device" in absent:
                supplied["device"] = scene.bare(SimulatedDevice if cls.simulates else PhysicalDevice)
        if "devices" in absent:
            supplied["devices"] = [scene.bare()]
        return {**{name: supplied[name] for name in absent if supplied.get(name) is not None}, **raw}

    @classmethod
    def _list_absent(cls, raw: dict[str, Any]) -> list[str]:
        """Return the absent keys that the scene supplies; a rate counts as a period."""
        given = {*raw, "period"} if "rate" in raw else raw
        return [name for name in cls.from_scene if name not in given]

    @classmethod
    def check_parts(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        """Raise a problem if the study would take parameters of the scene and ignore its parts."""
        taken = cls._list_absent(raw)
        if taken and not cls.takes_parts and scene.parts_beyond:
            raise refuse_parts(cls.kind_name(), list_parts(scene), f"give {' and '.join(taken)} here")

    @classmethod
    def check_estimate(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        """Raise a problem if the study takes parameters from a scene whose velocity estimate has no linear form."""
        if (cls.takes_parts or cls._list_absent(raw)) and not cls.simulates and is_adaptive(scene):
            raise problem("got scene.velocity of kind 'foaw'", NO_LINEAR_FORM, SIMULATED)

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        if name == "device":
            return f"{cls.what} needs a device in SI units", "give the scene mass and period"
        if name in cls.from_scene:
            return "a study needs it where the file has no scene to take it from", f"add {name!r}, or a scene"
        return super().missing(name)

    @property
    def sizes(self) -> dict[str, int]:
        """How many there are, by name, of what is combined with each other: values of the axes, or what a kind says."""
        known = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: axis.size for name, axis in known.items() if isinstance(axis, Axis)}

    @property
    def points(self) -> int:
        """About how many points are computed."""
        return math.prod(self.sizes.values())

    @property
    def nbytes(self) -> int:
        """About how many bytes the result has."""
        return self.points * self.point_bytes

    @property
    def extent(self) -> str:
        """What the number of points consists of, for messages."""
        return f"{' x '.join(self.sizes) or 'one point'} = {' x '.join(map(str, self.sizes.values())) or 1}"

    def limits(self) -> Iterable[LocatedProblem]:
        if self.points <= MAX_POINTS and self.nbytes <= MAX_BYTES:
            return
        what = f"{self.extent} is {self.points:.4g} points and {self.nbytes / 2**30:.3g} GiB"
        allowed = f"at most {MAX_POINTS:.4g} points and {MAX_BYTES / 2**30:g} GiB a study"
        yield (), problem(what, allowed, self.remedy_if_too_large)
