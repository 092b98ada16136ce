"""Fakes for tests, such as a clock, devices that record every call, and scripted planners and detectors."""

from labseq.testing.fakes.devices import (
    Call,
    Calls,
    Failure,
    FakeClock,
    Hang,
    RecordingCamera,
    RecordingDevice,
    RecordingLeader,
    RecordingLines,
    RecordingMobileTweezers,
    RecordingStaticTweezers,
)
from labseq.testing.fakes.lab import (
    FakeLab,
    ListSink,
    RecordingObserver,
    RecordingSimulation,
    ScriptedDetector,
    ScriptedPlanner,
    ScriptedScanner,
    fake_lab,
)
from labseq.testing.fakes.records import FakeShot, OneByOnePlanner, fake_calibration, fake_shot

__all__ = [
    "Call",
    "Calls",
    "Failure",
    "FakeClock",
    "FakeLab",
    "FakeShot",
    "Hang",
    "ListSink",
    "OneByOnePlanner",
    "RecordingCamera",
    "RecordingDevice",
    "RecordingLeader",
    "RecordingLines",
    "RecordingMobileTweezers",
    "RecordingObserver",
    "RecordingSimulation",
    "RecordingStaticTweezers",
    "ScriptedDetector",
    "ScriptedPlanner",
    "ScriptedScanner",
    "fake_calibration",
    "fake_lab",
    "fake_shot",
]
