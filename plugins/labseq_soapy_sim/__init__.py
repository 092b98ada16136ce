"""A simulated radio for ``labseq_soapy``: a SoapySDR module that keeps the samples it receives."""

from labseq_soapy_sim.build import build_module, can_build
from labseq_soapy_sim.radio import SimulatedRadio, read_arguments
from labseq_soapy_sim.ring import Fault, Ring, read_trace

__all__ = ["Fault", "Ring", "SimulatedRadio", "build_module", "can_build", "read_arguments", "read_trace"]
