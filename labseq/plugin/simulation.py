"""Data that simulated devices pass to a simulation that acts on their outputs."""

from __future__ import annotations

from labseq.model import RfSamples, RfSpan, RfTones
from labseq.roles import WHOLE_SENSOR, ReceivesOutput, RfSource, ToneSource

__all__ = [
    "WHOLE_SENSOR",
    "ReceivesOutput",
    "RfSamples",
    "RfSource",
    "RfSpan",
    "RfTones",
    "ToneSource",
]
