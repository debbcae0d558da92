"""The configuration as a whole: its top level, and what the scene supplies to the studies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, TypeAlias

from pydantic import BeforeValidator, Field, WithJsonSchema, WrapValidator

from zwidth.sweep.devices import AnyScene, NormalizedScene, PhysicalScene, SceneField, is_normalized, read_scene
from zwidth.sweep.faults import (
    LocatedProblem,
    describe,
    listing,
    problem,
    suggestion,
    validation_error,
)
from zwidth.sweep.fields import Name, Strict, Text, looks_like_number, members
from zwidth.sweep.responses import RecommendStudy, StepStudy
from zwidth.sweep.studies import BoundaryStudy, MapStudy, PassivityStudy, RidgeStudy, Study
from zwidth.sweep.sweeps import SweepStudy

FORMAT_VERSION = 1

AnyStudy: TypeAlias = BoundaryStudy | MapStudy | RidgeStudy | PassivityStudy | StepStudy | RecommendStudy | SweepStudy

STUDIES: dict[str, type[Study]] = {
    "boundary": BoundaryStudy,
    "map": MapStudy,
    "ridge": RidgeStudy,
    "passivity": PassivityStudy,
    "step": StepStudy,
    "recommend": RecommendStudy,
    "sweep": SweepStudy,
}
"""The models of the studies by the name of their kind."""


def _study(raw: Any) -> Any:
    """A validator that reads a mapping as the study that its kind names."""
    if isinstance(raw, Study):
        return raw
    kinds = f"a study is a mapping with one of the kinds {listing(STUDIES)}"
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", kinds, "write '- kind: boundary' and its fields, or remove the entry")
    kind = raw.get("kind")
    if "kind" not in raw:
        raise validation_error("study", [(("kind",), problem("missing", kinds, "add 'kind: boundary'"))])
    if not isinstance(kind, str) or kind not in STUDIES:
        what = problem(
            f"got {describe(kind)}",
            f"the kinds are {listing(STUDIES)}",
            suggestion(kind, STUDIES, "write one of these"),
        )
        raise validation_error("study", [(("kind",), what)])
    return STUDIES[kind].model_validate(raw)


def _version(value: Any) -> int:
    if value == FORMAT_VERSION and isinstance(value, int) and not isinstance(value, bool):
        return value
    remedy = f"write 'version: {FORMAT_VERSION}'"
    if isinstance(value, str) and looks_like_number(value):
        remedy = "drop the quotes"
    elif isinstance(value, int) and value > FORMAT_VERSION:
        remedy = "install a newer zwidth, or rewrite the file in version 1"
    raise problem(f"got {describe(value)}", f"this release reads version {FORMAT_VERSION} of the format", remedy)


# The discriminator is for the JSON Schema; the handler, whose messages know no remedy, is never called.
StudyField = Annotated[Annotated[AnyStudy, Field(discriminator="kind")], WrapValidator(lambda raw, _: _study(raw))]


class Config(Strict):
    """A configuration file, checked and complete: every study holds the values that it runs with."""

    what: ClassVar[str] = "a configuration"

    version: Annotated[int, BeforeValidator(_version), WithJsonSchema({"const": FORMAT_VERSION})]
    """Version of the format, 1."""

    name: Name
    """Name of the configuration; results go to a folder of this name unless told otherwise."""

    description: Text = ""
    """Free text."""

    scene: SceneField | None = None
    """Device, timing and wall that supply what a study leaves out."""

    studies: Annotated[tuple[StudyField, ...], WrapValidator(members("studies"))]
    """What to compute, in this order."""

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
        return {**raw, "studies": [_filled(study, scene) for study in studies]}

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        """Two studies of one name."""
        studies = raw.get("studies")
        first: dict[str, int] = {}
        for index, study in enumerate(studies if isinstance(studies, list | tuple) else ()):
            name = study.get("name") if isinstance(study, dict) else None
            if not isinstance(name, str):
                continue
            if name in first:
                what = problem(
                    f"got {describe(name)}, the name of studies[{first[name]}] as well",
                    "results are kept by name, so each study has its own",
                    "rename one",
                )
                yield ("studies", index, "name"), what
            first.setdefault(name, index)


def _scene_or_stand_in(raw: Any) -> AnyScene:
    """The file's scene; where it is faulty, one that only keeps its faults from repeating in every study."""
    try:
        return read_scene(raw)
    except ValueError:
        # The same faults are reported where the scene itself is read.
        pass
    if isinstance(raw, dict) and is_normalized(raw):
        return NormalizedScene(delta=0.0, alpha=0.0)
    return PhysicalScene(mass=1.0, period=1.0, stiffness=0.0)


def _filled(study: Any, scene: AnyScene) -> Any:
    """A study's mapping with what the scene supplies; anything else as it is."""
    kind = study.get("kind") if isinstance(study, dict) else None
    return STUDIES[kind].fill(study, scene) if isinstance(kind, str) and kind in STUDIES else study


def config_json_schema() -> dict[str, Any]:
    """Return the JSON Schema of configuration files, for editors.

    An editor's check is a first help: units, conflicts between keys and sizes are checked by
    `zwidth.load_config` alone.

    Returns:
        A JSON Schema (draft 2020-12) as a dict that ``json.dumps`` accepts.

    Example:
        >>> from zwidth.sweep.config import config_json_schema
        >>> sorted(config_json_schema()["required"])
        ['name', 'studies', 'version']
    """
    schema = _without_null(Config.model_json_schema())
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _without_null(schema: Any) -> Any:
    """The schema without null, which stands for "not given" in the models and is never written in a file."""
    if isinstance(schema, list):
        return [_without_null(item) for item in schema if item != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    return {key: _without_null(value) for key, value in schema.items() if key != "default" or value is not None}
