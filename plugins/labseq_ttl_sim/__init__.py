"""A simulated box for ``labseq_ttl``."""

from labseq_ttl_sim.access import SimulatedAccess

__all__ = ["SimulatedAccess"]
