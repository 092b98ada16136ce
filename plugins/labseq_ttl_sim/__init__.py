"""Simulated boxes for ``labseq_ttl``: a model of the box, or its firmware on a simulated processor."""

from labseq_ttl_sim.access import SimulatedAccess

__all__ = ["SimulatedAccess"]
