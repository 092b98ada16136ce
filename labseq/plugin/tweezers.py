"""Checks and amplitudes that drivers of static tweezers share."""

from __future__ import annotations

from labseq.drivers.tweezers import Amplitudes, calibrated_amplitudes, check_amplitudes, check_ramp

__all__ = [
    "Amplitudes",
    "calibrated_amplitudes",
    "check_amplitudes",
    "check_ramp",
]
