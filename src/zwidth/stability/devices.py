"""What the array methods need of a device (delta, d), computed once a device and shared by all its walls."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zwidth import phi
from zwidth._types import Array
from zwidth.loop import tilt_at_minus_one, valid_device
from zwidth.plant import held_plant, split_delay


class Device(NamedTuple):
    """Delay, plant and phi-functions of one device; NaN throughout where delta or d is out of range."""

    delta: Array
    whole: Array
    f: Array
    c: Array
    em: Array
    p1: Array
    p2: Array
    psi: Array
    p1_t: Array  # phi1 and psi of delta (1 - f)
    psi_t: Array
    a2: Array
    a1: Array
    a0: Array
    tilt: Array  # P(-1) has the stable sign where tilt (alpha + 2 beta) < 1


def device(delta: Array, d: Array) -> Device:
    """The `Device` of one (delta, d), or of arrays of one shape."""
    ok = valid_device(delta, d)
    delta, d = jnp.where(ok, delta, 1.0), jnp.where(ok, d, 0.0)
    whole, f = split_delay(d)
    plant = held_plant(delta, f)
    late = delta * (1.0 - f)
    fields = Device(
        delta,
        whole,
        f,
        plant.c,
        plant.em,
        phi.phi1(delta),
        phi.phi2(delta),
        phi.psi(delta),
        phi.phi1(late),
        phi.psi(late),
        plant.a2,
        plant.a1,
        plant.a0,
        tilt_at_minus_one(plant, whole),
    )
    return Device(*(jnp.where(ok, field, jnp.nan) for field in fields))


@cache
def compiled_device() -> Any:
    """`device` as one array, the fields along a new first axis; compiled once for every method and degree."""
    return jax.jit(lambda delta, d: jnp.stack(device(delta, d)))
