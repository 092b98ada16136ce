"""A simulated radio for ``labseq_soapy``, which replaces SoapySDR and keeps the samples it receives.

Where a profile says ``device: simulated`` the streaming process opens a :class:`SimulatedDevice`. Another
    process reads the samples in the radio's :class:`Ring`. The README says what the simulator does and does
    not model. labseq itself uses ``labseq_soapy_sim.radio``, since the streaming process imports nothing of
    labseq.
"""

from labseq_soapy_sim.device import SimulatedDevice
from labseq_soapy_sim.ring import Fault, Ring, read_trace

__all__ = ["Fault", "Ring", "SimulatedDevice", "read_trace"]
