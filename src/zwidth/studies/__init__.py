"""Kinds of studies: the model of the configuration of each kind, and its computation.

A new kind is a subclass of `ComputedStudy` with the decorator `register`. Other packages provide kinds by entry points
in the group ``zwidth.studies``.
"""

from zwidth.studies.document import Config, load_config, register
from zwidth.studies.outcome import ComputedStudy, Outcome

__all__ = ["ComputedStudy", "Config", "Outcome", "load_config", "register"]
