"""Planners with one mobile tweezer, which the papers compare with: LSAP, compression, heuristic cluster."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners ``lsap``, ``lsap_squared``, ``compression`` and ``hca``."""
    registry.planner("lsap", "labseq_single.planner:LsapPlanner")
    registry.planner("lsap_squared", "labseq_single.planner:LsapSquaredPlanner")
    registry.planner("compression", "labseq_single.planner:CompressionPlanner")
    registry.planner("hca", "labseq_single.planner:HcaPlanner")
