"""Simulate a mass with friction, an actuator lag and resonances under a logged force with zero-order hold.

The actuator lag A(s) and the resonances (*modes*) are linear. They therefore add to the response of the rigid mass
(`zwidth.identification.friction_model`) a sum over their poles p of ``r E_p``. The *filtered force* E_p satisfies
``E_p' = p E_p + F(t - d)`` with the force F and the delay d; the *weight* r is the residue of the pole. For a lag
``A = sum r_j/(s - p_j)``, the partial fractions are, with delta = b T/m,

    A(s)/(s (s + delta)) = 1/(s (s + delta)) + sum_j (r_j/p_j)/(p_j + delta) (1/(s - p_j) - 1/(s + delta)).

The derivative of E_p with respect to p is E_p filtered once more by the same pole; that with respect to d is -E_p'.

Friction is not linear. The times at which friction stops the mass are approximated by those of a rigid mass whose delay
is increased by the delay of the lag at low frequencies, -A'(0). This approximation neglects that the lag also smooths
the force. Times are in sampling periods T; ``theta`` is the parameter vector defined by `Recordings`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zwidth.identification.device_estimate import DimensionlessDevice
from zwidth.identification.friction_model import ModelResponse, Recording, recur
from zwidth.identification.quantization_noise import MeasurementNoise
from zwidth.plant.rigid_mass import phi_functions
from zwidth.plant.sampled_plant import expand_partial_fractions, integrate_pole

# Step of central differences: absolute for the pole of a filter, relative for the parameters; for delta at least this
# value, because delta may be 0.
_STEP = 1e-6
# Lower and upper bounds of the parameters.
LAG_RANGE = (0.02, 5.0)  # time constant tau of the actuator lag, in sampling periods
FREQUENCY_RANGE = (0.0125, 3.11)  # frequency of a mode, in rad per sample
RATIO_RANGE = (1e-6, 4.0)  # damping ratio zeta of a mode or of a second-order lag
# Bounds of the low-frequency delay 2 zeta tau of a second-order lag, in sampling periods. The upper bound is the
# largest delay with zeta = 1.
_DELAY_RANGE = 2.0 * RATIO_RANGE[0] * LAG_RANGE[0], 2.0 * LAG_RANGE[1]


@dataclass(frozen=True)
class Recordings:
    """Several logs of one device, together with the structure of the model that is fitted to them.

    The parameter vector theta contains, in this order:

    - g = T^2/m, delta = b T/m and the delay d;
    - for a lag: its delay at low frequencies, which is tau for order 1 and 2 zeta tau for order 2, and for order 2 also
      the damping ratio zeta. The low-frequency delay is used in place of the time constant tau, because a log
      determines the sum of this delay and d much better than either of them, so that the optimizer can take long steps;
    - for each mode: the frequency in rad per sample, the damping ratio, and T^2/m_i with the modal mass m_i;
    - for each log: initial position x0 and velocity v0 of the mass;
    - for each log and mode: two amplitudes of the free response of the mode;
    - o and c, the accelerations by the constant force and by the friction.

    Attributes:
        logs: the logs.
        noise: noise model that determines the weights of the positions; None for equal weights.
        lag: order of the actuator lag, 0 for none.
        modes: number of modes.
        longest: largest delay of the search, in sampling periods.
        resolution: encoder step, 0 for a sensor without steps.
    """

    logs: tuple[Recording, ...]
    noise: MeasurementNoise | None = None
    lag: int = 0
    modes: int = 0
    longest: float = 20.0
    resolution: float = 0.0

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Weight the rows of an array, one per sample, by the noise model; return it unchanged without noise model."""
        return columns if self.noise is None else self.noise.weigh(columns)

    def truncate(self, count: int) -> Recordings:
        """Return a copy with equal weights, whose logs end ``count`` positions after their first change of force."""
        return replace(self, logs=tuple(log.truncate(count) for log in self.logs), noise=None)

    @property
    def measured(self) -> np.ndarray:
        """The measured positions of all logs in one array."""
        return np.concatenate([log.position for log in self.logs])

    def split(self, column: np.ndarray) -> list[np.ndarray]:
        """Split an array that contains the samples of all logs in succession into a list with one array per log."""
        return np.split(column, np.cumsum([log.position.size for log in self.logs])[:-1])

    @property
    def size(self) -> int:
        """The number of parameters in theta."""
        return self.parts.stop + 2 + 2 * (1 + self.modes) * len(self.logs)

    @property
    def parts(self) -> slice:
        """The slice of theta that contains the parameters of the lag and of the modes."""
        return slice(3, 3 + self.lag + 3 * self.modes)

    @property
    def velocity_indices(self) -> np.ndarray:
        """The indices of the initial velocities v0 in theta, one per log."""
        return self.parts.stop + 1 + 2 * np.arange(len(self.logs))

    @property
    def largest_force(self) -> float:
        """The largest magnitude of the commanded forces in all logs."""
        return max(float(np.abs(log.force).max()) for log in self.logs)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds of theta."""
        low, high = np.full((2, self.size), [[-np.inf], [np.inf]])
        lag = [LAG_RANGE if self.lag == 1 else _DELAY_RANGE, RATIO_RANGE][: self.lag]
        ends = lag + self.modes * [FREQUENCY_RANGE, RATIO_RANGE, (-np.inf, np.inf)]
        low[self.parts], high[self.parts] = np.reshape(ends, (-1, 2)).T
        # Allow slightly negative dampings and delays, so that an optimum at 0 is not at a bound. Limit the damping to
        # the rate of the fastest lag, because the partial fractions require distinct poles.
        count = max(log.force.size for log in self.logs)
        low[1:3], high[1:3] = (-5.0 / count, -1.0), (0.99 / LAG_RANGE[0], self.longest)
        return low, high

    def normalize(self, theta: np.ndarray, period: Any) -> DimensionlessDevice:
        """Convert theta to a device in units of its mass and of the sampling period.

        Further axes of ``theta`` become axes of the fields of the device.
        """
        modes = theta[self.parts][self.lag :].reshape(self.modes, 3, *theta.shape[1:]).copy()
        modes[:, 2] /= theta[0]
        lag = theta[3 : 3 + self.lag].copy()
        lag[:1] /= 2.0 * lag[1] if self.lag == 2 else 1.0
        return DimensionlessDevice(period**2 / theta[0], theta[1], theta[2], lag, modes)

    def simulate(self, theta: np.ndarray) -> ModelResponse:
        """Simulate the device with parameters theta under the forces of all logs; the positions are in one array."""
        each = [self.simulate_log(theta, k) for k in range(len(self.logs))]
        place = np.concatenate([response.position for response in each])
        return ModelResponse(place, lambda: np.concatenate([response.derivatives for response in each]))

    def simulate_log(self, theta: np.ndarray, k: int) -> ModelResponse:
        """Simulate the device with parameters theta under the forces of log ``k``."""
        late, by_late = _limit_lag_delay(theta, self.lag, self.logs[k])
        v0 = self.velocity_indices[k]
        # Select the parameters of the rigid mass from theta, in the order of the arguments of `Recording.move`.
        rigid_indices = np.array([0, 1, 2, v0 - 1, v0, -2, -1])
        rigid = self.logs[k].move(*(theta[rigid_indices] + late * np.eye(7)[2]).tolist())
        parts = self.simulate_parts(theta, k) if self.lag or self.modes else None

        def differentiate() -> np.ndarray:
            derivatives = np.zeros((theta.size, rigid.position.size)).T
            derivatives[:, rigid_indices] = rigid.derivatives
            if parts is not None:
                derivatives += parts.derivatives
                derivatives[:, 3 : 3 + self.lag] += np.outer(rigid.derivatives[:, 2], by_late)
            return derivatives

        return ModelResponse(rigid.position if parts is None else rigid.position + parts.position, differentiate)

    def simulate_parts(self, theta: np.ndarray, k: int) -> ModelResponse:
        """Simulate the contribution of lag and modes to the positions in log ``k``.

        The contribution is the difference from the rigid mass of `simulate_log`, whose delay includes that of the lag.
        """
        log, (g, delta, d) = self.logs[k], theta[:3].tolist()
        unit, samples, place = np.eye(theta.size), np.arange(log.position.size), np.zeros(log.position.size)
        poles, weights, states = self._find_poles(theta[:, None])
        first = self.parts.stop + 2 * (len(self.logs) + self.modes * k)
        filtered, free_responses, exchanged = {}, [], []
        poles, weights = poles[:, 0].tolist(), weights[:, 0]
        for j, (pole, weight, state) in enumerate(zip(poles, weights, states, strict=True)):
            filtered[pole] = _filter_force(log, pole, d)
            place += (weight * filtered[pole].position).real
            if state >= 0:
                # Add the free response of the mode. Its two parameters are the amplitudes of two real poles, or the
                # real and the imaginary part of the amplitude of a complex pole.
                by_theta = unit[first + state] - 1j * unit[first + state + 1] if pole.imag else unit[first + state]
                decay, amplitude = np.exp(pole * samples), by_theta @ theta
                place += (decay * amplitude).real
                free_responses.append((j, decay, by_theta, amplitude))
        if self.lag:
            # `simulate_log` delays the forces on the rigid mass by d plus the low-frequency delay of the lag, ``late``,
            # so that friction stops the mass at about the right times. Replace the linear part of its response by that
            # with the delay d alone, because the partial fractions require it.
            late, by_late = _limit_lag_delay(theta, self.lag, log)
            by_total = unit[2] + by_late @ unit[3 : 3 + self.lag]
            for gain, by_delay, delay in ((g, unit[2], d), (-g, by_total, d + late)):
                velocity = filtered[-delta] if delay == d else _filter_force(log, -delta, delay)
                displacement = _integrate_velocity(log, delta, delay, velocity)
                place += gain * displacement.position
                exchanged.append((gain, by_delay, velocity.position, displacement))

        def differentiate() -> np.ndarray:
            # Collect the derivatives of the positions with respect to theta as terms (a, b): each term is the real part
            # of the product of an array a over the samples and an array b over theta. The derivative of E_p with
            # respect to the delay is -E_p' = -p E_p - F.
            force = log.recent_forces[0, log.skip - int(np.floor(d)) + samples]
            terms: list[tuple[Any, Any]] = [(force, -unit[2] * weights.sum())]
            poles_by_theta, weights_by_theta = self._differentiate_poles(theta)
            for pole, weight, pole_by, weight_by in zip(poles, weights, poles_by_theta, weights_by_theta, strict=True):
                state = filtered[pole]
                terms += [(state.position, weight_by - pole * weight * unit[2]), (state.derivatives, weight * pole_by)]
            for j, decay, by_theta, amplitude in free_responses:
                terms += [(decay, by_theta), (samples * decay, amplitude * poles_by_theta[j])]
            for gain, by_delay, velocity, displacement in exchanged:
                terms += [(displacement.position, gain / g * unit[0]), (displacement.derivatives, gain * unit[1])]
                terms += [(velocity[0] - velocity, gain * by_delay)]
            rows = [(row.real, factor.real) for row, factor in terms]
            rows += [(row.imag, -factor.imag) for row, factor in terms if np.iscomplexobj(row)]
            columns, factors = map(np.array, zip(*rows, strict=True))
            return columns.T @ factors

        return ModelResponse(place, differentiate)

    def _find_poles(self, thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the poles of the lag and the modes with nonnegative imaginary part, and their weights r.

        Args:
            thetas: parameter vectors along the first axis, shape (size, count).

        Returns:
            The poles and their weights, arrays of shape (poles, count); and for each pole the index of its amplitude
            among the amplitudes of the free responses in theta, -1 for the poles of the lag.
        """
        device = self.normalize(thetas, 1.0)
        poles, weights = (np.array(each) for each in expand_partial_fractions(device.delta, device.lag, device.modes))
        states, height = np.maximum(np.arange(-len(poles), 0) + 2 * self.modes, -1), np.imag(poles[:, 0])
        # Omit the pole with negative imaginary part of each complex pair and double the weight of the other one,
        # because only the real parts of their responses are used, which are equal.
        weights = weights * thetas[0] * (1.0 + (height > 0))[:, None]
        return poles[height >= 0], weights[height >= 0], states[height >= 0]

    def _differentiate_poles(self, theta: np.ndarray) -> np.ndarray:
        """Differentiate the poles and their weights with respect to theta by central differences.

        Returns:
            An array of shape (2, poles, size): the derivatives of the poles, and those of their weights.
        """
        moving = np.r_[0, 1, self.parts]
        steps, count = _STEP * np.abs(theta[moving]), moving.size
        # Use steps that do not vanish for delta and for T^2/m_i, with the modal masses m_i, because these parameters
        # may be 0: an absolute step for delta, and the step of T^2/m for T^2/m_i.
        steps[1], steps[4 + self.lag :: 3] = max(_STEP, steps[1]), steps[0]
        thetas = np.tile(theta[:, None], 1 + 2 * count)
        thetas[moving, 1 + np.arange(count)] += steps
        thetas[moving, 1 + count + np.arange(count)] -= steps
        both = np.array(self._find_poles(thetas)[:2])
        by_theta = np.zeros((*both.shape[:2], theta.size), complex)
        by_theta[..., moving] = (both[..., 1 : 1 + count] - both[..., 1 + count :]) / (2.0 * steps)
        return by_theta


def _limit_lag_delay(theta: np.ndarray, order: int, log: Recording) -> tuple[float, np.ndarray]:
    """Return the low-frequency delay of the lag, limited so that the total delay requires no forces before the log.

    Args:
        theta: parameter vector.
        order: order of the lag, 0 for none.
        log: the log.

    Returns:
        The delay, and its derivatives with respect to the parameters of the lag.
    """
    late, by = theta[3:4].sum() if order else 0.0, np.eye(2)[0, :order]
    most = log.skip - 1.5 - theta[2]
    return (float(late), by) if late < most else (float(most), 0.0 * by)


def _filter_force(log: Recording, pole: complex, d: float) -> ModelResponse:
    """Compute the filtered force E_p at the samples that have positions; E_p is 0 at the first sample of the log.

    Args:
        log: the log.
        pole: the pole p.
        d: delay.

    Returns:
        E_p as positions, and its derivative with respect to p as derivatives of the response.
    """
    n_delay = int(np.floor(d))
    f, pole, first = d - n_delay, pole if pole.imag else pole.real, log.skip - n_delay
    with_positions = slice(first, first + log.position.size)
    # Within a period the delayed force changes once. Compute the gains from the forces before and after this change to
    # E_p at the next sample, at the pole p and, for the derivative with respect to p, at p plus and minus a step.
    near = pole + _STEP * np.array([[0.0], [1.0], [-1.0]])
    gains = integrate_pole(near, np.array([1.0 - f, f])) * np.exp([0.0, 1.0 - f] * near)
    decay = np.exp(pole)
    states = recur(decay, gains[0] @ log.recent_forces)

    def differentiate() -> np.ndarray:
        added = (gains[1] - gains[2]) * 0.5 / _STEP @ log.recent_forces
        added[1:] += decay * states[:-1]
        return recur(decay, added)[with_positions]

    return ModelResponse(states[with_positions], differentiate)


def _integrate_velocity(log: Recording, delta: float, d: float, velocity: ModelResponse) -> ModelResponse:
    """Integrate the velocity of a mass with T^2/m = 1 and without friction, and return its displacement.

    Args:
        log: the log; the displacement is relative to the first sample with a position.
        delta: damping b T/m.
        d: delay.
        velocity: velocity of the mass, E_p for p = -delta.

    Returns:
        The displacement, and its derivative with respect to delta.
    """
    n_delay = int(np.floor(d))
    spans, now = np.array([d - n_delay, 1.0 - d + n_delay, 1.0]), log.skip - n_delay
    phi = phi_functions((delta + _STEP * np.array([[0.0], [1.0], [-1.0]])) * spans)
    by_velocity, by_force = (phi.phi1 * spans).T, (phi.phi2 * spans**2).T
    # Compute the displacements in one period that are caused by the velocity at the start of the period, by the force
    # before the delayed change, and by the force after this change.
    factors = np.array([by_velocity[2], by_force[0] + by_velocity[0] * by_velocity[1], by_force[1]])
    terms = np.vstack([velocity.position[:-1], log.recent_forces[::-1, now + 1 : now + log.position.size]])

    def differentiate() -> np.ndarray:
        steps = 0.5 / _STEP * (factors[:, 1] - factors[:, 2]) @ terms - factors[0, 0] * velocity.derivatives[:-1]
        return np.append(0.0, np.cumsum(steps))

    return ModelResponse(np.append(0.0, np.cumsum(factors[:, 0] @ terms)), differentiate)
