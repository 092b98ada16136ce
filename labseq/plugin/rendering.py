"""Conversion of tones to the samples of an AWG."""

from __future__ import annotations

from labseq.motion.rendering import Renderer, comb_sample_rate, render, render_address, warm_rendering

__all__ = ["Renderer", "comb_sample_rate", "render", "render_address", "warm_rendering"]
