"""Stand-ins for tests: a clock, devices that note every call, deciders that follow a script."""

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
    FixedDetector,
    ListSink,
    RecordingObserver,
    RecordingSimulation,
    ScriptedDetector,
    ScriptedPlanner,
    ScriptedScanner,
    fake_lab,
)
from labseq.testing.fakes.records import FakeShot, fake_calibration, fake_shot
from labseq.testing.planner import OneByOnePlanner

__all__ = [
    "Call",
    "Calls",
    "Failure",
    "FakeClock",
    "FakeLab",
    "FakeShot",
    "FixedDetector",
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
