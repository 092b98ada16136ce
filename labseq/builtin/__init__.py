"""The steps, patterns, detectors and analyses that labseq itself offers, registered like any plugin's."""

from __future__ import annotations

from typing import Final

from labseq.hookspecs import LABSEQ_API as _API, hookimpl
from labseq.registry import Registry

LABSEQ_API: Final = _API


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the built-in steps, patterns, detectors and analyses."""
    from labseq.builtin.analyses import SurvivalAnalysis, SurvivalSettings
    from labseq.builtin.equalise import EqualiseSettings, EqualiseStep
    from labseq.builtin.patterns import BitmapSettings, CompactSettings, bitmap, compact
    from labseq.builtin.probes import (
        CheckOverlaySettings,
        CheckOverlayStep,
        CheckSitesSettings,
        CheckSitesStep,
        ProbeSettings,
        ProbeStep,
    )
    from labseq.builtin.rearrange import RearrangeSettings, RearrangeStep
    from labseq.builtin.steps import (
        DeviceSettings,
        DeviceStep,
        ImageSettings,
        ImageStep,
        LoadSettings,
        LoadStep,
        RampSettings,
        RampStep,
        ReleaseSettings,
        ReleaseStep,
        WaitSettings,
        wait_step,
    )
    from labseq.detection.threshold import BlindDetector, ThresholdDetector, ThresholdSettings
    from labseq.detection.weighted import WeightedDetector, WeightedSettings

    registry.step("load", LoadStep, LoadSettings)
    registry.step("image", ImageStep, ImageSettings)
    registry.step("rearrange", RearrangeStep, RearrangeSettings)
    registry.step("ramp", RampStep, RampSettings)
    registry.step("release", ReleaseStep, ReleaseSettings)
    registry.step("probe", ProbeStep, ProbeSettings)
    registry.step("check_sites", CheckSitesStep, CheckSitesSettings)
    registry.step("check_overlay", CheckOverlayStep, CheckOverlaySettings)
    registry.step("equalise", EqualiseStep, EqualiseSettings)
    registry.step("wait", wait_step, WaitSettings)
    registry.step("device", DeviceStep, DeviceSettings)
    registry.pattern("compact", compact, CompactSettings)
    registry.pattern("bitmap", bitmap, BitmapSettings)
    registry.detector("threshold", ThresholdDetector, ThresholdSettings)
    registry.detector("weighted", WeightedDetector, WeightedSettings)
    registry.detector("blind", BlindDetector)
    registry.analysis("survival", SurvivalAnalysis, SurvivalSettings)
