"""Named tuples of results for any kind of device: stiffest stable wall, stability margins, and stability of walls."""

from __future__ import annotations

from typing import NamedTuple

from zwidth.core.status import Method, RidgeKind
from zwidth.core.types import Array
from zwidth.units.display import compact_repr


@compact_repr(omega="", kind=RidgeKind)
class RidgePoint(NamedTuple):
    """The stiffest stable wall of a device in normalized parameters; arrays for several devices."""

    alpha: Array  # normalized stiffness
    beta: Array  # normalized damping
    omega: Array  # frequency of the pole pair on the unit circle, in rad per period
    kind: Array  # kind of the optimum, a code of `RidgeKind`
    status: Array  # code of `Status`


@compact_repr(phase_margin="degrees", delay_margin="periods")
class Margins(NamedTuple):
    """Stability margins of a wall and the frequencies at which they occur, in rad per period.

    The comments give the names of python-control.
    """

    gain_margin: Array  # common factor of stiffness and damping at the limit of stability; gm in python-control
    phase_margin: Array  # in degrees; pm in python-control
    delay_margin: Array  # in periods
    modulus_margin: Array  # smallest distance of the open loop from -1; sm in python-control
    phase_crossover: Array  # frequency of the gain margin; wpc in python-control
    gain_crossover: Array  # frequency of the phase margin; wgc in python-control
    modulus_frequency: Array  # frequency of the modulus margin; wms in python-control


@compact_repr(angle="rad")
class DominantPole(NamedTuple):
    """Dominant pole (pole of largest magnitude) of the closed loop with a wall; arrays for several walls."""

    radius: Array  # magnitude of the pole, the spectral radius
    angle: Array  # angle of the pole in rad per period, from 0 to pi; 0 if the response does not oscillate
    decay_rate: Array  # -ln(radius) per period
    status: Array  # code of `Status`


@compact_repr(method=Method)
class Stability(NamedTuple):
    """Stability of walls, with the status and the deciding method of each wall; all arrays have the same shape."""

    stable: Array  # True if all poles are inside the unit circle
    status: Array  # code of `Status`
    method: Array  # code of `Method`
