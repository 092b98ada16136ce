"""A simulator of Andor's SDK2 for ``labseq_andor``, with an EMCCD camera behind its functions."""

from labseq_andor_sim.camera import Faults, SimulatedCamera
from labseq_andor_sim.connection import SimulatedConnection

__all__ = ["Faults", "SimulatedCamera", "SimulatedConnection"]
