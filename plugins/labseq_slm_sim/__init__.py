"""A simulated SLM for ``labseq_slm``, from its grey levels to the light at the sites."""

from labseq_slm_sim.panel import SimulatedSlm

__all__ = ["SimulatedSlm"]
