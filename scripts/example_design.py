#!/usr/bin/env python3
"""Find the cheapest device that renders a wall of 20 kN/m, with exact gradients of the stiffest stable wall.

A 100 g device whose force acts one period after its sample. Damping costs (the hand feels it in free space), and so
does sampling fast (a better computer and sensor). Among all pairs (damping, rate) that reach the stiffness the
cheapest one is wanted. SciPy solves it as a constrained problem. Where optax is installed, its Adam answers the dual
question, the stiffest wall for that price: it must come to 20 kN/m again.
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
    """What the device costs; damping in N s/m, rate in Hz."""
    return DAMPING_PRICE * damping + RATE_PRICE * rate / 1e3


def with_scipy() -> tuple[float, float]:
    """Minimize the price subject to K_max >= WANTED; the constraint comes with its gradient."""

    def device(x):
        """x = (damping in N s/m, rate in kHz); the delay is one period."""
        period = 1e-3 / x[1]
        return {"mass": MASS, "damping": x[0], "period": period, "delay": period}

    def stiffness(x):
        return float(sensitivities(**device(x)).stiffness_max) / WANTED - 1.0

    def stiffness_slope(x):
        gain = sensitivities(**device(x))
        # The delay moves along with the period, and the period falls with the rate.
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
    """Find the stiffest wall for a budget: whatever the rate leaves of it buys damping."""
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
    """One line: the device, the stiffness it reaches, and its price."""
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
