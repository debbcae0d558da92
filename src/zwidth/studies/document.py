"""Model of whole configuration files, the functions that load them, and their JSON Schema.

A configuration has a version, a name, an optional scene and a list of studies. Before the studies are validated, the
scene supplies their absent keys. The kinds of studies are registered by the modules of this package, and by entry
points of other packages.
"""

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
from zwidth.analysis.scene import Scene
from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Name, Strict, find_kind, find_repeated, problem, require_entries
from zwidth.config.reader import read_model
from zwidth.config.scenes import AnyScene, NormalizedScene, PhysicalScene, SceneField, is_normalized, read_scene
from zwidth.config.study import KINDS, Study, register
from zwidth.config.values import Quantity
from zwidth.core.errors import InputError
from zwidth.model.wall import NoWall
from zwidth.units.formatting import describe
from zwidth.units.parsing import looks_like_number
from zwidth.units.quantities import Range

FORMAT_VERSION = 1  # version of the configuration format

# Import all modules of this package, because each one registers its kinds of studies.
for _module in iter_modules([str(Path(__file__).parent)], "zwidth.studies."):
    import_module(_module.name)


def _find_model(kind: Any) -> type[Study] | None:
    """Return the model of a kind of study, or None if no such kind exists.

    A kind that is not registered yet is loaded from the entry points ``zwidth.studies`` of other packages.
    """
    if isinstance(kind, str) and kind not in KINDS:
        for entry_point in entry_points(group="zwidth.studies", name=kind):
            register(entry_point.load())
    return KINDS.get(kind) if isinstance(kind, str) else None


def _read_study(raw: Any) -> Any:
    """Validate a study with the model of its kind, and return it; raise ``raw`` itself if it already is a problem."""
    if isinstance(raw, Study):
        return raw
    if isinstance(raw, PydanticCustomError):
        raise raw
    _find_model(raw.get("kind") if isinstance(raw, dict) else None)
    models = {kind: KINDS[kind] for kind in sorted(KINDS)}
    model = find_kind(raw, models, "a study", "'- kind: boundary' and its fields, or remove the entry")
    return model.model_validate(raw)


class _OfAnyKind:
    """Annotation that creates the JSON Schema of a study of any kind.

    It reads the registered kinds only when the schema is created, to include the kinds of other packages.
    """

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        every = Annotated[Union[tuple(KINDS[kind] for kind in sorted(KINDS))], Field(discriminator="kind")]  # noqa: UP007
        return handler(TypeAdapter[Any](every).core_schema)  # pyright: ignore[reportArgumentType]


_AnyStudy = Annotated[SerializeAsAny[Study], PlainValidator(_read_study), _OfAnyKind]


def _check_version(value: Any) -> int:
    """Return the version of the configuration format unchanged; raise a problem if this release cannot read it."""
    if value == FORMAT_VERSION and isinstance(value, int) and not isinstance(value, bool):
        return value
    remedy = f"write 'version: {FORMAT_VERSION}'"
    if isinstance(value, str) and looks_like_number(value):
        remedy = "drop the quotes"
    elif isinstance(value, int) and value > FORMAT_VERSION:
        remedy = "install a newer zwidth, or rewrite the file in version 1"
    raise problem(f"got {describe(value)}", f"this release reads version {FORMAT_VERSION} of the format", remedy)


@dataclass(frozen=True)
class _Location:
    """Folder of a configuration, excluded from comparisons, so that equal files in different folders are equal."""

    folder: Path = field(compare=False)


class FigureLook(Strict, noun="the look of figures"):
    """Width, format and resolution of the figures of a run."""

    width: Annotated[float, Quantity("m", Range(0.05, 0.5), turns=False)] | None = None
    """Width of every figure, in m or with a unit, such as 85 mm for a journal column; the font size does not change.
    Default: the usual width of each figure."""

    format: Literal["png", "svg", "pdf"] | None = None
    """Format of the files. Default: PNG and SVG."""

    dpi: Annotated[float, Quantity(allowed=Range(10, 2400))] | None = None
    """Resolution in dots per inch of PNG files, and of raster images in SVG and PDF files. Default: 180 for PNG."""

    @property
    def formats(self) -> tuple[str, ...]:
        """Formats in which each figure is saved, as extensions of the file names."""
        return ("png", "svg") if self.format is None else (self.format,)

    @property
    def size(self) -> tuple[float, None] | None:
        """Pair of the width in inches and None (the height follows from the width); None for the default size."""
        return None if self.width is None else (self.width / 0.0254, None)


class Config(Strict, noun="a configuration"):
    """A validated configuration file; the scene has supplied the absent keys of the studies."""

    version: Annotated[int, BeforeValidator(_check_version), WithJsonSchema({"const": FORMAT_VERSION})]
    """Version of the format, 1."""

    name: Name
    """Name of the configuration, and default name of the folder with the results."""

    description: str = ""
    """Free text."""

    scene: SceneField | None = None
    """Device, timing and wall, the default values of the studies. Default: none."""

    figure: FigureLook | None = None
    """Width, format and resolution of the studies' figures; for sweeps use the options of `zwidth figures`."""

    studies: Annotated[tuple[_AnyStudy, ...], WrapValidator(require_entries("studies"))]
    """Studies to compute, in this order."""

    _location: _Location = PrivateAttr(default_factory=lambda: _Location(find_file("").absolute()))

    @property
    def folder(self) -> Path:
        """Folder to which file names in the configuration are relative."""
        return self._location.folder

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        examples = {
            "version": f"version: {FORMAT_VERSION}",
            "name": "name: my_run",
            "studies": "studies: [{kind: boundary, name: first, delta: 0, d: 0}]",
        }
        remedy = f"add {examples[name]!r}"
        if name == "studies":
            for_scene = "'studies: [{kind: recommend, name: wall}]'"
            remedy = f"add {for_scene} for the scene of the file, or without one {examples[name]!r}"
        return "every configuration has version, name and studies", remedy

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Return the mapping of the file, in which the scene supplies the absent keys of the studies."""
        studies = raw.get("studies")
        if "scene" not in raw or not isinstance(studies, list | tuple):
            return raw
        scene = _read_scene_or_substitute(raw["scene"])
        return {**raw, "studies": [_fill_study(study, scene) for study in studies]}

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        studies = raw.get("studies")
        studies_given = studies if isinstance(studies, list | tuple) else ()
        names = [study.get("name") if isinstance(study, dict) else None for study in studies_given]
        for path, fault in find_repeated(
            names, "rename one", "names of studies are unique, because results are stored by name"
        ):
            yield ("studies", *path, "name"), fault


def _read_scene_or_substitute(raw: Any) -> AnyScene:
    """Return the scene of the file, or a valid substitute if the scene has faults.

    Without a substitute, the faults of the scene would cause further faults in every study.
    """
    # Ignore the faults here, because the validation of the key ``scene`` reports them.
    with suppress(ValueError):
        return read_scene(raw)
    if isinstance(raw, dict) and is_normalized(raw):
        return NormalizedScene(delta=0.0, alpha=0.0)
    return PhysicalScene.model_validate({"mass": 1.0, "period": 1.0, "stiffness": 0.0})


def _fill_study(study: Any, scene: AnyScene) -> Any:
    """Return the mapping of a study, in which the scene supplies the absent keys.

    A study of unknown kind is returned unchanged. If the kind does not accept the scene, the problem is returned in
    place of the study, and `_read_study` raises it.
    """
    model = _find_model(study.get("kind")) if isinstance(study, dict) else None
    if model is None:
        return study
    try:
        model.check_estimate(study, scene)
        model.check_parts(study, scene)
    except PydanticCustomError as error:
        # Return the problem instead of raising it, because pydantic adds the path of the study only to errors that
        # `_read_study` raises.
        return error
    return model.fill(study, scene)


def config_json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of configuration files, for editors.

    The schema does not contain all rules: only `load_config` checks units, conflicts between keys, and sizes.
    """
    shared: dict[str, Any] = {}
    schema = _simplify_schema(Config.model_json_schema(), shared)
    schema["$defs"] |= dict(sorted(shared.items()))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _simplify_schema(schema: Any, shared: dict[str, Any]) -> Any:
    """Return a JSON Schema without null types, and with references in place of shared subschemas.

    Null types are removed because a file never contains null: in the models, None represents an absent key. The
    subschemas that `share_schema` marked are moved to the dict ``shared``.
    """
    if isinstance(schema, list):
        return [_simplify_schema(item, shared) for item in schema if item != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    kept = {
        key: _simplify_schema(value, shared) for key, value in schema.items() if key != "default" or value is not None
    }
    if "shared" in kept:
        name = kept.pop("shared")
        return {"$ref": f"#/$defs/{name}"} if shared.setdefault(name, kept) == kept else kept
    for key in ("allOf", "anyOf"):
        # If the removal of null types leaves a single alternative, use this alternative in place of the list.
        if len(kept.get(key, ())) == 1:
            return {**kept.pop(key)[0], **kept}
    return kept


def load_config(path: str | bytes | os.PathLike[str]) -> Config:
    """Read and validate a configuration file.

    The file is YAML 1.2 (core schema): ``1e-3`` is a number, ``no`` and ``on`` are texts. Unknown keys, repeated keys,
    and values with a wrong unit or out of range are faults.

    Args:
        path: path of the file, at most 1 MiB of UTF-8 text.

    Returns:
        The configuration, immutable. The scene has supplied the absent keys of the studies.

    Raises:
        ConfigError: if the file cannot be read or has faults. The message has one line per fault, with file, line,
            column, field, value received, allowed values and remedy; the attribute ``faults`` lists them.

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
        ConfigError: if the file cannot be read or is invalid.
        InputError: if the file has no section ``scene``, or its scene is normalized.

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
            f"{os.fsdecode(path)}: scene: got normalized parameters; SI units are needed; write mass, damping, rate "
            "and delay instead of delta and d"
        )
    scene = given.to_scene()
    return scene if given.wall else dataclasses.replace(scene, wall=NoWall())
