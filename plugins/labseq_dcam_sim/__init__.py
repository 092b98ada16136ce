"""A simulator of Hamamatsu's DCAM-API for ``labseq_pylablib``, a qCMOS camera behind its C functions."""

from labseq_dcam_sim.camera import Faults, SimulatedCamera
from labseq_dcam_sim.connection import SimulatedConnection
from labseq_dcam_sim.library import SimulatedLibrary

__all__ = ["Faults", "SimulatedCamera", "SimulatedConnection", "SimulatedLibrary"]
