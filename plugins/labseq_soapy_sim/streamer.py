"""The streaming process of a simulated radio: ``python -m labseq_soapy_sim.streamer``.

It is the real one, with a simulated library in place of SoapySDR.
"""

from __future__ import annotations

from labseq_soapy_stream.streamer import run

from labseq_soapy_sim.library import SimulatedLibrary, install

if __name__ == "__main__":
    install(SimulatedLibrary())
    run()
