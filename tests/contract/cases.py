"""The public functions of arrays, each as one case that every test of the contract runs through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import numpy as np

import zwidth

Value = TypeVar("Value")


@dataclass(frozen=True)
class Case:
    """A function of arrays with three good points and, per argument, a bad value and one beyond the range."""

    name: str
    call: Callable[..., Any]
    good: dict[str, list[float]]
    bad: dict[str, float]
    # Finite numbers that the model does not go to: a status in arrays, an error by themselves.
    beyond: dict[str, float] = field(default_factory=dict)
    # What the table says of the arguments, of the values and of the derivatives.
    domain: str = ""
    value: str = "NaN"
    # The order up to which derivatives are promised; None where the result has none.
    derivatives: int | None = 2
    # Arguments that must stay concrete inside a transformation.
    concrete: tuple[str, ...] = ()
    # How many axes the results have beyond those of the arguments.
    extra_axes: int = 0
    # Whether a transformation is refused altogether.
    refuses_tracing: bool = False
    # Where the derivatives are tested, of a function whose gradient compiles for long.
    gradient_in: str = ""
    # How near, relative and absolute, float32 is to float64.
    single: float = 2e-3
    # A bad number by itself raises as well, since quantities in SI units come one by one.
    strict: bool = False
    # A point of whole numbers, at which `contract.matrix` tries every type; arguments without an entry are 1.
    point: dict[str, int] = field(default_factory=dict)
    # Arguments that are single numbers, as the parameters of a scene are.
    one_number: tuple[str, ...] = ()

    @property
    def whole(self) -> dict[str, int]:
        """The point of whole numbers."""
        return {name: self.point.get(name, 1) for name in self.good}

    @property
    def function(self) -> str:
        """The public name, without the way in which it is called here."""
        return self.name.partition(" ")[0]

    @property
    def arguments(self) -> dict[str, np.ndarray]:
        return {name: np.array(values) for name, values in self.good.items()}

    @property
    def free(self) -> list[str]:
        """The arguments that may be traced."""
        return [name for name in self.good if name not in self.concrete]

    def leaves(self, result: Any) -> dict[str, Any]:
        """The arrays of a result by name."""
        if hasattr(result, "_asdict"):
            return result._asdict()
        assert isinstance(result, np.ndarray | np.generic | jax.Array), type(result)
        return {"value": result}


WALL = {"alpha": [0.05, 0.1, 0.2], "beta": [0.3, 0.4, 0.1], "delta": [0.0, 0.1, 1.5]}
BAD_WALL = {"alpha": np.inf, "beta": np.nan, "delta": -1.0, "d": -0.5}
BEYOND_WALL = {"alpha": 1e61, "beta": -1e61, "delta": 1e13, "d": 1e6}
ONE_DELAY = {"d": [1.0, 1.0, 1.0]}
DEVICE = {"delta": [0.0, 0.1, 1.5], "d": [0.0, 1.0, 2.5]}
BAD_DEVICE = {"delta": -1.0, "d": np.nan}
BEYOND_DEVICE = {"delta": 1e13, "d": 1e6}
SI = {"mass": [0.1, 0.2, 1.0], "period": [1e-3, 1e-3, 2e-3]}
SI_DEVICE = {**SI, "damping": [0.0, 10.0, 5.0], "delay": [0.0, 1e-3, 3e-3]}
BAD_SI = {"mass": -1.0, "period": 0.0, "damping": -1.0, "delay": np.nan}
BEYOND_SI = {"mass": 1e31, "period": 1e-31, "damping": 1e31, "delay": 1e31}
# A stable wall of whole numbers, and the same in SI units.
WHOLE_WALL = {"delta": 8}
WHOLE_SI = {"mass": 2, "damping": 8}
DOMAINS = {
    (WALLS := "walls"): "those of devices; alpha and beta: 0, or 1e-60 to 1e60 in magnitude",
    (DEVICES := "devices"): "delta: 0 to 1e12; d: 0 to 1e5",
    (QUANTITIES := "quantities"): "SI quantities: 0, or 1e-30 to 1e30; mass and period: above 0",
}


def of_walls(call, **options):
    options = {"domain": WALLS, "point": WHOLE_WALL, **options}
    return Case(call.__name__, call, {**WALL, **ONE_DELAY}, BAD_WALL, BEYOND_WALL, **options)


def of_devices(name, call, line=None, **options):
    line = line or {}
    bad = {**BAD_DEVICE, **dict.fromkeys(line, np.nan)}
    beyond = {**BEYOND_DEVICE, **{key: 1e61 for key in line if key != "omega"}}
    return Case(name, call, {**line, **DEVICE}, bad, beyond, domain=DEVICES, point=WHOLE_WALL, **options)


def of_quantities(call, **options):
    return Case(
        call.__name__, call, SI_DEVICE, BAD_SI, BEYOND_SI, domain=QUANTITIES, strict=True, point=WHOLE_SI, **options
    )


CASES = [
    Case(
        "normalize",
        zwidth.normalize,
        {**SI_DEVICE, "stiffness": [1e3, 5e3, 0.0]},
        {"mass": 0.0, "damping": -1.0, "delay": np.nan},
        {**BEYOND_SI, "stiffness": 1e31},
        domain=QUANTITIES,
        strict=True,
        point=WHOLE_SI,
    ),
    Case(
        "denormalize",
        zwidth.denormalize,
        {**SI, **WALL},
        {"mass": -1.0, "delta": np.nan},
        {"mass": 1e31, "alpha": 1e61, "delta": 1e13},
        domain=f"{WALLS}, {QUANTITIES}",
        strict=True,
        point=WHOLE_SI,
    ),
    of_walls(zwidth.char_poly, concrete=("d",), extra_axes=1),
    of_walls(zwidth.poles, concrete=("d",), extra_axes=1, derivatives=1, domain=f"{WALLS}, at most 4,000 poles"),
    of_walls(zwidth.spectral_radius, single=1e-5),
    of_walls(zwidth.decay_rate),
    of_walls(zwidth.is_stable, derivatives=None, value="False"),
    of_walls(zwidth.decide_stability, derivatives=None, value="False, with a status", refuses_tracing=True),
    of_walls(zwidth.is_passive, derivatives=None, value="False"),
    of_walls(zwidth.passivity_margin),
    of_walls(
        zwidth.margins, value="NaN, also for alpha <= 0", gradient_in="tests/unit/stability/rigid/test_margins.py"
    ),
    of_devices("boundary", zwidth.boundary, {"omega": [0.0, 0.5, 3.0]}),
    of_devices(
        "boundary_point at constant beta",
        lambda beta, delta, d: zwidth.boundary_point(delta, d, beta=beta),
        {"beta": [0.3, 0.1, 0.05]},
    ),
    of_devices(
        "boundary_point at constant alpha",
        lambda alpha, delta, d: zwidth.boundary_point(delta, d, alpha=alpha),
        {"alpha": [0.3, 0.1, 0.05]},
    ),
    of_devices("alpha_max", zwidth.alpha_max),
    of_devices("stable_area", zwidth.stable_area),
    of_devices("passive_area", zwidth.passive_area, single=1e-5),
    Case(
        "stiffness_slope", zwidth.stiffness_slope, {"d": [0.0, 1.0, 2.5]}, {"d": -1.0}, {"d": 1e6}, domain="d: 0 to 1e5"
    ),
    of_quantities(zwidth.max_stiffness),
    of_quantities(zwidth.sensitivities, derivatives=1),
    Case(
        "count_poles",
        lambda gain, lag, radius: zwidth.count_poles([0.8], [1.0, 0.9], gain, lag, radius),
        {"gain": [0.01, 0.02, -0.1], "lag": [3.0, 20.0, 0.0], "radius": [1.0, 0.95, 1.1]},
        {"gain": np.nan, "lag": -1.0, "radius": 0.0},
        {"lag": 2.0**53},
        domain="lag: integer, 0 to 2^52; radius: above 0; gain: finite",
        value="-1, also if float64 cannot decide",
        derivatives=None,
        strict=True,
    ),
]


def of_scenes(question, answer, velocity=None, **options):
    """A question of a scene and a wall, as a function of their numbers."""
    wall = () if "max_stiffness" in question else ("stiffness", "virtual_damping")
    device = ("mass", "damping", "period", "delay")

    def call(mass, damping, period, delay=0, **wall):
        parts = {} if velocity is None else {"velocity": velocity}
        return answer(zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(period, delay), **parts), **wall)

    left_out = options.pop("without", ())
    names = [name for name in (*device, *wall) if name not in left_out]
    good = {name: [1.0] for name in names}
    return Case(f"Scene.{question}", call, good, {}, point=WHOLE_SI, one_number=device, **options)


# Methods of scenes that the matrix of types runs through as well: rigid ones, and `max_stiffness` behind a filter.
SCENE_CASES = [
    of_scenes("is_stable", zwidth.Scene.is_stable, derivatives=None),
    of_scenes("is_passive", zwidth.Scene.is_passive, derivatives=None),
    of_scenes("decide_stability", zwidth.Scene.decide_stability, derivatives=None, refuses_tracing=True),
    of_scenes("spectral_radius", zwidth.Scene.spectral_radius),
    of_scenes("poles", zwidth.Scene.poles, concrete=("period", "delay"), extra_axes=1, derivatives=1),
    of_scenes("margins", zwidth.Scene.margins, gradient_in="tests/unit/stability/rigid/test_margins.py"),
    of_scenes("passivity_margin", zwidth.Scene.passivity_margin),
    of_scenes("max_stiffness", zwidth.Scene.max_stiffness),
    of_scenes("max_stiffness without delay", zwidth.Scene.max_stiffness, without=("delay",)),
    of_scenes(
        "max_stiffness behind a filter",
        zwidth.Scene.max_stiffness,
        zwidth.LowPass(time_constant=2),
        concrete=("period", "delay"),
        derivatives=1,
    ),
    of_scenes("to_si", lambda scene, stiffness, virtual_damping: scene.to_si(alpha=stiffness, beta=virtual_damping)),
]

# Public functions that take no arrays point by point, or that compile for long: who holds their contract instead.
OTHERS = {
    "assess": "one scene: tests/unit/studies/test_published.py, tests/properties/test_consistency.py",
    "assess_many": "scenes by name: tests/unit/analysis/test_assessment.py",
    "diagnose": "one scene and wall: tests/unit/analysis/test_diagnosis.py",
    "excite": "one signal: tests/unit/identification/test_response_estimate.py",
    "fit_buzz": "one device: tests/unit/identification/test_onset_fit.py",
    "fit_log": "one device: tests/unit/identification/test_log_fit.py",
    "limits_of": "one scene: tests/unit/analysis/test_limits.py",
    "load_config": "a file: tests/unit/config/test_reader.py",
    "load_scene": "a file: tests/unit/cli/test_scene_file.py",
    "open_dataset": "a folder: tests/unit/sweep/test_sweep_engine.py",
    "reference_grasps": "one radius: tests/unit/analysis/test_recommendation.py",
    "respond": "one record: tests/unit/identification/test_response_estimate.py",
    "robust_max_stiffness": "boxes of devices: tests/unit/analysis/test_robust.py",
    "robust_wall": "boxes of devices: tests/unit/analysis/test_robust.py",
    "run": "a configuration: tests/unit/runs/test_run.py",
    "simulate": "whole motions: tests/unit/simulation/test_against_integrator.py",
    "simulate_tolerances": "one scene: tests/unit/analysis/test_tolerances.py",
    "stable_region": "one device: tests/unit/stability/rigid/test_region.py",
    "step_response": "one wall: tests/unit/stability/rigid/test_step_response.py",
    "to_control": "one scene: tests/unit/analysis/test_walls.py",
    "use_compilation_cache": "a setting: tests/unit/numerics/test_kernel_cache.py",
    "write_report": "a folder: tests/unit/app/report/test_page.py",
}
