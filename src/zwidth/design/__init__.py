"""Design questions, answered through the exact model: how stiff, at what price, how well damped, how robust."""

from zwidth.design.area import stable_area as stable_area
from zwidth.design.damping import DampingChoice as DampingChoice
from zwidth.design.damping import FastestWall as FastestWall
from zwidth.design.damping import fastest_damping as fastest_damping
from zwidth.design.damping import fastest_wall as fastest_wall
from zwidth.design.damping import most_robust_damping as most_robust_damping
from zwidth.design.margin import modulus_margin as modulus_margin
from zwidth.design.passive import passive_area as passive_area
from zwidth.design.requirements import Requirement as Requirement
from zwidth.design.requirements import allowed_delay as allowed_delay
from zwidth.design.requirements import required_damping as required_damping
from zwidth.design.requirements import required_mass as required_mass
from zwidth.design.requirements import required_period as required_period
from zwidth.design.robust import Interval as Interval
from zwidth.design.robust import RobustStiffness as RobustStiffness
from zwidth.design.robust import RobustWall as RobustWall
from zwidth.design.robust import robust_max_stiffness as robust_max_stiffness
from zwidth.design.robust import robust_wall as robust_wall
from zwidth.design.stiffness import Sensitivities as Sensitivities
from zwidth.design.stiffness import max_stiffness as max_stiffness
from zwidth.design.stiffness import sensitivities as sensitivities
from zwidth.design.stiffness import sensitivity_lines as sensitivity_lines
