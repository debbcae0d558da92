"""Draw random scenes of devices, hands, couplings and velocity estimates, and random walls around their stable set.

The closed loop of a scene, computed without zwidth, is in `any_loop`.
"""

import numpy as np

import zwidth

KINDS = ("rigid", "filter", "tip", "motor", "hand", "coupled hand", "all")


def random_velocity(rng, period):
    """Return a random velocity estimate."""
    kind = rng.integers(0, 6)
    if kind == 1:
        return zwidth.WindowedDifference(int(rng.integers(2, 15)))
    if kind == 2:
        return zwidth.LowPass(cutoff=10 ** rng.uniform(-2.5, -0.4) / period)
    if kind == 3:
        return zwidth.LowPass(time_constant=period * 10 ** rng.uniform(-0.5, 1.5), order=2)
    if kind == 4:
        return zwidth.Butterworth(10 ** rng.uniform(-1.8, -0.4) / period, int(rng.integers(1, 5)))
    if kind == 5:
        return zwidth.VelocityFilter(np.convolve([1, -1], [1, 0.3]) / period / 1.3, [1, -0.2, 0])
    return zwidth.BackwardDifference()


def random_scene(kind, rng):
    """Return a random scene whose stable walls are within some units of alpha and beta."""
    mass, period = 10 ** rng.uniform(-1.5, 0.5), 10 ** rng.uniform(-4, -2.5)
    damping = rng.choice([0.0, 10 ** rng.uniform(-1, 1.5)])
    coupling = operator = None
    if kind in ("tip", "motor", "all"):
        at_tip = kind == "tip" or (kind == "all" and rng.random() < 0.5)
        coupling = zwidth.Coupling(
            mass * 10 ** rng.uniform(-1, 0.5),
            mass / period**2 * 10 ** rng.uniform(-3, 0.5),
            mass / period * 10 ** rng.uniform(-3, -0.5),
            "tip" if at_tip else "motor",
        )
    hand = mass * 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(1, 3)
    if kind == "hand" or (kind == "all" and rng.random() < 0.5):
        operator = zwidth.Operator(*hand)
    elif kind in ("coupled hand", "all"):
        tie = {"coupling_stiffness": 10 ** rng.uniform(2, 4), "coupling_damping": 10 ** rng.uniform(-1, 1)}
        operator = zwidth.Operator(*hand, **tie)
    velocity = random_velocity(rng, period) if kind in ("filter", "all") else zwidth.BackwardDifference()
    delay = rng.choice([0, 1, 2, 0.3, 1.6, 3]) * period
    return zwidth.Scene(
        zwidth.Device(mass, damping, coupling), zwidth.Timing(period, delay), velocity=velocity, operator=operator
    )


def random_walls(scene, rng, count):
    """Return stiffness and virtual damping of random walls around the stable set."""
    units = scene.units
    K = 10 ** rng.uniform(-4, 0.5, count) * units.stiffness
    B = rng.uniform(-0.2, 1, count) * 10 ** rng.uniform(-1.5, 0, count) * units.virtual_damping
    return K, B
