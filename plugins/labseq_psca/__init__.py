"""The parallel sort-and-compression algorithm of Tian et al., for any target on any grid."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planner ``psca``."""
    registry.planner("psca", "labseq_psca.planner:PscaPlanner", "labseq_psca.planner:PscaSettings")
