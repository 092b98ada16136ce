"""Stand-ins for tests: a clock, devices that note every call, deciders that follow a script."""

from labseq.testing.fakes.calibrations import fake_calibration
from labseq.testing.fakes.calls import Call, Calls, Failure, Hang
from labseq.testing.fakes.clock import FakeClock
from labseq.testing.fakes.deciders import (
    FixedDetector,
    RecordingSimulation,
    ScriptedDetector,
    ScriptedPlanner,
    ScriptedScanner,
)
from labseq.testing.fakes.devices import (
    RecordingCamera,
    RecordingDevice,
    RecordingLines,
    RecordingMobileTweezers,
    RecordingStaticTweezers,
)
from labseq.testing.fakes.lab import FakeLab, ListSink, RecordingObserver, fake_lab
from labseq.testing.fakes.leader import RecordingLeader
from labseq.testing.fakes.shots import FakeShot, fake_shot
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
