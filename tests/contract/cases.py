"""Cases of the contract: one per public function of arrays, used by every contract test and by docs/contract.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import numpy as np

import zwidth

Value = TypeVar("Value")

# Largest error, relative and absolute, of float32 values at the valid points of the cases: 16 rounding errors.
SINGLE_ERROR = 16 * 2.0**-23


@dataclass(frozen=True)
class Case:
    """A function of arrays with three valid points and, per argument, an invalid and an out-of-range value."""

    name: str
    call: Callable[..., Any]
    good: dict[str, list[float]]
    bad: dict[str, float]
    # Finite values outside the model's domain: a status in arrays, an error for single numbers.
    beyond: dict[str, float] = field(default_factory=dict)
    # Columns of the table in docs/contract.md: domain, value at bad points, derivatives.
    domain: str = ""
    value: str = "NaN"
    # Highest order of the guaranteed derivatives; None for results without derivatives.
    derivatives: int | None = 2
    # Arguments that must not be traced.
    concrete: tuple[str, ...] = ()
    # Number of axes of the results beyond those of the arguments.
    extra_axes: int = 0
    # True if tracing raises an error.
    refuses_tracing: bool = False
    # Test file of the derivatives, for functions whose gradient is slow to compile.
    gradient_in: str = ""
    # True if a single invalid number raises an error, as for quantities in SI units.
    strict: bool = False
    # Integer-valued point at which `contract.matrix` tries every type; missing arguments are 1.
    point: dict[str, int] = field(default_factory=dict)
    # Arguments that must be single numbers, such as the parameters of a scene.
    one_number: tuple[str, ...] = ()

    @property
    def integer_point(self) -> dict[str, int]:
        """All arguments at the integer-valued point."""
        return {name: self.point.get(name, 1) for name in self.good}

    @property
    def function(self) -> str:
        """Public name without the suffix that describes the call."""
        return self.name.partition(" ")[0]

    @property
    def arguments(self) -> dict[str, np.ndarray]:
        return {name: np.array(values) for name, values in self.good.items()}

    @property
    def free(self) -> list[str]:
        """Arguments that may be traced."""
        return [name for name in self.good if name not in self.concrete]

    def leaves(self, result: Any) -> dict[str, Any]:
        """Arrays of a result by field name."""
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
# A stable wall with integer values, normalized and in SI units.
INTEGER_WALL = {"delta": 8}
INTEGER_SI = {"mass": 2, "damping": 8}
DOMAINS = {
    (WALLS := "walls"): "those of devices; alpha and beta: 0, or 1e-60 to 1e60 in magnitude",
    (DEVICES := "devices"): "delta: 0 to 1e12; d: 0 to 1e5",
    (QUANTITIES := "quantities"): "SI quantities: 0, or 1e-30 to 1e30; mass and period: above 0",
}


def make_wall_case(call, **options):
    options = {"domain": WALLS, "point": INTEGER_WALL, **options}
    return Case(call.__name__, call, {**WALL, **ONE_DELAY}, BAD_WALL, BEYOND_WALL, **options)


def make_device_case(name, call, line_argument=None, **options):
    line_argument = line_argument or {}
    bad = {**BAD_DEVICE, **dict.fromkeys(line_argument, np.nan)}
    beyond = {**BEYOND_DEVICE, **{key: 1e61 for key in line_argument if key != "omega"}}
    return Case(name, call, {**line_argument, **DEVICE}, bad, beyond, domain=DEVICES, point=INTEGER_WALL, **options)


def make_quantity_case(call, **options):
    return Case(
        call.__name__, call, SI_DEVICE, BAD_SI, BEYOND_SI, domain=QUANTITIES, strict=True, point=INTEGER_SI, **options
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
        point=INTEGER_SI,
    ),
    Case(
        "denormalize",
        zwidth.denormalize,
        {**SI, **WALL},
        {"mass": -1.0, "delta": np.nan},
        {"mass": 1e31, "alpha": 1e61, "delta": 1e13},
        domain=f"{WALLS}, {QUANTITIES}",
        strict=True,
        point=INTEGER_SI,
    ),
    make_wall_case(zwidth.char_poly, concrete=("d",), extra_axes=1),
    make_wall_case(zwidth.poles, concrete=("d",), extra_axes=1, derivatives=1, domain=f"{WALLS}, at most 4,000 poles"),
    make_wall_case(zwidth.spectral_radius),
    make_wall_case(zwidth.decay_rate),
    make_wall_case(zwidth.dominant_pole),
    make_wall_case(zwidth.is_stable, derivatives=None, value="False"),
    make_wall_case(zwidth.decide_stability, derivatives=None, value="False, with a status"),
    make_wall_case(zwidth.is_passive, derivatives=None, value="False"),
    make_wall_case(zwidth.passivity_margin),
    make_wall_case(
        zwidth.margins, value="NaN, also for alpha <= 0", gradient_in="tests/unit/stability/rigid/test_margins.py"
    ),
    make_device_case("boundary", zwidth.boundary, {"omega": [0.0, 0.5, 3.0]}),
    make_device_case(
        "boundary_point at constant beta",
        lambda beta, delta, d: zwidth.boundary_point(delta, d, beta=beta),
        {"beta": [0.3, 0.1, 0.05]},
    ),
    make_device_case(
        "boundary_point at constant alpha",
        lambda alpha, delta, d: zwidth.boundary_point(delta, d, alpha=alpha),
        {"alpha": [0.3, 0.1, 0.05]},
    ),
    make_device_case("alpha_max", zwidth.alpha_max),
    make_device_case("stable_area", zwidth.stable_area),
    make_device_case("passive_area", zwidth.passive_area),
    Case(
        "stiffness_slope", zwidth.stiffness_slope, {"d": [0.0, 1.0, 2.5]}, {"d": -1.0}, {"d": 1e6}, domain="d: 0 to 1e5"
    ),
    make_quantity_case(zwidth.max_stiffness),
    make_quantity_case(zwidth.sensitivities, derivatives=1),
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


def make_scene_case(question, answer, velocity=None, **options):
    """Case of a method of `Scene`, as a function of the numbers of the scene and of the wall."""
    wall = () if "max_stiffness" in question else ("stiffness", "virtual_damping")
    device = ("mass", "damping", "period", "delay")

    def call(mass, damping, period, delay=0, **wall):
        parts = {} if velocity is None else {"velocity": velocity}
        return answer(zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(period, delay), **parts), **wall)

    omitted = options.pop("without", ())
    names = [name for name in (*device, *wall) if name not in omitted]
    good = {name: [1.0] for name in names}
    return Case(f"Scene.{question}", call, good, {}, point=INTEGER_SI, one_number=device, **options)


def find_environment_limit(virtual_mass, virtual_damping, environment_damping, period, delay):
    """Return the limit of an admittance display whose numbers and environment may be traced or arrays."""
    robot = zwidth.Actuator(time_constant=2 * period)
    display = zwidth.AdmittanceDisplay(1, 1, robot, zwidth.Timing(period, delay))
    factors = {"virtual_mass": virtual_mass, "virtual_damping": virtual_damping}
    return display.max_environment_stiffness(environment_damping, **factors)


# Methods for the type matrix: of rigid scenes, `max_stiffness` with a velocity filter, and of admittance displays.
SCENE_CASES = [
    make_scene_case("is_stable", zwidth.Scene.is_stable, derivatives=None),
    make_scene_case("is_passive", zwidth.Scene.is_passive, derivatives=None),
    make_scene_case("decide_stability", zwidth.Scene.decide_stability, derivatives=None, refuses_tracing=True),
    make_scene_case("spectral_radius", zwidth.Scene.spectral_radius),
    make_scene_case("poles", zwidth.Scene.poles, concrete=("period", "delay"), extra_axes=1, derivatives=1),
    make_scene_case("margins", zwidth.Scene.margins, gradient_in="tests/unit/stability/rigid/test_margins.py"),
    make_scene_case("passivity_margin", zwidth.Scene.passivity_margin),
    make_scene_case("max_stiffness", zwidth.Scene.max_stiffness),
    make_scene_case("max_stiffness without delay", zwidth.Scene.max_stiffness, without=("delay",)),
    make_scene_case("max_stiffness behind a filter", zwidth.Scene.max_stiffness, zwidth.LowPass(time_constant=2)),
    make_scene_case(
        "to_si", lambda scene, stiffness, virtual_damping: scene.to_si(alpha=stiffness, beta=virtual_damping)
    ),
    Case(
        "AdmittanceDisplay.max_environment_stiffness",
        find_environment_limit,
        {name: [1.0] for name in ("virtual_mass", "virtual_damping", "environment_damping", "period", "delay")},
        {},
        point={"virtual_mass": 20, "delay": 2},
        one_number=("period", "delay"),
    ),
]

# Public functions that are not evaluated point by point, or that are slow to compile, with the tests of their contract.
OTHERS = {
    "assess": "one scene: tests/unit/studies/test_published.py, tests/properties/test_consistency.py",
    "assess_many": "scenes by name: tests/unit/analysis/test_assessment.py",
    "cascade": "one controller: tests/unit/model/test_position.py",
    "cascade_gains": "one controller: tests/unit/model/test_position.py",
    "diagnose": "one scene and wall: tests/unit/analysis/test_diagnosis.py",
    "excite": "one signal: tests/unit/identification/test_response_estimate.py",
    "fit_buzz": "one device: tests/unit/identification/test_onset_fit.py",
    "fit_log": "one device: tests/unit/identification/test_log_fit.py",
    "limits_of": "one scene: tests/unit/analysis/test_limits.py",
    "from_mass_matrix": "one device: tests/unit/model/test_joint_space.py",
    "from_mujoco": "one device: tests/unit/model/test_mujoco_model.py",
    "load_config": "a file: tests/unit/config/test_reader.py",
    "load_scene": "a file: tests/unit/cli/test_scene_file.py",
    "open_dataset": "a folder: tests/unit/sweep/test_sweep_engine.py",
    "pid": "one controller: tests/unit/model/test_position.py",
    "pid_gains": "one controller: tests/unit/model/test_position.py",
    "reference_grasps": "one radius: tests/unit/analysis/test_recommendation.py",
    "respond": "one record: tests/unit/identification/test_response_estimate.py",
    "robust_max_stiffness": "boxes of devices: tests/unit/analysis/test_robust.py",
    "robust_wall": "boxes of devices: tests/unit/analysis/test_robust.py",
    "run": "a configuration: tests/unit/runs/test_run.py",
    "simulate": "whole motions: tests/unit/simulation/test_against_integrator.py",
    "simulate_tolerances": "one scene: tests/unit/analysis/test_tolerances.py",
    "stiffest_walls": "scenes, or arrays of parameters: tests/unit/analysis/test_batch.py",
    "stable_region": "one device: tests/unit/stability/rigid/test_region.py",
    "step_response": "one wall: tests/unit/stability/rigid/test_step_response.py",
    "to_control": "one scene: tests/unit/analysis/test_walls.py",
    "use_compilation_cache": "a setting: tests/unit/numerics/test_kernel_cache.py",
    "write_report": "a folder: tests/unit/app/report/test_page.py",
}
