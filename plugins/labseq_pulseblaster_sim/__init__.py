"""A simulator of SpinAPI for ``labseq_pulseblaster``, a board behind the functions of the C library."""

from labseq_pulseblaster_sim.access import SimulatedLibrary

__all__ = ["SimulatedLibrary"]
