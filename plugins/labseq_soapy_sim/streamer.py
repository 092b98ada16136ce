"""The streaming process of a simulated radio (``python -m labseq_soapy_sim.streamer``)."""

from __future__ import annotations

from labseq_soapy_stream.streamer import run

from labseq_soapy_sim.device import SimulatedDevice

if __name__ == "__main__":
    run(SimulatedDevice)
