"""labseq: lab control for neutral-atom tweezer arrays.

The flat public namespace for users and plugin writers. Names are resolved when
they are first used, so that importing labseq costs next to nothing.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

_HOMES: Final = {
    "labseq.hookspecs": ("LABSEQ_API", "hookimpl"),
    "labseq.api": ("make_planner", "make_target", "tone_program"),
    "labseq.settings": (
        "Angle",
        "Duration",
        "FilePath",
        "Fraction",
        "Frequency",
        "Length",
        "Power",
        "Settings",
        "Speed",
        "Temperature",
        "Voltage",
    ),
    "labseq.drivers.settings": ("CameraSettings", "CoolingSettings"),
    "labseq.drivers": (
        "CameraDriver",
        "Cooling",
        "Series",
        "SimulatedSensor",
        "ExposureResult",
        "settle",
        "wait_for",
    ),
    "labseq.errors": (
        "ConfigError",
        "DeviceError",
        "DeviceTimeoutError",
        "InvalidPlanError",
        "LabseqError",
        "LimitError",
        "PlanError",
        "PluginLoadError",
        "RecordingError",
        "StopRequested",
        "TransientError",
        "UnknownPluginError",
    ),
    "labseq.model": (
        "Batch",
        "CalibrationEntry",
        "CameraFacts",
        "DepthRamp",
        "Frame",
        "LineProgram",
        "LineSpec",
        "LinesFacts",
        "MotionSpec",
        "Occupancy",
        "Plan",
        "PlanReport",
        "RandomStream",
        "RfSamples",
        "RfSpan",
        "RfSpec",
        "RfTones",
        "RunRecord",
        "ScanRange",
        "ScanSpace",
        "SensorMode",
        "ShotRecord",
        "SiteGrid",
        "TargetPattern",
        "TimelineEntry",
        "ToneProgram",
        "TweezerAmplitudes",
        "VisitedPoint",
        "Waveform",
        "as_occupancy",
    ),
    "labseq.motion": ("check_plan", "render"),
    "labseq.recording": ("Run", "open_run"),
    "labseq.registry": ("Registry",),
    "labseq.roles": (
        "Analysis",
        "Camera",
        "Clock",
        "Context",
        "Detector",
        "Device",
        "LeaderLink",
        "Lines",
        "ReceivesOutput",
        "MobileTweezers",
        "Planner",
        "RecordedShot",
        "RfSource",
        "Scanner",
        "Shot",
        "ReportsSignals",
        "Simulation",
        "StaticTweezers",
        "Step",
        "StepContext",
        "ToneSource",
        "Trigger",
        "NeedsWarmUp",
    ),
    "labseq.session": ("Session",),
}
_HOME_OF: Final = {name: home for home, names in _HOMES.items() for name in names}

__version__: Final = "0.2.0"


def __getattr__(name: str) -> Any:
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'labseq' has no attribute '{name}'")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
