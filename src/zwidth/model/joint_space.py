"""Models of arms with several joints, reduced to the motion of one point, such as a handle, along a unit vector n.

J is the Jacobian of the point and J' its transpose. The joints have coordinates q with the velocities q', the mass
matrix M, the damping matrix D and the stiffness matrix S of springs to ground:

    M q'' + D q' + S q = J' n f,    x = n' J q

The wall measures the displacement x of the point along n, and the motors produce the joint torques J' n f that
correspond to a force f along n. The point is free in all other directions. With the Cholesky factor L of M = L L' and
the coordinates L' q, the mass matrix becomes the identity, and force and position have the same vector w = L^-1 J' n.
The smallest subspace that contains w, and that D and S map into itself, is the part of the motion that is excited and
measured; all other motions are left out. If a single motion remains, the device is a rigid mass

    m = 1/(n' J M^-1 J' n)

(the effective mass of Khatib, 1987), otherwise a linear system of higher order.

Gravity and forces that depend on the square of the velocity are not modeled, because they do not act on small motions
about a pose in which a motor torque compensates gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError, check_choice, describe_choice
from zwidth.core.xp import is_traced
from zwidth.model.checks import check_number
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.units.parsing import detect_kind
from zwidth.units.quantities import ANY, NOT_NEGATIVE
from zwidth.units.unit_system import SYSTEMS

# Relative size below which a component of a vector, or an eigenvalue, is treated as a rounding error.
NEGLIGIBLE = 1e-11
# Largest asymmetry of a matrix, relative to its largest entry, that is attributed to rounding errors.
ASYMMETRY = 1e-6
# Unit of each field for slides (prismatic joints); hinges have the corresponding unit of rotation.
_UNITS = {"mass_matrix": "kg", "damping": "N s/m", "stiffness": "N/m"}
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class Joints(NamedTuple):
    """Matrices of the joints, and the joint torques J' n for a unit force along n; all as tuples, in SI units."""

    mass_matrix: tuple[tuple[float, ...], ...]
    damping: tuple[tuple[float, ...], ...]
    stiffness: tuple[tuple[float, ...], ...]
    vector: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class JointDevice(LinearDevice):
    """Linear system of an arm with several joints, for a wall along one direction; its parameters are joint dampings.

    `from_mass_matrix` creates it. The damping of joint k, counted from 0, is the entry (k, k) of the damping matrix D.
    Its dotted path in a scene is "joints.k.damping", such as "joints.0.damping".
    """

    system: Any = field(init=False, default=None)  # linear system, computed from the matrices of the joints
    joints: Joints | None = None

    def __post_init__(self, sampled: Any) -> None:
        # Always compute the linear system from the matrices of the joints, so that the two fields agree.
        M, D, S, vector = map(np.array, self._get_joints())
        reduced = _reduce(*_normalize(np.linalg.cholesky(M), vector, D, S))
        object.__setattr__(self, "system", _realize(*reduced))
        super().__post_init__(sampled)

    def __repr__(self) -> str:
        """Return the expression that creates the device."""
        rotary = ", rotary=True" if self.rotary else ""
        return f"from_mass_matrix({', '.join(f'{name}={value}' for name, value in self.spell_form().items())}{rotary})"

    def spell_form(self) -> dict[str, Any]:
        """Return the mapping that describes the device in a configuration, under the key ``device``."""
        joints = self._get_joints()
        matrices = {name: [list(row) for row in getattr(joints, name)] for name in joints._fields[:3]}
        # Write n' J as a Jacobian with one row: the direction n is already included, so no key ``direction`` is added.
        return {**matrices, "jacobian": [list(joints.vector)]}

    def _get_joints(self) -> Joints:
        """Return the matrices of the joints."""
        assert self.joints is not None, "from_mass_matrix passes the joints"
        return self.joints

    @property
    def joint_dampings(self) -> dict[str, float]:
        """The damping of each joint by dotted path, in N m s/rad (hinges) or N s/m (slides)."""
        return {f"joints.{k}.damping": row[k] for k, row in enumerate(self._get_joints().damping)}

    def replace_dampings(self, values: dict[str, Any]) -> JointDevice:
        """Return a copy of the device with new joint dampings; ``values`` maps dotted paths to dampings."""
        joints, paths = self._get_joints(), list(self.joint_dampings)
        damping = np.array(joints.damping)
        for path, value in values.items():
            if path not in paths:
                raise InputError(f"parameter: {describe_choice(path, tuple(paths))}")
            if is_traced(value):
                raise InputError(f"{path}: got a value traced by JAX; it must be a number; use Scene.sensitivities")
            unit = SYSTEMS[detect_kind(value) is not False]["N s/m"]
            k = paths.index(path)
            damping[k, k] = check_number(path, value, unit, NOT_NEGATIVE)
        checked = _read_matrix("damping", damping, len(damping))
        return replace(self, joints=joints._replace(damping=_to_tuples(checked)))


def _to_tuples(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return the rows of a matrix as tuples of floats."""
    return tuple(map(tuple, matrix.tolist()))


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
            and in kg for slides, including the inertia of the motors. All entries of the matrices of mass,
            damping and stiffness are numbers in SI units, or strings with units such as "20 mN m s/rad".
        damping: viscous damping of the joints in N m s/rad (hinges) or N s/m (slides): one number, one per joint, or a
            symmetric matrix without negative eigenvalues.
        direction: direction n of the wall, of any length > 0: "x", "y" or "z", or a vector with one component per row
            of the Jacobian. It may be omitted if the Jacobian has a single row.
        jacobian: Jacobian J of the point, with one column per joint and one row per axis: the velocity of the point is
            ``J q'`` for the joint velocities q'. Entries are numbers in SI units, or lengths with a unit such as
            "20 cm". None if ``direction`` is in joint coordinates.
        stiffness: stiffness of springs from the joints to ground in N m/rad or N/m, in the same form as ``damping``. A
            spring k between two coordinates has the matrix ``[[k, -k], [-k, k]]``.
        rotary: True if the direction is an axis of rotation; walls are then in N m/rad and N m s/rad.

    Returns:
        A `Device` with the effective mass ``1/(n' J M^-1 J' n)`` and its damping if a single motion remains, for
        example without damping or if the damping is proportional to M; otherwise a `LinearDevice`. In a scene with this
        `LinearDevice`, the damping of joint k, counted from 0, has the path "joints.k.damping": `Scene.replace` changes
        it, and `Scene.sensitivities` returns the derivative of K_max with respect to it.

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
    vector = _project(direction, jacobian, joints, rotary=rotary)
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
        # Solve with M instead of its Cholesky factor, because the square of a rounded square root is not exact.
        mass = 1.0 / float(vector @ np.linalg.solve(inertia, vector))
        return Device(mass, float(D[0, 0]) * mass, rotary=rotary)
    joints = Joints(_to_tuples(inertia), _to_tuples(damper), _to_tuples(spring), tuple(vector.tolist()))
    return JointDevice(joints=joints, rotary=rotary)


def _read_matrix(name: str, value: Any, joints: int | None) -> np.ndarray:
    """Return a symmetric matrix of the joints; a number, or one number per joint, is converted to a diagonal matrix.

    Args:
        name: name of the field, for error messages.
        value: matrix; if ``joints`` is given, also a number or a vector.
        joints: number of joints, or None if the matrix determines it.
    """
    try:
        array = np.array(_convert_units(name, value), float)
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError(f"{name}: got {value!r}; it must be numbers, one list per row") from None
    if joints is not None and array.ndim < 2:
        if array.ndim == 1 and array.size != joints:
            raise InputError(f"{name}: got {array.size} values for {joints} joints; give one number or one per joint")
        array = np.diag(np.broadcast_to(array, joints))
    shape = (joints, joints) if joints is not None else (len(array),) * 2 if array.ndim == 2 else None
    if array.shape != shape or not array.size:
        got = f"shape {array.shape}" if array.ndim else "one number"
        allowed = "a square matrix" if joints is None else f"a matrix of shape ({joints}, {joints})"
        raise InputError(
            f"{name}: got {got}; it must be {allowed} with one row per joint, such as [[0.03, 0], [0, 0.01]]"
        )
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


def _convert_units(name: str, value: Any) -> Any:
    """Return a matrix, a vector or a number with all strings, such as "20 mN m s/rad", in SI units.

    ``name`` is the name of the field, which determines the dimension: a mass, a damping or a stiffness, in the units of
    rotation for hinges and of translation for slides; or a length for the Jacobian of hinges.
    """
    if isinstance(value, list | tuple):
        return [_convert_units(name, entry) for entry in value]
    if not isinstance(value, str):
        return value
    unit = "m" if name == "jacobian" else SYSTEMS[detect_kind(value) is not False][_UNITS[name]]
    return check_number(name, value, unit, ANY)


def _project(direction: Any, jacobian: Any, joints: int, *, rotary: bool) -> np.ndarray:
    """Return the joint torques J' n for a unit force along the direction n, with the Jacobian J; shape (joints,).

    The Jacobian of a rotary device has no lengths.
    """
    rows = np.eye(joints) if jacobian is None else _read_array("jacobian", jacobian, lengths=not rotary)
    if rows.ndim != 2 or rows.shape[1] != joints:
        raise InputError(f"jacobian: got shape {rows.shape}; it must be (axes, {joints}), one column per joint")
    if isinstance(direction, str):
        check_choice("direction", direction, tuple(_AXES))
        names = list(_AXES)[: len(rows)]
        if direction not in names:
            raise InputError(
                f"direction: got {direction!r}; the Jacobian has {len(rows)} row{'s' * (len(rows) > 1)}; use "
                f"{' or '.join(map(repr, names))}, or add a row for each further axis"
            )
        direction = _AXES[direction][: len(rows)]
    if direction is None and len(rows) > 1:
        raise InputError(f"direction: missing; give a vector of {len(rows)} components, or 'x', 'y' or 'z'")
    n = _read_array("direction", [1.0] if direction is None else direction)
    if n.shape != (len(rows),):
        raise InputError(f"direction: got shape {n.shape}; it must be ({len(rows)},), one component per row of J")
    if not np.any(n):
        raise InputError("direction: got a zero vector; it must have a length > 0; give a vector such as [0, 1]")
    vector = rows.T @ (n / np.linalg.norm(n))
    if np.linalg.norm(vector) <= NEGLIGIBLE * np.linalg.norm(rows):
        raise InputError("direction: no joint moves the point along it in this pose; choose another pose or direction")
    return vector


def _read_array(name: str, value: Any, *, lengths: bool = False) -> np.ndarray:
    """Convert a value to an array of finite numbers.

    Args:
        name: name of the field in error messages.
        value: value to convert.
        lengths: True if texts with a unit of length are allowed.
    """
    try:
        array = np.array(_convert_units(name, value) if lengths else value, float)
    except InputError:
        raise
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        unit = ", or texts with a unit of length" if lengths else ""
        raise InputError(f"{name}: got {value!r}; it must be finite numbers{unit}")
    return array


def _normalize(
    factor: np.ndarray, vector: np.ndarray, damper: np.ndarray, spring: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return force vector, damping and stiffness in the coordinates L' q, whose mass matrix is the identity.

    ``factor`` is L, the Cholesky factor of the mass matrix M = L L'. The other arguments are in the coordinates q.
    """

    def transform(matrix: np.ndarray) -> np.ndarray:
        """Return L^-1 A L^-T for a symmetric matrix A and the Cholesky factor L; the result is exactly symmetric."""
        half = np.linalg.solve(factor, matrix)
        whole = np.linalg.solve(factor, half.T)
        return 0.5 * (whole + whole.T)

    return np.linalg.solve(factor, vector), transform(damper), transform(spring)


def _reduce(w: np.ndarray, D: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Restrict the system to the smallest subspace that contains the force vector w and is invariant under D and S.

    The damping D and the stiffness S are symmetric, so the orthogonal complement of the subspace is invariant as well:
    motions in the complement are neither excited nor measured.
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

    The index N marks motions without springs (the null space of the stiffness S), the index R all other motions; q are
    positions, v velocities and w the force vector. The positions q_N affect the output only by the scalar w_N' q_N,
    which is the first state y0. The states are (y0, q_R, v_N, v_R). With all q_N as states, rounding errors would move
    the poles at s = 0.
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
