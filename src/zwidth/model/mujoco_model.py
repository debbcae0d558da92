"""Build devices from model files of the simulator MuJoCo, which also reads URDF files.

A model determines the mass matrix, the joint damping, the joint springs and the Jacobian of one point in a given pose.
The *point* is a site of the model, or a body if the model has no sites. A *pose* contains the positions of all joints;
``qpos`` is MuJoCo's vector of these positions. `zwidth.model.joint_space` reduces the joints to one direction.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError, check_choice, format_install_command
from zwidth.model.checks import check_number
from zwidth.model.device import Device
from zwidth.model.joint_space import from_mass_matrix
from zwidth.model.linear_device import LinearDevice
from zwidth.units.parsing import looks_like_number
from zwidth.units.quantities import ANY

MODEL_SUFFIXES = (".xml", ".urdf", ".mjb")  # file name extensions of models


class JointSpace(NamedTuple):
    """Matrices of a model in one pose; the fields are arguments of `from_mass_matrix`."""

    mass_matrix: np.ndarray  # mass matrix M with armature inertia, shape (joints, joints), in kg m^2 or kg
    damping: np.ndarray  # viscous damping of each joint, shape (joints,), in N m s/rad (hinges) or N s/m (slides)
    jacobian: np.ndarray  # Jacobian J of the point, shape (3, joints); 0 in the columns of joints without a motor
    stiffness: np.ndarray  # stiffness of the spring of each joint, shape (joints,), in N m/rad (hinges) or N/m (slides)


def from_mujoco(
    model: Any, site: str, direction: Any, *, pose: Any = None, rotary: bool = False
) -> Device | LinearDevice:
    """Return the device of a MuJoCo model for a wall at a site along one direction; see `from_mass_matrix`.

    Mass matrix (with armature), Jacobian, joint damping and joint springs come from the model in the given pose. Joints
    with actuators are driven and measured, all others move passively; in a model without actuators, all joints are
    driven. The wall replaces the gains of the actuators. Friction, contacts, and gravity are not included. Requires the
    package extra ``mujoco``.

    Args:
        model: path of a model (MJCF ``.xml``, ``.urdf`` or ``.mjb``) or a ``mujoco.MjModel``.
        site: name of the site, the point on which the wall acts. For a model without sites, such as one from URDF, the
            name of a body, whose origin is the point.
        direction: "x", "y", "z" or a vector of three components in world coordinates.
        pose: pose of the model in one of four forms: a list of joint positions (``qpos``), as numbers in rad or m or as
            strings such as "30 deg"; a dict of joint positions keyed by joint name, with all other joints in their
            reference positions; the name of a keyframe of the model; None for the reference pose ``qpos0``.
        rotary: True for a wall that acts on the rotation about ``direction``, such as a knob or a steering wheel.

    Returns:
        A `Device` or `LinearDevice`, as returned by `from_mass_matrix`.

    Raises:
        InputError: the model cannot be read, it has no such site or keyframe, or it contains equality constraints,
            elastic tendons or nonlinear springs, which a mass matrix does not describe.

    References:
        E. Todorov, T. Erez and Y. Tassa, MuJoCo: a physics engine for model-based control, IROS 2012.

    Example:
        >>> import mujoco, zwidth
        >>> wheel = "<joint axis='0 0 1' damping='.3'/><geom type='cylinder' size='.2 .01' mass='2'/><site name='hub'/>"
        >>> model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body>{wheel}</body></worldbody></mujoco>")
        >>> zwidth.from_mujoco(model, "hub", "z", rotary=True)
        Device(mass=0.04, damping=0.3, rotary=True)
    """
    joints = linearize_model(model, site, pose, rotary=rotary)
    return from_mass_matrix(**joints._asdict(), direction=direction, rotary=rotary)


def linearize_model(model: Any, site: str, pose: Any = None, *, rotary: bool = False) -> JointSpace:
    """Return the matrices of a MuJoCo model in one pose; the arguments are those of `from_mujoco`.

    Args:
        model: path of a model or a ``mujoco.MjModel``.
        site: name of the site, or of the body in a model without sites.
        pose: pose of the model, in any form that `from_mujoco` accepts.
        rotary: True for the Jacobian of the rotation of the site or body, False for that of its translation.
    """
    mujoco, model = _import_mujoco(), load_model(model)
    _reject_constraints(model)
    data = mujoco.MjData(model)
    data.qpos[:] = _read_pose(model, pose)
    mujoco.mj_forward(model, data)
    count = int(model.nv)
    translation, rotation = np.zeros((3, count)), np.zeros((3, count))
    kind, index = _find_point(mujoco, model, site)
    compute_jacobian = mujoco.mj_jacSite if kind == "site" else mujoco.mj_jacBody
    compute_jacobian(model, data, translation, rotation, index)
    inertia = np.zeros((count, count))
    for column, unit in zip(inertia, np.eye(count), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    jacobian = np.where(_find_driven(mujoco, model), rotation if rotary else translation, 0.0)
    springs = np.asarray(model.jnt_stiffness)[model.dof_jntid]
    return JointSpace(inertia, np.array(model.dof_damping), jacobian, springs)


def _import_mujoco() -> Any:
    """Return the package mujoco; raise `InputError` if it is not installed.

    The annotation is Any, because the type stubs of the package lack most functions.
    """
    try:
        return import_module("mujoco")
    except ImportError:
        command = format_install_command("mujoco")
        raise InputError(f"from_mujoco: MuJoCo is not installed; it is needed to read models; run {command}") from None


def list_joints(model: Any) -> dict[str, str]:
    """Return the kind, "hinge" or "slide", of the joints of a MuJoCo model, keyed by joint name.

    Joints without a name and joints with several coordinates are omitted.
    """
    kinds = {int(getattr(_import_mujoco().mjtJoint, f"mjJNT_{kind.upper()}")): kind for kind in ("hinge", "slide")}
    joints = (model.joint(index) for index in range(model.njnt))
    return {joint.name: kinds[int(joint.type[0])] for joint in joints if joint.name and int(joint.type[0]) in kinds}


def check_point(model: Any, site: str) -> None:
    """Raise `InputError` if a MuJoCo model has no site with the given name.

    In a model without any sites, the name must be that of a body.
    """
    _find_point(_import_mujoco(), model, site)


def load_model(model: Any) -> Any:
    """Load a MuJoCo model from a file, given its path; return an already loaded model unchanged."""
    mujoco = _import_mujoco()
    if isinstance(model, mujoco.MjModel):
        return model
    if not isinstance(model, str | Path):
        raise InputError(f"model: got {model!r}; it must be a path or a mujoco.MjModel")
    path = Path(model).expanduser()
    if not path.is_file():
        text = str(model)
        shown = text if len(text) <= 60 and text.isprintable() else f"a text of {len(text)} characters"
        raise InputError(
            f"model: got {shown!r}, which is not a file; give the path of an .xml, .urdf or .mjb file, or a MjModel"
        )
    load = mujoco.MjModel.from_binary_path if path.suffix == ".mjb" else mujoco.MjModel.from_xml_path
    try:
        return load(str(path))
    except ValueError as error:
        raise InputError(f"model: MuJoCo cannot read {str(path)!r}: {error}") from None


def pack_model(path: Path) -> tuple[bytes, str]:
    """Return a self-contained copy of a model file: its content in bytes, and its file name extension.

    The content is that of the file if the model needs no other files. Otherwise, for example with meshes or included
    files, it is the compiled model in MuJoCo's binary format ".mjb", which the same release of MuJoCo can read.
    """
    content = path.read_bytes()
    with TemporaryDirectory() as folder:
        copy, compiled = Path(folder, path.name), Path(folder, "compiled.mjb")
        copy.write_bytes(content)
        try:
            load_model(copy)
        except InputError:
            _import_mujoco().mj_saveModel(load_model(path), str(compiled))
            return compiled.read_bytes(), compiled.suffix
    return content, path.suffix


def _reject_constraints(model: Any) -> None:
    """Raise `InputError` if a MuJoCo model contains parts that the matrices of a `JointSpace` do not describe."""
    tendons = np.any(model.tendon_stiffness) or np.any(model.tendon_damping)
    faults = {
        "equality constraints": model.neq > 0,
        "tendons with stiffness or damping": tendons,
        "nonlinear joint springs": np.any(getattr(model, "jnt_stiffnesspoly", 0.0)),
    }
    for fault, present in faults.items():
        if present:
            raise InputError(f"model: got {fault}; only trees of joints are supported; remove them or pass M and J")


def _read_pose(model: Any, pose: Any) -> np.ndarray:
    """Return the joint positions ``qpos`` of a pose, which is given in any form that `from_mujoco` accepts."""
    if pose is None:
        return np.array(model.qpos0)
    if isinstance(pose, str):
        check_choice("pose", pose, tuple(model.key(index).name for index in range(model.nkey)))
        return np.array(model.key(pose).qpos)
    if isinstance(pose, dict):
        positions, kinds = np.array(model.qpos0), list_joints(model)
        for name, value in pose.items():
            check_choice("pose", name, tuple(kinds))
            unit = "rad" if kinds[name] == "hinge" else "m"
            positions[int(model.joint(name).qposadr[0])] = check_number(f"pose.{name}", value, unit, ANY)
        return positions
    try:
        values = np.array(pose)
        if values.dtype.kind in "US" and values.shape == (model.nq,):
            values = [_read_position(model, index, text) for index, text in enumerate(pose)]
        values = np.array(values, float)
    except InputError:
        raise
    except (TypeError, ValueError):
        values = np.array(np.nan)
    if values.shape != (model.nq,) or not np.isfinite(values).all():
        raise InputError(f"pose: got {pose!r}; it must be {model.nq} joint positions or the name of a keyframe")
    return values


def _read_position(model: Any, index: int, value: Any) -> float:
    """Convert one entry of ``qpos``, a number or a string with a unit, to rad (hinges) or m (slides).

    ``index`` is the index of the entry in ``qpos``.
    """
    (joint,) = np.flatnonzero(np.asarray(model.jnt_qposadr) == index)
    name = model.joint(int(joint)).name
    # Accept numbers given as strings, because NumPy converts all entries of an array to strings if one is a string.
    value = float(value) if isinstance(value, str) and looks_like_number(value) else value
    unit = "m" if list_joints(model).get(name) == "slide" else "rad"
    return check_number(f"pose.{name}", value, unit, ANY)


def _find_point(mujoco: Any, model: Any, name: str) -> tuple[str, int]:
    """Return "site" or "body", and the index of the site or body with the given name in a MuJoCo model."""
    for kind, count, code in (
        ("site", model.nsite, mujoco.mjtObj.mjOBJ_SITE),
        ("body", model.nbody, mujoco.mjtObj.mjOBJ_BODY),
    ):
        if count and (kind == "site" or not model.nsite):
            names = tuple(mujoco.mj_id2name(model, code, index) or "" for index in range(count))
            check_choice("site", name, tuple(filter(None, names)))
            return kind, names.index(name)
    raise InputError(f"site: got {name!r}; the model has neither sites nor bodies; add a site")


def _find_driven(mujoco: Any, model: Any) -> np.ndarray:
    """Return a Boolean array, True for each degree of freedom with an actuator; all True if no actuator exists."""
    if not model.nu:
        return np.ones(model.nv, bool)
    on_joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if not np.isin(model.actuator_trntype, on_joints).all():
        raise InputError("model: got an actuator that does not act on a joint; use actuators of joints or pass M and J")
    return np.isin(model.dof_jntid, model.actuator_trnid[:, 0])
