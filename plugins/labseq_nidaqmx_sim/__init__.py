"""A simulator of NI-DAQmx for ``labseq_nidaqmx``, with cards behind the functions of its C library."""

from labseq_nidaqmx_sim.access import SimulatedLibrary

__all__ = ["SimulatedLibrary"]
