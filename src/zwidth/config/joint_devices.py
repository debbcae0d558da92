"""Pydantic models of arms with several joints in configurations, given by a mass matrix or by a MuJoCo model file.

The arm is in one *pose*, a position of every joint, and the wall acts on one point of the arm along one direction. Each
class describes a *section*, the mapping of one arm. When a configuration is read, a `MujocoSection` is converted to a
`MassMatrixSection`, so that a saved configuration contains the matrices instead of the name of the model file.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any

from pydantic import Field, WithJsonSchema

from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict
from zwidth.config.parts import PartSection, parse_input_error
from zwidth.config.values import Rotary, read_rotary
from zwidth.core.errors import InputError
from zwidth.model.device import Device
from zwidth.model.joint_space import from_mass_matrix
from zwidth.model.linear_device import LinearDevice
from zwidth.model.mujoco_model import linearize_model

_ENTRY: dict[str, Any] = {"type": ["number", "string"]}
_LIST: dict[str, Any] = {"type": "array", "items": _ENTRY, "minItems": 1}
_ROWS: dict[str, Any] = {"type": "array", "items": {"type": "array", "items": _ENTRY}, "minItems": 1}
# These types accept every value, because `from_mass_matrix` checks the arrays together: their sizes must agree.
_Matrix = Annotated[Any, WithJsonSchema(_ROWS)]
_OfJoints = Annotated[Any, WithJsonSchema({"anyOf": [_ENTRY, _LIST, _ROWS]})]
_Direction = Annotated[
    Any, WithJsonSchema({"anyOf": [{"enum": ["x", "y", "z"]}, {"type": "array", "items": {"type": "number"}}]})
]
_Pose = Annotated[
    Any,
    WithJsonSchema({"anyOf": [{"type": "object", "additionalProperties": _ENTRY}, _LIST, {"type": "string"}]}),
]


class MassMatrixSection(PartSection, noun="a device with joints"):
    """A device with several joints in one pose, given by its mass matrix."""

    mass_matrix: _Matrix
    """Symmetric mass matrix of the joints: a list of rows, in kg m^2 (hinges) and kg (slides), or with units."""

    damping: _OfJoints = 0.0
    """Viscous damping of the joints in N m s/rad (hinges) or N s/m (slides), or with units: one number for
    all joints, a list with one number per joint, or a matrix."""

    jacobian: _Matrix | None = None
    """Jacobian of the point on which the wall acts: one row per axis, one column per joint. Entries are numbers
    in SI units, or lengths such as 20 cm. The column of a joint without motor contains zeros. Default: the identity
    matrix; the direction is then in joint coordinates."""

    direction: _Direction | None = None
    """Direction of the wall: x, y or z, or a vector with one component per row of the Jacobian. Required unless the
    Jacobian has a single row."""

    stiffness: _OfJoints = 0.0
    """Stiffness of springs from the joints to ground in N m/rad or N/m, in the same form as the damping. A spring k
    between two joint coordinates has the matrix [[k, -k], [-k, k]]."""

    rotary: Rotary = Field(default_factory=read_rotary)
    """True if the wall acts on the rotation about the direction, as for a knob."""

    @cached_property
    def instance(self) -> Device | LinearDevice:
        """The device that the wall acts on: a `Device` if the arm moves like one mass, otherwise a `LinearDevice`."""
        given = {name: getattr(self, name) for name in type(self).model_fields}
        return from_mass_matrix(**{**given, "rotary": bool(self.rotary)})


class MujocoSection(Strict, noun="a device from a MuJoCo model"):
    """A device with several joints in one pose, given by a model file of MuJoCo."""

    model: str
    """Name of the model file (MJCF .xml, .urdf or .mjb), relative to the configuration."""

    site: str
    """Name of the site on which the wall acts. In a model without sites: name of the body on which the wall acts."""

    direction: _Direction
    """Direction of the wall in world coordinates: x, y or z, or a vector."""

    pose: _Pose | None = None
    """Positions of the joints: a mapping such as {elbow: 60 deg}; a list of all positions, in rad and m or with units;
    or the name of a keyframe, a pose in the model file. Default: the reference pose of the model."""

    rotary: Rotary = Field(default_factory=read_rotary)
    """True if the wall acts on the rotation about the direction, as for a knob."""

    @cached_property
    def joints(self) -> dict[str, Any]:
        """The same arm described by its mass matrix: keys and values of a `MassMatrixSection`."""
        matrices = linearize_model(find_file(self.model), self.site, self.pose, rotary=bool(self.rotary))
        given = {name: values.tolist() for name, values in matrices._asdict().items()}
        return {**given, "direction": self.direction, **({"rotary": True} if self.rotary else {})}

    def find_faults(self) -> Iterable[LocatedProblem]:
        try:
            from_mass_matrix(**self.joints)
        except InputError as error:
            path, fault = parse_input_error(error)
            # Report a problem that concerns no field, such as a missing package, for the whole section: its path is ().
            yield (path if path[0] in type(self).model_fields else ()), fault
