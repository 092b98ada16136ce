"""What labseq itself offers, registered like any plugin's."""

from __future__ import annotations

from typing import Final

from labseq._markers import hookimpl
from labseq.hookspecs import LABSEQ_API as _API
from labseq.registry import Registry

LABSEQ_API: Final = _API


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the built-in steps, patterns, detectors and analyses."""
    from labseq.config.analyses import SurvivalSettings
    from labseq.config.detectors import ThresholdSettings, WeightedSettings
    from labseq.config.patterns import BitmapSettings, CompactSettings
    from labseq.config.steps import (
        CheckOverlaySettings,
        CheckSitesSettings,
        DeviceSettings,
        EqualiseSettings,
        ImageSettings,
        LoadSettings,
        ProbeSettings,
        RampSettings,
        RearrangeSettings,
        WaitSettings,
    )
    from labseq.geometry import bitmap, compact
    from labseq.imaging import ThresholdDetector, WeightedDetector
    from labseq.imaging.blind import BlindDetector
    from labseq.imaging.survival import SurvivalAnalysis
    from labseq.sequencer.equalise import EqualiseStep
    from labseq.sequencer.leading import wait_step
    from labseq.sequencer.probe import ProbeStep
    from labseq.sequencer.ramp import RampStep
    from labseq.sequencer.rearrange import RearrangeStep
    from labseq.sequencer.steps import DeviceStep, ImageStep, LoadStep
    from labseq.sequencer.watching import CheckOverlayStep, CheckSitesStep

    registry.step("load", LoadStep, LoadSettings)
    registry.step("image", ImageStep, ImageSettings)
    registry.step("rearrange", RearrangeStep, RearrangeSettings)
    registry.step("ramp", RampStep, RampSettings)
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
