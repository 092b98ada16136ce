"""The composition root: sequence + profile + plugins -> open devices -> sequencer -> recorder."""

from labseq.session.assembly import Assembly, assemble
from labseq.session.check import CheckReport, check
from labseq.session.occupancies import Source, read_source
from labseq.session.options import Options
from labseq.session.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.session.profile import ResolvedProfile, load_plugins, resolve_profile
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
    "ResolvedProfile",
    "CheckReport",
    "CheckedDevice",
    "DevicesReport",
    "Options",
    "PlanRequest",
    "PlannedMoves",
    "SafeStateReport",
    "Session",
    "Source",
    "assemble",
    "check",
    "check_devices",
    "gather_provenance",
    "load_plugins",
    "make_profile_safe",
    "plan_moves",
    "read_source",
    "resolve_profile",
]
