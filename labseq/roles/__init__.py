"""The roles that plugins play, as Protocols, and what they are given to play them.

Roles are synchronous. A constructor does no I/O; ``open()`` does. Hardware roles
share ``open``, ``close``, ``safe_state`` (legal in any state, also before
``open``, and any number of times) and ``describe``. Optional capabilities are
small extra Protocols that the core looks for with ``isinstance``.

Failures: a device raises ``DeviceError`` (or ``DeviceTimeoutError``),
``LimitError`` before anything moves when it is asked for too much, and
``TransientError`` when a repetition of the shot may help.
"""

from labseq.roles.clock import Clock, NeverStopped
from labseq.roles.deciding import Analysis, Detector, Planner, RecordedShot, Scanner, ReportsSignals, NeedsWarmUp
from labseq.roles.hardware import (
    Camera,
    Device,
    Hardware,
    Interlocked,
    ReportsCameraFacts,
    ChecksCommands,
    ReportsLinesFacts,
    LeaderLink,
    Lines,
    MobileTweezers,
    HasReadings,
    HasSelfTest,
    NeedsSettling,
    StaticTweezers,
    ReportsTimings,
    Trigger,
)
from labseq.roles.shot import Context, Shot
from labseq.roles.simulation import (
    WHOLE_SENSOR,
    ReportsLoading,
    ReportsSensor,
    ReceivesOutput,
    ReportsLosses,
    RfSource,
    Signal,
    Simulation,
    ReportsEvents,
    ToneSource,
    ReportsTruth,
    WiresTriggers,
)
from labseq.roles.step import Repeatable, RunObserver, Step, StepContext

__all__ = [
    "WHOLE_SENSOR",
    "Analysis",
    "Camera",
    "Clock",
    "Context",
    "Detector",
    "Device",
    "Hardware",
    "Interlocked",
    "ReportsCameraFacts",
    "ChecksCommands",
    "ReportsLinesFacts",
    "ReportsLoading",
    "ReportsSensor",
    "LeaderLink",
    "Lines",
    "ReceivesOutput",
    "ReportsLosses",
    "MobileTweezers",
    "NeverStopped",
    "Planner",
    "HasReadings",
    "RecordedShot",
    "Repeatable",
    "RfSource",
    "RunObserver",
    "Scanner",
    "HasSelfTest",
    "NeedsSettling",
    "Shot",
    "Signal",
    "ReportsSignals",
    "Simulation",
    "StaticTweezers",
    "Step",
    "StepContext",
    "ReportsEvents",
    "ReportsTimings",
    "ToneSource",
    "Trigger",
    "ReportsTruth",
    "NeedsWarmUp",
    "WiresTriggers",
]
