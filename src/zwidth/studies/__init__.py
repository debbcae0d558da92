"""Kinds of studies: what the configuration of each says, and how it is computed.

A new kind is a subclass of `ComputedStudy` given to `register`; the command line finds those that an installed package
names in the entry points ``zwidth.studies``.
"""

from zwidth.studies.document import Config, load_config, register
from zwidth.studies.outcome import ComputedStudy, Outcome

__all__ = ["ComputedStudy", "Config", "Outcome", "load_config", "register"]
