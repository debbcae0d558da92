"""Studies on grids of parameters: boundaries, maps, ridges and the cost of passivity."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import BeforeValidator, ConfigDict, WrapValidator

from zwidth._types import DELAY_MODELS
from zwidth.sweep.axes import AnyAxis, DelayAxis, DeltaAxis
from zwidth.sweep.devices import AnyDelayModel, AnyScene
from zwidth.sweep.faults import LocatedProblem, describe, listing, problem
from zwidth.sweep.fields import Boolean, Name, Strict, members, one_of

MAX_POINTS = 150_000_000
MAX_BYTES = 2**30

# Samples of a boundary over frequency; only an estimate of a result's size rests on it.
_POINTS_PER_CURVE = 1000
_OUTPUT_BYTES = {"stable": 1, "spectral_radius": 8, "passive": 1}

MapOutput: TypeAlias = Literal["stable", "spectral_radius", "passive"]
Plane: TypeAlias = Literal["alpha_beta", "delta_beta"]


def _only_held(value: Any) -> str:
    """A validator for a study that needs poles."""
    if one_of(*DELAY_MODELS)(value) == "fractional_power":
        raise problem(
            f"got {describe(value)}, the study's own or that of scene.delay_model",
            "poles do not exist in this delay model, only the boundary and the ridge do; allowed is 'held'",
            "write 'delay_model: held' in this study, or use the kind 'boundary' or 'ridge'",
        )
    return str(value)


HeldOnly = Annotated[Literal["held"], BeforeValidator(_only_held)]
DelayModels = Annotated[tuple[AnyDelayModel, ...], WrapValidator(members("delay models"))]


def figure_layout(*names: str) -> BeforeValidator:
    """A validator for the layout of a figure."""
    return BeforeValidator(one_of(*names))


def _drop_supplied(schema: dict[str, Any], model: type[Study]) -> None:
    """Let an editor's check pass where the scene supplies what a study leaves out."""
    required = schema.get("required", [])
    schema["required"] = [name for name in required if name not in model.from_scene]


class Study(Strict):
    """What all studies have."""

    model_config = ConfigDict(json_schema_extra=_drop_supplied)

    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d")
    """Fields that the file's scene supplies where the study leaves them out."""

    remedy_if_too_large: ClassVar[str] = "use fewer values on an axis, or split the study"

    name: Name
    """Name of the study, unique in the file; its results are stored under it."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        """Add what the study leaves out and the scene knows."""
        supplied = {
            "delta": scene.delta,
            "d": scene.d,
            "delay_model": scene.delay_model,
            "delay_models": [scene.delay_model],
        }
        return {**{name: supplied[name] for name in cls.from_scene}, **raw}

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        if name in cls.from_scene:
            return "a study needs it where the file has no scene to take it from", f"add {name!r}, or a scene"
        return super().missing(name)

    @property
    def points(self) -> int:
        """About how many points are computed."""
        raise NotImplementedError

    @property
    def nbytes(self) -> int:
        """About how many bytes the result has."""
        raise NotImplementedError

    @property
    def extent(self) -> str:
        """What the number of points consists of, for messages."""
        raise NotImplementedError

    def limits(self) -> Iterable[LocatedProblem]:
        if self.points <= MAX_POINTS and self.nbytes <= MAX_BYTES:
            return
        what = f"{self.extent} is {self.points:.4g} points and {self.nbytes / 2**30:.3g} GiB"
        allowed = f"at most {MAX_POINTS:.4g} points and {MAX_BYTES / 2**30:g} GiB a study"
        yield (), problem(what, allowed, self.remedy_if_too_large)


class _Curves(Study):
    """Base of the studies over delta and d."""

    delta: DeltaAxis
    """Normalized damping of the device, an axis; the scene's where left out."""

    d: DelayAxis
    """Delay in periods, an axis; the scene's where left out."""

    @property
    def models(self) -> int:
        """How many delay models are computed."""
        return len(getattr(self, "delay_models", ("held",)))

    @property
    def extent(self) -> str:
        """delta x d x delay models."""
        return f"delta x d x delay models = {self.delta.size} x {self.d.size} x {self.models}"

    @property
    def points(self) -> int:
        """One a pair of delta and d and delay model."""
        return self.delta.size * self.d.size * self.models

    @property
    def nbytes(self) -> int:
        """alpha, beta, frequency and two codes a point."""
        return self.points * 32


class BoundaryStudy(_Curves):
    """Stability boundaries, one for every delta, d and delay model."""

    what: ClassVar[str] = "a boundary study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_models")

    kind: Literal["boundary"]

    plane: Annotated[Plane, BeforeValidator(one_of("alpha_beta", "delta_beta"))] = "alpha_beta"
    """Boundary over alpha and beta, or over delta and beta at alpha -> 0."""

    delay_models: DelayModels = ("held",)
    """Models of a delay that is not whole."""

    ridge_path: Boolean = False
    """Draw the path of maximum stiffness over delta as well; in the plane alpha_beta."""

    passivity: Boolean = False
    """Draw the passivity condition as well."""

    figure: Annotated[
        Literal["fig5", "fig6", "fig7", "fig8", "fig9"] | None, figure_layout("fig5", "fig6", "fig7", "fig8", "fig9")
    ] = None
    """Layout of the figure; a generic one where left out."""

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        plane = raw.get("plane", "alpha_beta")
        plane = plane if isinstance(plane, str) else ""
        if plane == "delta_beta" and raw.get("ridge_path") is True:
            allowed = "the path of maximum stiffness lies in the plane alpha_beta; at alpha -> 0 there is none"
            yield ("ridge_path",), problem("got true with plane delta_beta", allowed, "remove ridge_path")
        figure = raw.get("figure")
        layouts = {"alpha_beta": ("fig5", "fig7", "fig8"), "delta_beta": ("fig6", "fig9")}
        for other, names in layouts.items():
            if figure in names and plane in layouts and plane != other:
                allowed = f"the layouts for this plane are {listing(layouts[plane])}"
                remedy = "choose one of these, or change the plane"
                yield ("figure",), problem(f"got {figure!r} with plane {plane}", allowed, remedy)

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.plane == "delta_beta" and self.delta.size < 2:
            allowed = "the plane delta_beta needs two values of delta or more, its curves run over delta"
            yield ("delta",), problem("got one value", allowed, "give delta as a list, linear or log axis")

    @property
    def points(self) -> int:
        """About a thousand frequencies a curve; over delta, one point."""
        return super().points * (_POINTS_PER_CURVE if self.plane == "alpha_beta" else 1)


class MapStudy(Study):
    """Stability and passivity on a grid of alpha, beta, delta and d."""

    what: ClassVar[str] = "a map study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_model")

    kind: Literal["map"]

    alpha: AnyAxis
    """Normalized stiffness of the wall, an axis."""

    beta: AnyAxis
    """Normalized damping of the wall, an axis."""

    delta: DeltaAxis
    """Normalized damping of the device, a number or an axis; the scene's where left out."""

    d: DelayAxis
    """Delay in periods, a number or an axis; the scene's where left out."""

    outputs: Annotated[
        tuple[
            Annotated[MapOutput, BeforeValidator(one_of("stable", "spectral_radius", "passive"))],
            ...,
        ],
        WrapValidator(members("outputs")),
    ] = ("stable",)
    """What is computed at every point."""

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; poles exist in the model 'held' only."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Sizes of alpha, beta, delta and d."""
        return self.alpha.size, self.beta.size, self.delta.size, self.d.size

    @property
    def extent(self) -> str:
        """alpha x beta x delta x d."""
        return f"alpha x beta x delta x d = {' x '.join(str(size) for size in self.shape)}"

    @property
    def points(self) -> int:
        """The product of the four sizes."""
        a, b, delta, d = self.shape
        return a * b * delta * d

    @property
    def nbytes(self) -> int:
        """All outputs and a status code a point."""
        return self.points * (1 + sum(_OUTPUT_BYTES[name] for name in self.outputs))


class RidgeStudy(_Curves):
    """Maximum stiffness over delta, one curve for every d and delay model."""

    what: ClassVar[str] = "a ridge study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_models")

    kind: Literal["ridge"]

    delay_models: DelayModels = ("held",)
    """Models of a delay that is not whole."""

    figure: Annotated[Literal["fig10"] | None, figure_layout("fig10")] = None
    """Layout of the figure; a generic one where left out."""


class PassivityStudy(_Curves):
    """What passivity costs: the largest passive and the largest stable stiffness over delta."""

    what: ClassVar[str] = "a passivity study"
    from_scene: ClassVar[tuple[str, ...]] = ("delta", "d", "delay_model")

    kind: Literal["passivity"]

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; passivity is known for the model 'held'."""

    figure: Annotated[Literal["passivity_cost"] | None, figure_layout("passivity_cost")] = None
    """Layout of the figure; a generic one where left out."""
