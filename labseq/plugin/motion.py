"""Conversion of a plan to tones."""

from __future__ import annotations

from labseq.model import FrequencyCourse, RfSpec, TonePaths
from labseq.motion import tone_program
from labseq.motion.tones import site_time_s
from labseq.plugin.tweezers import check_tone_program

__all__ = ["FrequencyCourse", "RfSpec", "TonePaths", "check_tone_program", "site_time_s", "tone_program"]
