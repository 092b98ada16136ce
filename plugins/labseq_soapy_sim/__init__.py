"""A simulated radio for ``labseq_soapy``, in place of one behind SoapySDR; it keeps the samples it receives.

Where a profile says ``device: simulated`` the streaming process opens a :class:`SimulatedDevice`; another
process reads the samples in the radio's :class:`Ring`. The README says what the simulator does and does not
model. What labseq itself needs of it is in ``labseq_soapy_sim.radio``: the streaming process imports nothing
of labseq.
"""

from labseq_soapy_sim.device import SimulatedDevice
from labseq_soapy_sim.ring import Fault, Ring, read_trace

__all__ = ["Fault", "Ring", "SimulatedDevice", "read_trace"]
