"""The configuration as a whole: its top level, the kinds of studies, and what the scene supplies to them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated, Any, Literal, Union

from pydantic import (
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    PlainValidator,
    PrivateAttr,
    SerializeAsAny,
    TypeAdapter,
    WithJsonSchema,
    WrapValidator,
)
from pydantic_core import CoreSchema, PydanticCustomError

import zwidth.config.sweep  # noqa: F401  (registers its kind)
from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Name, Strict, find_kind, members, problem, repeated
from zwidth.config.reader import read_model
from zwidth.config.scenes import AnyScene, NormalizedScene, PhysicalScene, SceneField, is_normalized, read_scene
from zwidth.config.study import KINDS, Study, register
from zwidth.config.values import Quantity
from zwidth.parts.wall import NoWall
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe
from zwidth.words.quantities import Range
from zwidth.words.units import looks_like_number

FORMAT_VERSION = 1


# Every file of this room registers the kind that it holds.
for _module in iter_modules([str(Path(__file__).parent)], "zwidth.studies."):
    import_module(_module.name)


def _find_model(kind: Any) -> type[Study] | None:
    """The model of a kind, which an installed package may bring: an entry point in the group ``zwidth.studies``."""
    if isinstance(kind, str) and kind not in KINDS:
        for found in entry_points(group="zwidth.studies", name=kind):
            register(found.load())
    return KINDS.get(kind) if isinstance(kind, str) else None


def _read_study(raw: Any) -> Any:
    """A validator that reads a mapping as the study that its kind names."""
    if isinstance(raw, Study):
        return raw
    if isinstance(raw, PydanticCustomError):
        raise raw
    _find_model(raw.get("kind") if isinstance(raw, dict) else None)
    known = {kind: KINDS[kind] for kind in sorted(KINDS)}
    model = find_kind(raw, known, "a study", "'- kind: boundary' and its fields, or remove the entry")
    return model.model_validate(raw)


class _OfAnyKind:
    """Describes a study of any kind; they are looked up when they are needed, so that more may be registered."""

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        every = Annotated[Union[tuple(KINDS[kind] for kind in sorted(KINDS))], Field(discriminator="kind")]  # noqa: UP007
        return handler(TypeAdapter[Any](every).core_schema)  # pyright: ignore[reportArgumentType]


_AnyStudy = Annotated[SerializeAsAny[Study], PlainValidator(_read_study), _OfAnyKind]


def _check_version(value: Any) -> int:
    if value == FORMAT_VERSION and isinstance(value, int) and not isinstance(value, bool):
        return value
    remedy = f"write 'version: {FORMAT_VERSION}'"
    if isinstance(value, str) and looks_like_number(value):
        remedy = "drop the quotes"
    elif isinstance(value, int) and value > FORMAT_VERSION:
        remedy = "install a newer zwidth, or rewrite the file in version 1"
    raise problem(f"got {describe(value)}", f"this release reads version {FORMAT_VERSION} of the format", remedy)


@dataclass(frozen=True)
class _Place:
    """Where a configuration stands, which makes it no other."""

    folder: Path = field(compare=False)


class FigureLook(Strict, what="the look of figures"):
    """How the figures of a run are written."""

    width: Annotated[float, Quantity("m", Range(0.05, 0.5), turns=False)] | None = None
    """Width of every figure, as 85 mm of a journal's column; type is no smaller for it."""

    format: Literal["png", "svg", "pdf"] | None = None
    """Format of the files. Default: PNG and SVG."""

    dpi: Annotated[float, Quantity(allowed=Range(10, 2400))] | None = None
    """Resolution in dots per inch of PNG files and of the maps in SVG and PDF files. Default: 180 for PNG."""

    @property
    def formats(self) -> tuple[str, ...]:
        """The endings of the files."""
        return ("png", "svg") if self.format is None else (self.format,)

    @property
    def size(self) -> tuple[float, None] | None:
        """The width in inches, to which heights follow."""
        return None if self.width is None else (self.width / 0.0254, None)


class Config(Strict, what="a configuration"):
    """A configuration file, checked and complete: every study holds the values that it runs with."""

    version: Annotated[int, BeforeValidator(_check_version), WithJsonSchema({"const": FORMAT_VERSION})]
    """Version of the format, 1."""

    name: Name
    """Name of the configuration, and by default of the folder for the results."""

    description: str = ""
    """Free text."""

    scene: SceneField | None = None
    """Device, timing and wall, the default values of the studies."""

    figure: FigureLook | None = None
    """Width, format and resolution of the studies' figures; for sweeps use the options of `zwidth figures`."""

    studies: Annotated[tuple[_AnyStudy, ...], WrapValidator(members("studies"))]
    """What to compute, in this order."""

    _place: _Place = PrivateAttr(default_factory=lambda: _Place(find_file("").absolute()))

    @property
    def folder(self) -> Path:
        """The folder to which file names in the configuration are relative."""
        return self._place.folder

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        examples = {
            "version": f"version: {FORMAT_VERSION}",
            "name": "name: my_run",
            "studies": "studies: [{kind: boundary, name: first, delta: 0, d: 0}]",
        }
        return "every configuration has version, name and studies", f"add {examples[name]!r}"

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Let the scene supply what the studies leave out."""
        studies = raw.get("studies")
        if "scene" not in raw or not isinstance(studies, list | tuple):
            return raw
        scene = _scene_or_stand_in(raw["scene"])
        return {**raw, "studies": [_fill_study(study, scene) for study in studies]}

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        studies = raw.get("studies")
        given = studies if isinstance(studies, list | tuple) else ()
        names = [study.get("name") if isinstance(study, dict) else None for study in given]
        for place, what in repeated(names, "rename one", "results are kept by name, so each study has its own"):
            yield ("studies", *place, "name"), what


def _scene_or_stand_in(raw: Any) -> AnyScene:
    """The file's scene; where it is faulty, one that only keeps its faults from repeating in every study."""
    # Its faults are reported where the scene itself is read.
    with suppress(ValueError):
        return read_scene(raw)
    if isinstance(raw, dict) and is_normalized(raw):
        return NormalizedScene(delta=0.0, alpha=0.0)
    return PhysicalScene.model_validate({"mass": 1.0, "period": 1.0, "stiffness": 0.0})


def _fill_study(study: Any, scene: AnyScene) -> Any:
    """A study's mapping with what the scene supplies; anything else as it is."""
    model = _find_model(study.get("kind")) if isinstance(study, dict) else None
    if model is None:
        return study
    try:
        model.check_estimate(study, scene)
        model.check_parts(study, scene)
    except PydanticCustomError as refusal:
        # Raised where the study is read, at its place in the file.
        return refusal
    return model.fill(study, scene)


def config_json_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of configuration files, for editors.

    A first help: units, conflicts between keys and sizes are checked by `load_config` alone.
    """
    shared: dict[str, Any] = {}
    schema = _tidy(Config.model_json_schema(), shared)
    schema["$defs"] |= dict(sorted(shared.items()))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _tidy(schema: Any, shared: dict[str, Any]) -> Any:
    """The schema without null, which stands for "not given" in the models and is never written in a file."""
    # What is to be shared is moved to ``shared``, and a reference takes its place.
    if isinstance(schema, list):
        return [_tidy(item, shared) for item in schema if item != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    kept = {key: _tidy(value, shared) for key, value in schema.items() if key != "default" or value is not None}
    if "shared" in kept:
        name = kept.pop("shared")
        return {"$ref": f"#/$defs/{name}"} if shared.setdefault(name, kept) == kept else kept
    for key in ("allOf", "anyOf"):
        # One form alone is no choice.
        if len(kept.get(key, ())) == 1:
            return {**kept.pop(key)[0], **kept}
    return kept


def load_config(path: str | bytes | os.PathLike[str]) -> Config:
    """Read a configuration file and check all of it.

    The file is YAML 1.2 (core schema): ``1e-3`` is a number, ``no`` and ``on`` are texts. Unknown keys,
    repeated keys and values in the wrong unit or out of range are faults; nothing is guessed.

    Args:
        path: the file, at most 1 MiB of UTF-8.

    Returns:
        The configuration, frozen. What a study leaves out and the scene knows is filled in.

    Raises:
        ConfigError: the file cannot be read or has faults. The message has one line for each fault, with file,
            line, column, field, the value received, what is allowed and the remedy; ``.faults`` lists them.

    Example:
        >>> import pathlib, tempfile
        >>> from zwidth.studies.document import load_config
        >>> text = "{version: 1, name: a, studies: [{kind: ridge, name: r, delta: 0.1, d: [0, 1]}]}"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder, "a.yaml")
        ...     _ = file.write_text(text)
        ...     load_config(file).studies[0].d.values()
        array([0., 1.])
    """
    return read_model(path, Config)


def load_scene(path: str | bytes | os.PathLike[str]) -> Scene:
    """Return the scene of a configuration file: device, timing, parts and wall; its studies are ignored.

    Args:
        path: path of the file, as in `zwidth.load_config`.

    Returns:
        A `zwidth.Scene` in SI units; without a wall if the file gives neither stiffness nor virtual damping.

    Raises:
        ConfigError: the file cannot be read or is invalid.
        InputError: the file has no section ``scene``, or its scene is normalized.

    Example:
        >>> import pathlib, tempfile
        >>> import zwidth
        >>> text = "{version: 1, name: a, scene: {mass: 100 g, rate: 1 kHz}, studies: [{kind: ridge, name: r}]}"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder, "a.yaml")
        ...     _ = file.write_text(text)
        ...     zwidth.load_scene(file).timing
        Timing(period=0.001)
    """
    given = load_config(path).scene
    if given is None:
        raise InputError(
            f"{os.fsdecode(path)}: scene: missing; add a section 'scene' with mass, damping, rate and delay"
        )
    if isinstance(given, NormalizedScene):
        raise InputError(
            f"{os.fsdecode(path)}: scene: got normalized parameters; SI units are needed, write mass, damping, rate "
            "and delay in place of delta and d"
        )
    scene = given.to_scene()
    return scene if given.wall else dataclasses.replace(scene, wall=NoWall())
