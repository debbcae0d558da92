"""Devices with several joints, reduced to one direction of motion of a point, such as the handle of an arm.

The joints have coordinates q, the mass matrix M, the damping matrix D and the stiffness matrix S of springs to ground:

    M q'' + D q' + S q = J' n f,    x = n' J q

The wall measures the displacement x of the point along the unit vector n, with the Jacobian J of the point, and the
motors produce the joint torques J' n f that correspond to a force f along n. The point is free in all other directions.
With the Cholesky factor L of M = L L' and the coordinates L' q, the mass matrix becomes the identity, and force and
position have the same vector w = L^-1 J' n. The smallest subspace that contains w, and that D and S map into itself, is
the part of the motion that is excited and measured; all other motions are left out. If a single motion remains, the
device is a rigid mass

    m = 1/(n' J M^-1 J' n)

(the effective mass of Khatib, 1987), otherwise a linear system of higher order.

Gravity and forces that depend on the square of the velocity are not modeled, because they do not act on small motions
about a pose in which a motor torque compensates gravity.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.core.errors import InputError, check_choice, format_install_command
from zwidth.model.checks import check_number
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.units.parsing import looks_like_number
from zwidth.units.quantities import ANY

# Relative size below which a component of a vector, or an eigenvalue, is treated as a rounding error.
NEGLIGIBLE = 1e-11
# Largest asymmetry of a matrix, relative to its largest entry, that is attributed to rounding errors.
ASYMMETRY = 1e-6
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def from_mass_matrix(
    mass_matrix: Any,
    damping: Any = 0.0,
    *,
    direction: Any = None,
    jacobian: Any = None,
    stiffness: Any = 0.0,
    rotary: bool = False,
) -> Device | LinearDevice:
    """Return the device that a wall along one direction acts on, for an arm with several joints in one pose.

    The motors of all joints produce the torques ``J' n f`` for a force f along the direction n, and the wall measures
    the displacement ``n' J q`` of the point, with the joint coordinates q and the Jacobian J. All other directions are
    free. A joint without motor and encoder has a column of zeros in J. Friction, gravity and the dependence on the pose
    are not included.

    Args:
        mass_matrix: symmetric, positive definite matrix M of the joints, shape (joints, joints), in kg m^2 for hinges
            and in kg for slides, including the inertia of the motors.
        damping: viscous damping of the joints in N m s/rad (hinges) or N s/m (slides): one number, one per joint, or a
            symmetric matrix without negative eigenvalues.
        direction: direction n of the wall, of any length > 0: "x", "y" or "z", or a vector with one component per row
            of the Jacobian. It may be omitted if the Jacobian has a single row.
        jacobian: Jacobian J of the point, with one column per joint and one row per axis: the velocity of the point is
            ``J q'`` for the joint velocities q'. None if ``direction`` is in joint coordinates.
        stiffness: stiffness of springs from the joints to ground in N m/rad or N/m, in the same form as ``damping``. A
            spring k between two coordinates has the matrix ``[[k, -k], [-k, k]]``.
        rotary: True if the direction is an axis of rotation. A `Device` then has rotary units; a `LinearDevice` prints
            the units of a linear device in any case.

    Returns:
        A `Device` with the effective mass ``1/(n' J M^-1 J' n)`` and its damping if a single motion remains, for
        example without damping or if the damping is proportional to M; otherwise a `LinearDevice`.

    Raises:
        InputError: an array has the wrong shape, is not finite or not symmetric; M is not positive definite; damping or
            stiffness has a negative eigenvalue; or no joint moves the point along the direction.

    References:
        O. Khatib, IEEE Journal of Robotics and Automation 3(1), 1987, the effective mass of an arm along a direction.

    Example:
        >>> import zwidth
        >>> arm = zwidth.from_mass_matrix([[0.03, 0.01], [0.01, 0.01]], damping=0.02, jacobian=[[-0.2, -0.1]])
        >>> scene = zwidth.Scene(arm, zwidth.Timing(period="1 ms", delay="1 ms"))
        >>> print(f"{scene.max_stiffness().stiffness / 1e3:.2f} kN/m")
        96.54 kN/m
    """
    inertia = _read_matrix("mass_matrix", mass_matrix, None)
    joints = len(inertia)
    vector = _project(direction, jacobian, joints)
    damper, spring = (
        _read_matrix(name, value, joints) for name, value in (("damping", damping), ("stiffness", stiffness))
    )
    try:
        factor = np.linalg.cholesky(inertia)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(inertia)[0]
        raise InputError(
            f"mass_matrix: got an eigenvalue of {smallest:.4g}; all must be > 0; add the inertia of the motors"
        ) from None
    w, D, S = _reduce(*_normalize(factor, vector, damper, spring))
    if len(w) == 1 and S[0, 0] == 0.0:
        # Solve with M instead of its factor, because a product of two square roots is not exact.
        mass = 1.0 / float(vector @ np.linalg.solve(inertia, vector))
        return Device(mass, float(D[0, 0]) * mass, rotary=rotary)
    return LinearDevice(_realize(w, D, S))


def from_mujoco(
    model: Any, site: str, direction: Any, *, pose: Any = None, rotary: bool = False
) -> Device | LinearDevice:
    """Return the device that a wall along one direction at a site of a MuJoCo model acts on; see `from_mass_matrix`.

    Mass matrix (with armature), Jacobian, joint damping and joint springs come from the model in the given pose. Joints
    with actuators are driven and measured, all others move passively; in a model without actuators, all joints are
    driven. The wall replaces the gains of the actuators. Friction, contacts, and gravity are not included. Needs the
    extra ``mujoco``.

    Args:
        model: path of a model (MJCF ``.xml``, ``.urdf`` or ``.mjb``) or a ``mujoco.MjModel``.
        site: name of the site, the point on which the wall acts. For a model without sites, such as one from URDF, the
            name of a body, whose origin is the point.
        direction: "x", "y", "z" or a vector of three components in world coordinates.
        pose: pose of the model in one of four forms: a list of joint positions (``qpos``), as numbers in rad or m or as
            texts such as "30 deg"; a dict of joint positions keyed by joint name, with all other joints in their
            reference positions; the name of a keyframe of the model; None for the reference pose ``qpos0``.
        rotary: True for a wall that acts on the rotation about ``direction``, such as a knob or a steering wheel.

    Returns:
        A `Device` or `LinearDevice`, as `from_mass_matrix`.

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
    return from_mass_matrix(
        inertia,
        np.array(model.dof_damping),
        direction=direction,
        jacobian=jacobian,
        stiffness=springs,
        rotary=rotary,
    )


def _read_matrix(name: str, value: Any, joints: int | None) -> np.ndarray:
    """Return a symmetric matrix of the joints; a number, or one number per joint, is converted to a diagonal matrix.

    Args:
        name: name of the field, for error messages.
        value: matrix; if ``joints`` is given, also a number or a vector.
        joints: number of joints, or None if the matrix determines it.
    """
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: got {value!r}; it must be numbers in SI units") from None
    if joints is not None and array.ndim < 2:
        if array.ndim == 1 and array.size != joints:
            raise InputError(f"{name}: got {array.size} values for {joints} joints; give one number or one per joint")
        array = np.diag(np.broadcast_to(array, joints))
    shape = (joints, joints) if joints is not None else (len(array),) * 2 if array.ndim == 2 else None
    if array.shape != shape or not array.size:
        allowed = "(joints, joints)" if joints is None else f"({joints}, {joints})"
        raise InputError(f"{name}: got shape {array.shape}; it must be {allowed}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: got a value that is not finite; all must be finite numbers")
    size = np.abs(array).max()
    if np.abs(array - array.T).max() > ASYMMETRY * size:
        raise InputError(f"{name}: got a matrix that is not symmetric; use (A + A')/2 if rounding is the reason")
    array = 0.5 * (array + array.T)
    if joints is not None and size > 0:
        smallest = np.linalg.eigvalsh(array)[0]
        if smallest < -NEGLIGIBLE * size:
            raise InputError(f"{name}: got an eigenvalue of {smallest:.4g}; all must be >= 0; correct its sign")
    return array


def _project(direction: Any, jacobian: Any, joints: int) -> np.ndarray:
    """Return the joint torques J' n for a unit force along the direction n, with the Jacobian J; shape (joints,)."""
    try:
        rows = np.eye(joints) if jacobian is None else np.array(jacobian, float)
        if isinstance(direction, str):
            check_choice("direction", direction, tuple(_AXES))
            direction = _AXES[direction][: len(rows)]
        if direction is None and len(rows) > 1:
            raise InputError(f"direction: missing; give a vector of {len(rows)} components, or 'x', 'y' or 'z'")
        n = np.array([1.0] if direction is None else direction, float)
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError("jacobian, direction: got values that are not numbers; give numbers in SI units") from None
    if rows.ndim != 2 or rows.shape[1] != joints:
        raise InputError(f"jacobian: got shape {rows.shape}; it must be (axes, {joints}), one column per joint")
    if n.shape != (len(rows),):
        raise InputError(f"direction: got shape {n.shape}; it must be ({len(rows)},), one component per row of J")
    if not (np.isfinite(rows).all() and np.isfinite(n).all() and np.any(n)):
        raise InputError("direction: got a zero or nonfinite vector, or a nonfinite jacobian; give finite numbers")
    vector = rows.T @ (n / np.linalg.norm(n))
    if np.linalg.norm(vector) <= NEGLIGIBLE * np.linalg.norm(rows):
        raise InputError("direction: no joint moves the point along it in this pose; choose another pose or direction")
    return vector


def _normalize(
    factor: np.ndarray, vector: np.ndarray, damper: np.ndarray, spring: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return force vector w, damping D and stiffness S in the coordinates L' q, with the mass matrix M = L L'."""

    def transform(matrix: np.ndarray) -> np.ndarray:
        """Return L^-1 A L^-T for a symmetric matrix A and the Cholesky factor L; the result is exactly symmetric."""
        half = np.linalg.solve(factor, matrix)
        whole = np.linalg.solve(factor, half.T)
        return 0.5 * (whole + whole.T)

    return np.linalg.solve(factor, vector), transform(damper), transform(spring)


def _reduce(w: np.ndarray, D: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Restrict the system to the smallest subspace that contains the force vector w and is invariant under D and S.

    The damping D and the stiffness S are symmetric, so the orthogonal complement of the subspace is invariant as well:
    its motions are neither excited nor measured.
    """
    basis = [w / np.linalg.norm(w)]
    sizes = [float(np.linalg.norm(matrix, 2)) for matrix in (D, S)]
    for vector in basis:
        for matrix, size in zip((D, S), sizes, strict=True):
            image = matrix @ vector
            # Orthogonalize twice, because the rounding errors of one pass are relative to the removed component.
            for _ in range(2):
                image = image - sum((image @ base) * base for base in basis)
            if np.linalg.norm(image) > NEGLIGIBLE * size and len(basis) < len(w):
                basis.append(image / np.linalg.norm(image))
    V = np.array(basis).T
    return V.T @ w, _clear(V.T @ D @ V, sizes[0]), _clear(V.T @ S @ V, sizes[1])


def _clear(matrix: np.ndarray, size: float) -> np.ndarray:
    """Return a symmetric matrix, with entries that are rounding errors relative to ``size`` replaced by 0."""
    matrix = 0.5 * (matrix + matrix.T)
    return np.where(np.abs(matrix) > NEGLIGIBLE * size, matrix, 0.0)


def _realize(w: np.ndarray, D: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a minimal state-space model (A, B, C) whose poles at s = 0, those of motions without springs, are exact.

    The free motions N (the null space of the stiffness S) are those without springs, R are the other motions; q are
    positions and v velocities. The free positions affect the output only by their sum w_N' q_N, which is one state y0;
    the states are (y0, q_R, v_N, v_R). Without this separation, rounding errors would move the poles at s = 0.
    """
    stiffness, vectors = np.linalg.eigh(S)
    free = stiffness <= NEGLIGIBLE * max(stiffness[-1], 0.0)
    N, R = vectors[:, free], stiffness[~free]
    if N.shape[1]:
        # Diagonalize the damping of the free motions, so that an undamped motion is an exact double integrator.
        damping, turn = np.linalg.eigh(N.T @ D @ N)
        N = N @ turn
        undamped = damping <= NEGLIGIBLE * np.linalg.norm(D, 2)
    else:
        undamped = np.zeros(0, bool)
    T = np.concatenate([N, vectors[:, ~free]], axis=1)
    w, D = T.T @ w, T.T @ D @ T
    count = len(undamped)
    D[:count][undamped] = D[:, :count][:, undamped] = 0.0
    has_free = int(count > 0)
    size, springs = len(w), len(R)
    positions = has_free + springs
    A = np.zeros((positions + size, positions + size))
    if has_free:
        A[0, positions : positions + count] = w[:count]
    A[has_free:positions, positions + count :] = np.eye(springs)
    A[positions + count :, has_free:positions] = -np.diag(R)
    A[positions:, positions:] = -D
    B = np.concatenate([np.zeros(positions), w])
    C = np.concatenate([np.ones(has_free), w[count:], np.zeros(size)])
    return A, B, C


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


def _reject_constraints(model: Any) -> None:
    """Raise `InputError` if a MuJoCo model has parts that affect its motion, but not its mass matrix."""
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
    """Convert one entry of ``qpos``, a number or a text with a unit, to rad (hinges) or m (slides).

    ``index`` is the index of the entry in ``qpos``.
    """
    (joint,) = np.flatnonzero(np.asarray(model.jnt_qposadr) == index)
    name = model.joint(int(joint)).name
    # Accept a number that is given as text, because an array with one text contains only texts. A number without a unit
    # is in rad or m.
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
    """Return a Boolean array, True for each degree of freedom with an actuator; all True without any actuators."""
    if not model.nu:
        return np.ones(model.nv, bool)
    on_joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if not np.isin(model.actuator_trntype, on_joints).all():
        raise InputError("model: got an actuator that does not act on a joint; use actuators of joints or pass M and J")
    return np.isin(model.dof_jntid, model.actuator_trnid[:, 0])
