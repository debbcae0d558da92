"""Public names of `zwidth.plotting`, and the modules that define them."""

from . import plot as plot
from .admittance import draw_environment_limits as draw_environment_limits
from .curves import draw_curves as draw_curves
from .curves import draw_outlines as draw_outlines
from .design import draw_filter_noise as draw_filter_noise
from .design import draw_filters as draw_filters
from .design import draw_requirement as draw_requirement
from .limit_cycle import draw_limit_cycle_curves as draw_limit_cycle_curves
from .limit_cycle import draw_limit_cycles as draw_limit_cycles
from .measured import draw_device_fit as draw_device_fit
from .measured import draw_response as draw_response
from .motion import draw_energy as draw_energy
from .motion import draw_motion as draw_motion
from .motion import draw_phase_plane as draw_phase_plane
from .motion import draw_step as draw_step
from .paper import draw_boundary as draw_boundary
from .paper import draw_map as draw_map
from .paper import draw_passivity_cost as draw_passivity_cost
from .paper import draw_ridge as draw_ridge
from .paper import draw_slope as draw_slope
from .paper import draw_zero_stiffness as draw_zero_stiffness
from .plane import draw_plane as draw_plane
from .plane import draw_workspace as draw_workspace
from .stable_set import draw_stable_set as draw_stable_set
from .style import house_style as house_style
from .style import save as save
