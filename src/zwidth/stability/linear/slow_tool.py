"""Stability of a virtual coupling to a tool that a physics engine integrates only every N sampling periods.

The coupling has the normalized stiffness alpha and damping beta, and exerts the force f; w is the *increment* of the
position y of the tool per step. In each period, the program computes f from the distance e = x - y of device and tool.
The engine integrates the tool by one step of length N T at the samples 0, N, 2 N, ... (`model.tool.ToolStep`); between
these steps y is constant. F is the velocity estimate with the states s. In normalized units (T = 1 and the mass m = 1),
one period changes the state Z = (s, device, delayed forces, w, y) as follows:

    every period     f = alpha e + beta F e;  velocity estimate and device advance by one period with the force -f
    every N periods  w = decay w - spring y + gain f;  y = y + w

In a period with a step, "semi-implicit" computes f from the old y, "implicit" from the new y. If device and tool are
free, a common displacement of both does not change e. Then the positions of the device are measured relative to y, and
the state does not contain y.

The matrix H maps the state over a period without a step, S over a period with a step. The *monodromy matrix*
``H^(N-1) S`` maps the state over N periods. The loop is stable if and only if the spectral radius of this matrix is
below 1 (Floquet theory; docs/theory/passivity.md, U9). All matrices are stored minus the identity, because the
subtraction of 1 from an eigenvalue near 1 would lose digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zwidth.core.types import Array
from zwidth.model.mechanism import AnyChain
from zwidth.model.state_space import realize_estimate
from zwidth.model.tool import ToolStep
from zwidth.plant.sampled_states import sample_states
from zwidth.stability.linear.composition import find_roots
from zwidth.stability.linear.poles import log_modulus

BLOCK_SIZE = 1 << 21  # values per block of couplings; a monodromy matrix has states^2 values
# An eigenvalue counts as on the unit circle if |log|eigenvalue|| is below ON_CIRCLE or its rounding error.
# The rounding error is ROUNDING divided by the distance to the nearest other eigenvalue.
ON_CIRCLE, ROUNDING = 1e-13, 1e-15
LARGEST = 1e100  # entry of a monodromy matrix above which the products H S, H^2 S, ... are scaled against overflow


@dataclass(frozen=True, eq=False)
class SlowToolModel:
    """State-space model of the loop for all values of alpha and beta, the normalized K and B of the coupling.

    A row vector r yields a signal ``r Z``, a linear function of the state Z.
    """

    every: int  # N, periods per step of the engine
    drift: Array  # transition matrix of the state over one period without a coupling force, minus the identity
    force: Array  # change of the state per unit of the force f, which acts on the device with the opposite sign
    distance: Array  # row vector that yields the distance e from the tool to the device
    velocity: Array  # row vector that yields the velocity estimate F e
    increment: Array  # row vector that yields w, the increment of y per step
    step: Array  # row vector that yields the change of w in a step of the tool without a coupling force
    moved: Array  # change of the state if y increases by 1 while the device stays where it is
    gain: float  # change of w per unit of the force f in a step of the tool
    feedthrough: float | None  # direct feedthrough of the velocity estimate; None for "semi-implicit"

    @classmethod
    def build(cls, chain: AnyChain, tool: ToolStep) -> SlowToolModel:
        """Build the model from a device with hand, delay and velocity estimate (``chain``), and a tool."""
        F, plant, states = realize_estimate(chain.estimate), sample_states(chain), sample_states(chain).realize()
        n_filter, n_body, n_device = len(F.A), plant.psi.shape[-1], len(states.A)
        rigid = find_rigid_displacement(chain, plant.psi) if tool.spring == 0 else None
        rows = np.eye(n_filter + n_device + 1 + (rigid is None))
        w, device = rows[n_filter + n_device], slice(n_filter, n_filter + n_device)
        distance = rows[n_filter].copy()
        if rigid is None:
            y = moved = rows[-1]
            distance -= y
        else:
            y, moved = np.zeros(len(rows)), np.zeros(len(rows))
            moved[n_filter : n_filter + n_body] = -rigid
        drift, force = np.zeros(rows.shape), np.zeros(len(rows))
        drift[:n_filter, :n_filter] = F.A - np.eye(n_filter)
        drift[:n_filter] += F.B @ distance[None]
        drift[device, device] = states.A - np.eye(n_device)
        drift[n_filter : n_filter + n_body, n_filter : n_filter + n_body] = plant.psi
        force[device] = states.B[:, 0]
        velocity = float(F.D[0, 0]) * distance
        velocity[:n_filter] += F.C[0]
        feedthrough = float(F.D[0, 0]) if tool.implicit else None
        step = (float(tool.decay) - 1.0) * w - float(tool.spring) * y
        return cls(tool.every, drift, force, distance, velocity, w, step, moved, float(tool.gain), feedthrough)

    def compute_multipliers(self, alpha: Array, beta: Array) -> tuple[Array, Array]:
        """Return the eigenvalues of the monodromy matrix, and the largest ``log|eigenvalue|``, for each coupling.

        Args:
            alpha: normalized stiffness of the couplings, shape (couplings,).
            beta: normalized damping, of the same shape.

        Returns:
            Eigenvalues minus 1, shape (couplings, states), and logarithms, shape (couplings,). A logarithm is 0 if
            its absolute value is within the rounding error of its eigenvalue. If a monodromy matrix overflows, its
            eigenvalues are NaN, but its logarithm is valid. If H or S is not finite, both are NaN.
        """
        size = len(self.drift)
        multipliers, logs = np.full((alpha.size, size), complex(np.nan)), np.full(alpha.size, np.nan)
        block = max(BLOCK_SIZE // size**2, 1)
        for start in range(0, alpha.size, block):
            part = slice(start, start + block)
            multipliers[part], logs[part] = self._compute_block(alpha[part], beta[part])
        return multipliers, logs

    @np.errstate(all="ignore")
    def _compute_block(self, alpha: Array, beta: Array) -> tuple[Array, Array]:
        """Return eigenvalues minus 1 and the largest logarithm for one block of couplings."""
        hold, tick = self._build_maps(alpha, beta)
        monodromy = tick if self.every == 1 else _compose(_raise(hold, self.every - 1), tick)
        multipliers, logs = np.full(monodromy.shape[:2], complex(np.nan)), np.full(alpha.size, np.nan)
        largest = np.abs(monodromy).max((1, 2))
        regular = np.flatnonzero(largest < LARGEST)
        multipliers[regular] = np.linalg.eigvals(monodromy[regular])
        logs[regular] = _compute_logs(multipliers[regular])
        finite = np.isfinite(hold).all((1, 2)) & np.isfinite(tick).all((1, 2))
        for k in np.flatnonzero(finite & ~(largest < LARGEST)).tolist():
            logs[k] = _compute_scaled_log(hold[k], tick[k], self.every)
        return multipliers, logs

    def _build_maps(self, alpha: Array, beta: Array) -> tuple[Array, Array]:
        """Return the maps H and S of the state over a period without and with a tool step, all minus the identity."""
        f = alpha[:, None] * self.distance + beta[:, None] * self.velocity
        hold = self.drift - self.force[:, None] * f[:, None, :]
        change = self.step + self.gain * f
        if self.feedthrough is not None:
            # "implicit": the new w reduces the distance e from which f is computed, and f changes w. Solve for w.
            stiffness = self.gain * (alpha + beta * self.feedthrough)[:, None]
            change = (change - stiffness * self.increment) / (1.0 + stiffness)
        step = self.increment[:, None] * change[:, None, :]
        step = step + self.moved[:, None] * (self.increment + change)[:, None, :]
        return hold, hold + step if self.feedthrough is None else _compose(hold, step)


def find_rigid_displacement(chain: AnyChain, psi: Array) -> Array | None:
    """Return the state of the device at rest at position 1; None if it cannot rest there without a force.

    Args:
        chain: model of the device.
        psi: transition matrix of its states over one period, minus the identity.
    """
    if not np.any(find_roots(chain).poles == 0):
        return None
    # A free device stays at rest, so psi times these states is 0. The first state is the position, which is 1.
    rest = np.linalg.lstsq(psi[:, 1:], -psi[:, 0], rcond=None)[0]
    return np.concatenate([[1.0], rest])


def _compute_logs(multipliers: Array) -> Array:
    """Return the largest ``log|eigenvalue|`` from eigenvalues minus 1; 0 if it is below the rounding error."""
    each = log_modulus(multipliers)
    logs = each.max(-1)
    near = np.flatnonzero(np.abs(logs) < np.sqrt(ROUNDING))
    dominant = multipliers[near, each[near].argmax(-1)]
    gap = np.sort(np.abs(multipliers[near] - dominant[:, None]), -1)[:, 1]
    logs[near[np.abs(logs[near]) <= np.maximum(ON_CIRCLE, ROUNDING / gap)]] = 0.0
    return logs


def _compose(second: Array, first: Array) -> Array:
    """Return the product of two matrices, ``second first``; all three are stored minus the identity."""
    return second + first + second @ first


def _raise(matrix: Array, power: int) -> Array:
    """Return a power >= 1 of a matrix by repeated squaring; both are stored minus the identity."""
    result = None
    while True:
        if power & 1:
            result = matrix if result is None else _compose(result, matrix)
        power >>= 1
        if not power:
            assert result is not None
            return result
        matrix = _compose(matrix, matrix)


def _compute_scaled_log(hold: Array, tick: Array, every: int) -> float:
    """Return the largest ``log|eigenvalue|`` of a monodromy matrix, whose factors are scaled against overflow."""
    identity, scale = np.eye(len(hold)), 0.0
    product = tick + identity
    for _ in range(every - 1):
        product = product + hold @ product
        size = np.abs(product).max()
        product, scale = product / size, scale + np.log(size)
    return float(scale + np.log(np.abs(np.linalg.eigvals(product)).max()))
