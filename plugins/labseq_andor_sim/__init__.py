"""A simulator of Andor's SDK2 for ``labseq_andor``: an EMCCD camera below the real pylablib."""

from labseq_andor_sim.camera import Faults, SimulatedCamera
from labseq_andor_sim.library import SimulatedAndorLibrary, SimulatedSdk

__all__ = ["Faults", "SimulatedAndorLibrary", "SimulatedCamera", "SimulatedSdk"]
