"""What every loop answers of its walls: stiffest wall, margins and labels, arrays of one shape."""

from __future__ import annotations

from typing import NamedTuple

from zwidth.words.showing import shown
from zwidth.words.status import Method, RidgeKind
from zwidth.words.types import Array


@shown(omega="", kind=RidgeKind)
class RidgePoint(NamedTuple):
    """The stiffest stable wall of a device, or an array of them."""

    alpha: Array
    beta: Array
    omega: Array
    kind: Array
    status: Array


@shown(phase_margin="degrees", delay_margin="periods")
class Margins(NamedTuple):
    """Margins of a wall and where they are taken, in radians a period; python-control's names in brackets."""

    gain_margin: Array  # (gm)
    phase_margin: Array  # degrees (pm)
    delay_margin: Array  # periods
    modulus_margin: Array  # (sm)
    phase_crossover: Array  # (wpc)
    gain_crossover: Array  # (wgc)
    modulus_frequency: Array  # (wms)


@shown(method=Method)
class Stability(NamedTuple):
    """Labels with their status and the `Method` that decided each point, all of the broadcast shape."""

    stable: Array
    status: Array
    method: Array
