"""A scanner that climbs, as a short example to start your own scanner from."""

from __future__ import annotations

from labseq.plugin import Registry, hookimpl
from labseq_climb.scanner import Climb, ClimbSettings

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the scanner ``climb``."""
    registry.scanner("climb", Climb, ClimbSettings)
