#!/usr/bin/env python3
"""Find the cheapest device that renders a wall of 20 kN/m, with exact gradients of the stiffest stable wall.

The device has a mass of 100 g and a delay of one sampling period. Damping has a price, because the hand feels it in
free space, and so has a high sampling rate, which requires a better computer and sensor. SciPy finds the cheapest pair
of damping and rate that reaches the stiffness, as a constrained problem. If optax is installed, its Adam optimizer
solves the dual problem, the stiffest wall for this price; the result must be 20 kN/m again.
"""

from __future__ import annotations

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from zwidth import max_stiffness, sensitivities

MASS = 0.1  # kg
WANTED = 20e3  # N/m
DAMPING_PRICE = 1.0  # per N s/m
RATE_PRICE = 80.0  # per kHz


def price(damping, rate):
    """Return the price of a device; damping in N s/m, rate in Hz."""
    return DAMPING_PRICE * damping + RATE_PRICE * rate / 1e3


def with_scipy() -> tuple[float, float]:
    """Minimize the price subject to K_max >= WANTED, with the exact gradient of the constraint."""

    def device(x):
        """Return the parameters for x = (damping in N s/m, rate in kHz); the delay is one period."""
        period = 1e-3 / x[1]
        return {"mass": MASS, "damping": x[0], "period": period, "delay": period}

    def stiffness(x):
        return float(sensitivities(**device(x)).stiffness_max) / WANTED - 1.0

    def stiffness_slope(x):
        gain = sensitivities(**device(x))
        # Chain rule: the delay equals the period, and the period is the reciprocal of the rate.
        per_rate = (gain.per_period + gain.per_delay) * (-1e-3 / x[1] ** 2)
        return np.array([gain.per_damping, per_rate], dtype=float) / WANTED

    found = minimize(
        lambda x: price(x[0], 1e3 * x[1]),
        x0=[30.0, 0.5],
        jac=lambda x: np.array([DAMPING_PRICE, RATE_PRICE]),
        method="SLSQP",
        bounds=[(0.0, 100.0), (0.1, 10.0)],
        constraints={"type": "ineq", "fun": stiffness, "jac": stiffness_slope},
        options={"ftol": 1e-12},
    )
    return float(found.x[0]), float(1e3 * found.x[1])


def with_optax(budget: float) -> tuple[float, float]:
    """Find the stiffest wall for a budget; the budget not spent on the rate is spent on damping."""
    import optax

    def damping_and_rate(log_rate):
        rate = 1e3 * jnp.exp(log_rate)
        return (budget - RATE_PRICE * rate / 1e3) / DAMPING_PRICE, rate

    def softness(log_rate):
        damping, rate = damping_and_rate(log_rate)
        return -jnp.log(max_stiffness(mass=MASS, damping=damping, period=1.0 / rate, delay=1.0 / rate))

    optimizer = optax.adam(optax.cosine_decay_schedule(0.05, 150))

    @jax.jit
    def step(log_rate, state):
        update, state = optimizer.update(jax.grad(softness)(log_rate), state)
        return optax.apply_updates(log_rate, update), state

    log_rate = jnp.asarray(-1.0)
    state = optimizer.init(log_rate)
    for _ in range(150):
        log_rate, state = step(log_rate, state)
    damping, rate = damping_and_rate(float(log_rate))
    return float(damping), float(rate)


def report(name: str, damping: float, rate: float) -> None:
    """Print the device, its maximum stiffness and its price in one line."""
    gain = sensitivities(mass=MASS, damping=damping, period=1 / rate, delay=1 / rate)
    print(
        f"{name:<7} b = {damping:.3f} N s/m, rate = {rate:.1f} Hz: K_max = {float(gain.stiffness_max) / 1e3:.3f} kN/m, "
        f"price {price(damping, rate):.4f}"
    )


def main() -> None:
    print(f"cheapest {MASS * 1e3:.0f} g device for {WANTED / 1e3:.0f} kN/m, force delayed by one period")
    cheapest = with_scipy()
    report("scipy", *cheapest)
    if importlib.util.find_spec("optax") is not None:
        report("optax", *with_optax(price(*cheapest)))


if __name__ == "__main__":
    main()
