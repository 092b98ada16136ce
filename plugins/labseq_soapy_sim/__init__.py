"""A simulated radio for ``labseq_soapy``, in place of the library SoapySDR; it keeps the samples it receives.

    with installed(SimulatedLibrary(clock)):
        radio = open_radio(setup)

Where a profile says ``device: simulated`` the streaming process does so; then another process reads the
samples in the radio's :class:`Ring`. The README says what the simulator does and does not model. What labseq
itself needs of it is in ``labseq_soapy_sim.radio``: the streaming process imports nothing of labseq.
"""

from labseq_soapy_sim.library import SimulatedLibrary, install, installed
from labseq_soapy_sim.ring import Fault, Ring, read_trace

__all__ = ["Fault", "Ring", "SimulatedLibrary", "install", "installed", "read_trace"]
