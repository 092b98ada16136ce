"""The steps, patterns, detectors and analyses of labseq itself, registered like those in plugins."""

from __future__ import annotations

from typing import Final

from labseq.hookspecs import LABSEQ_API as _API, hookimpl
from labseq.registry import Registry

LABSEQ_API: Final = _API


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the built-in steps, patterns, detectors and analyses."""
    steps, probes, patterns = "labseq.builtin.steps", "labseq.builtin.probes", "labseq.builtin.patterns"
    rearrange, equalise = "labseq.builtin.rearrange", "labseq.builtin.equalise"
    threshold, weighted = "labseq.detection.threshold", "labseq.detection.weighted"
    analyses = "labseq.builtin.analyses"
    registry.step("load", f"{steps}:LoadStep", f"{steps}:LoadSettings")
    registry.step("image", f"{steps}:ImageStep", f"{steps}:ImageSettings")
    registry.step("rearrange", f"{rearrange}:RearrangeStep", f"{rearrange}:RearrangeSettings")
    registry.step("ramp", f"{steps}:RampStep", f"{steps}:RampSettings")
    registry.step("release", f"{steps}:ReleaseStep", f"{steps}:ReleaseSettings")
    registry.step("pulse", "labseq.builtin.pulses:PulseStep", "labseq.builtin.pulses:PulseSettings")
    registry.step("probe", f"{probes}:ProbeStep", f"{probes}:ProbeSettings")
    registry.step("check_sites", f"{probes}:CheckSitesStep", f"{probes}:CheckSitesSettings")
    registry.step("check_overlay", f"{probes}:CheckOverlayStep", f"{probes}:CheckOverlaySettings")
    registry.step("equalise", f"{equalise}:EqualiseStep", f"{equalise}:EqualiseSettings")
    registry.step("wait", f"{steps}:wait_step", f"{steps}:WaitSettings")
    registry.step("device", f"{steps}:DeviceStep", f"{steps}:DeviceSettings")
    registry.pattern("compact", f"{patterns}:compact", f"{patterns}:CompactSettings")
    registry.pattern("bitmap", f"{patterns}:bitmap", f"{patterns}:BitmapSettings")
    registry.detector("threshold", f"{threshold}:ThresholdDetector", f"{threshold}:ThresholdSettings")
    registry.detector("weighted", f"{weighted}:WeightedDetector", f"{weighted}:WeightedSettings")
    registry.detector("blind", f"{threshold}:BlindDetector")
    registry.analysis("survival", f"{analyses}:SurvivalAnalysis", f"{analyses}:SurvivalSettings")
