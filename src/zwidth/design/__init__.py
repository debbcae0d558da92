"""Design questions, answered through the exact model: how stiff, at what price, how well damped, how robust."""

from zwidth.design.requirements import Requirement as Requirement
from zwidth.design.requirements import allowed_delay as allowed_delay
from zwidth.design.requirements import required_damping as required_damping
from zwidth.design.requirements import required_mass as required_mass
from zwidth.design.requirements import required_period as required_period
from zwidth.design.stiffness import Sensitivities as Sensitivities
from zwidth.design.stiffness import max_stiffness as max_stiffness
from zwidth.design.stiffness import sensitivities as sensitivities
from zwidth.design.stiffness import sensitivity_lines as sensitivity_lines
