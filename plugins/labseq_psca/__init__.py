"""The parallel sort-and-compression algorithm of Tian et al., for any target on any grid."""

from __future__ import annotations

from labseq.plugin import Registry, hookimpl
from labseq_psca.planner import PscaPlanner, PscaSettings

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planner ``psca``."""
    registry.planner("psca", PscaPlanner, PscaSettings)
