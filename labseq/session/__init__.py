"""Builds a run from a sequence, a profile and plugins; opens the devices, takes the shots and records them.

``labseq check`` is in ``check``; planning without a run in ``planning``, with its ``occupancies``.
"""

from labseq.session.assembly import Assembly, assemble
from labseq.session.chosen import load_plugins
from labseq.session.options import Options
from labseq.session.profile import ResolvedProfile, resolve_profile
from labseq.session.provenance import gather_provenance
from labseq.session.safe import (
    CheckedDevice,
    DevicesReport,
    SafeStateReport,
    check_devices,
    make_profile_safe,
)
from labseq.session.session import Session

__all__ = [
    "Assembly",
    "CheckedDevice",
    "DevicesReport",
    "Options",
    "ResolvedProfile",
    "SafeStateReport",
    "Session",
    "assemble",
    "check_devices",
    "gather_provenance",
    "load_plugins",
    "make_profile_safe",
    "resolve_profile",
]
