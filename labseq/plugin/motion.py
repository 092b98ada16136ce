"""From a plan to tones and to the samples of an AWG."""

from __future__ import annotations

from labseq.drivers.tweezers import check_tone_program
from labseq.model import FrequencyCourse, RfSpec, TonePaths
from labseq.motion import Renderer, comb_sample_rate, render, render_address, tone_program, warm_rendering
from labseq.motion.tones import site_time_s

__all__ = [
    "FrequencyCourse",
    "Renderer",
    "RfSpec",
    "TonePaths",
    "check_tone_program",
    "comb_sample_rate",
    "render",
    "render_address",
    "site_time_s",
    "tone_program",
    "warm_rendering",
]
