"""Planners with one mobile tweezer, which the papers compare with: LSAP, compression, heuristic cluster."""

from __future__ import annotations

from labseq.plugin import Registry, hookimpl
from labseq_single.planner import CompressionPlanner, HcaPlanner, LsapPlanner, LsapSquaredPlanner

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners ``lsap``, ``lsap_squared``, ``compression`` and ``hca``."""
    for planner in (LsapPlanner, LsapSquaredPlanner, CompressionPlanner, HcaPlanner):
        registry.planner(planner.name, planner)
