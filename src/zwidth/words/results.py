"""Result types of all kinds of loops: stiffest wall, stability margins, and stability labels of walls."""

from __future__ import annotations

from typing import NamedTuple

from zwidth.words.showing import compact_repr
from zwidth.words.status import Method, RidgeKind
from zwidth.words.types import Array


@compact_repr(omega="", kind=RidgeKind)
class RidgePoint(NamedTuple):
    """The stiffest stable wall of a device in normalized parameters; arrays for several devices."""

    alpha: Array  # normalized stiffness
    beta: Array  # normalized damping
    omega: Array  # frequency of the pole pair on the unit circle, in rad per period
    kind: Array  # `RidgeKind`
    status: Array  # `Status`


@compact_repr(phase_margin="degrees", delay_margin="periods")
class Margins(NamedTuple):
    """Stability margins of a wall and the frequencies at which they occur, in rad per period.

    The comments give the names of python-control.
    """

    gain_margin: Array  # gm
    phase_margin: Array  # in degrees; pm
    delay_margin: Array  # in periods
    modulus_margin: Array  # smallest distance of the open loop from -1; sm
    phase_crossover: Array  # wpc
    gain_crossover: Array  # wgc
    modulus_frequency: Array  # wms


@compact_repr(method=Method)
class Stability(NamedTuple):
    """Stability labels of walls, with the status and the deciding method of each wall; arrays of one shape."""

    stable: Array  # True if all poles are inside the unit circle
    status: Array  # `Status`
    method: Array  # `Method`
