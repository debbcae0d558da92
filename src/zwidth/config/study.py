"""Base class of the models of studies, and the registry of their kinds.

A study describes one computation. Its absent keys are supplied by the scene of the file (`Study.fill`) before
validation. Kinds differ in the devices that they accept: rigid masses with the backward difference only, or also
devices with parts (velocity filter, operator, coupling, actuator, modes, linear system, measured response).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar, get_args

from pydantic import GetJsonSchemaHandler, PrivateAttr
from pydantic_core import CoreSchema, PydanticCustomError

from zwidth.config.fields import LocatedProblem, Name, Strict, problem, quote_names
from zwidth.config.parts import NO_LINEAR_FORM, SIMULATED, list_parts
from zwidth.config.scenes import AnyScene, PhysicalDevice, PhysicalScene, SimulatedDevice, is_adaptive
from zwidth.config.values import Axis, get_system
from zwidth.units.unit_system import UnitSystem

MAX_POINTS = 150_000_000  # points per study, except sweeps
MAX_BYTES = 2**30  # bytes; estimated size of the result per study, except sweeps

KINDS: dict[str, type[Study]] = {}
"""Registered models of studies, by the name of their kind."""

_Kind = TypeVar("_Kind", bound="type[Study]")


def register(model: _Kind) -> _Kind:
    """Register the model of a kind of study, and return the model; to be used as a class decorator.

    The model is a subclass of `zwidth.studies.ComputedStudy`. Its field ``kind`` has the type ``Literal[NAME]``, where
    NAME is the name of the kind.
    """
    KINDS[model.kind_name()] = model
    if "noun" not in vars(model):
        model.noun = f"a {model.kind_name()} study"
    return model


def name_parts(parts: Iterable[str]) -> str:
    """Return the names of parts as text, joined by "and"; the part "device" is described instead of named."""
    return " and ".join("a system or response in place of its mass" if name == "device" else name for name in parts)


def make_parts_error(kind: str, parts: Iterable[str], remedy: str = "") -> PydanticCustomError:
    """Return the problem that a study of ``kind`` reports for a device with ``parts``, which it would ignore.

    ``remedy`` is an alternative to the use of another kind of study.
    """
    message = f"got a device with {name_parts(parts)}"
    allowed = f"the kind {kind!r} accepts only a rigid mass with the difference of two samples"
    kinds = f"use one of the kinds {quote_names(name for name in sorted(KINDS) if KINDS[name].takes_parts)}"
    return problem(message, allowed, f"{kinds}, or {remedy}" if remedy else kinds)


class Study(Strict):
    """Base of the models of all kinds of studies."""

    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d")  # fields whose default is the value of the file's scene
    # True if the kind accepts devices with parts; it then has a field ``device`` or ``devices``, or is a sweep.
    takes_parts: ClassVar[bool] = False
    simulates: ClassVar[bool] = False  # True if the kind accepts velocity estimates without a linear form (FOAW)
    method: ClassVar[str] = ""  # method and accuracy of the results, in a sentence for reports
    point_bytes: ClassVar[int] = 80  # approximate size of the result in bytes per point
    remedy_if_too_large: ClassVar[str] = "use fewer values on an axis, or split the study"

    name: Name
    """Name of the study, unique in the file; its results are stored under it."""

    _system: UnitSystem = PrivateAttr(default_factory=get_system)

    @property
    def unit_system(self) -> UnitSystem:
        """Unit system of the study's devices, linear or rotary."""
        return self._system

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Mark the fields that the scene supplies as optional, and describe their default."""
        reference = super().__get_pydantic_json_schema__(schema, handler)
        definition = handler.resolve_ref_schema(reference)
        definition["required"] = [name for name in definition.get("required", []) if name not in cls.from_scene]
        for field in (definition["properties"][name] for name in cls.from_scene):
            field["description"] += " Default: that of the scene."
        return reference

    @classmethod
    def kind_name(cls) -> str:
        """Return the name of the kind of study, the only literal in the type of the field ``kind``."""
        (name,) = get_args(cls.model_fields["kind"].annotation)
        return name

    @classmethod
    def explain_unknown(cls, name: str) -> tuple[str, str, str]:
        message, allowed, remedy = super().explain_unknown(name)
        return message, allowed, "write it at the top of the file" if name in ("figure", "scene") else remedy

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        """Return the mapping of a study, in which the scene supplies those keys of ``from_scene`` that are absent."""
        absent = cls._list_absent(raw)
        supplied: dict[str, Any] = {"delta": scene.delta, "d": scene.d}
        if isinstance(scene, PhysicalScene):
            supplied |= {"period": scene.period, "delay": scene.delay, "stiffness": scene.stiffness or None}
            supplied |= scene.hardware
            if "device" in absent:
                supplied["device"] = scene.without_wall(SimulatedDevice if cls.simulates else PhysicalDevice)
        if "devices" in absent:
            supplied["devices"] = [scene.without_wall()]
        return {**{name: supplied[name] for name in absent if supplied.get(name) is not None}, **raw}

    @classmethod
    def _list_absent(cls, raw: dict[str, Any]) -> list[str]:
        """Return the keys that the scene can supply and ``raw`` does not contain; ``rate`` counts as ``period``."""
        given = {*raw, "period"} if "rate" in raw else raw
        return [name for name in cls.from_scene if name not in given]

    @classmethod
    def check_parts(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        """Raise a problem if the study would take parameters from a scene with parts, but ignore the parts."""
        taken = cls._list_absent(raw)
        if taken and not cls.takes_parts and scene.nonrigid_parts:
            raise make_parts_error(
                cls.kind_name(), list_parts(scene), f"add {' and '.join(taken)} for a rigid mass without them"
            )

    @classmethod
    def check_estimate(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        """Raise a problem if the study needs a linear velocity estimate, but the scene that it uses has FOAW."""
        if (cls.takes_parts or cls._list_absent(raw)) and not cls.simulates and is_adaptive(scene):
            raise problem("got scene.velocity of kind 'foaw'", NO_LINEAR_FORM, SIMULATED)

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        if name == "device":
            return f"{cls.noun} needs a device in SI units", "give the scene mass and period"
        if name in cls.from_scene:
            return "a study needs it if the file has no scene", f"add {name!r}, or a scene"
        return super().explain_missing(name)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of points of the results along each dimension, by its name; by default one dimension per `Axis`."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: axis.size for name, axis in values.items() if isinstance(axis, Axis)}

    @property
    def points(self) -> int:
        """Approximate number of computed points."""
        return math.prod(self.sizes.values())

    @property
    def nbytes(self) -> int:
        """Approximate size of the result in bytes."""
        return self.points * self.point_bytes

    @property
    def extent(self) -> str:
        """Sizes of the grid as text for messages, such as "delta x d = 11 x 3"."""
        return f"{' x '.join(self.sizes) or 'one point'} = {' x '.join(map(str, self.sizes.values())) or 1}"

    def find_faults(self) -> Iterable[LocatedProblem]:
        if self.points <= MAX_POINTS and self.nbytes <= MAX_BYTES:
            return
        message = f"{self.extent} is {self.points:.4g} points and {self.nbytes / 2**30:.3g} GiB"
        allowed = f"at most {MAX_POINTS:.4g} points and {MAX_BYTES / 2**30:g} GiB per study"
        yield (), problem(message, allowed, self.remedy_if_too_large)
