"""The composition root: sequence + profile + plugins -> open devices -> sequencer -> recorder."""

from labseq.session.assembly import Assembly, assemble
from labseq.session.checking import CheckReport, check
from labseq.session.choosing import ResolvedProfile
from labseq.session.devices import CheckedDevice, DevicesReport, check_devices
from labseq.session.occupancies import Source, read_source
from labseq.session.options import Options
from labseq.session.plan_inputs import PlanRequest
from labseq.session.planning import PlannedMoves, plan_moves
from labseq.session.provenance import gather_provenance
from labseq.session.safe import SafeStateReport, make_profile_safe
from labseq.session.session import Session
from labseq.session.setting_up import load_plugins, resolve_profile

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
