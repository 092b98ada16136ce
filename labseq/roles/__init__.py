"""The roles that plugins play, as Protocols, and what they are given to play them.

Roles are synchronous. A constructor does no I/O; ``open()`` does. Hardware roles
share ``open``, ``close``, ``safe_state`` (legal in any state, also before
``open``, and any number of times) and ``describe``. Optional capabilities are
small extra Protocols that the core looks for with ``isinstance``.

Failures: a device raises ``DeviceError`` (or ``DeviceTimeoutError``),
``LimitError`` before anything moves when it is asked for too much, and
``TransientError`` when a repetition of the shot may help.
"""

from labseq.roles.deciding import (
    Analysis,
    Detector,
    NeedsWarmUp,
    Planner,
    RecordedShot,
    ReportsSignals,
    Scanner,
)
from labseq.roles.hardware import (
    Camera,
    ChecksCommands,
    Device,
    Hardware,
    HasReadings,
    HasSelfTest,
    Interlocked,
    LeaderLink,
    Lines,
    MobileTweezers,
    NeedsSettling,
    ReportsCameraFacts,
    ReportsLinesFacts,
    ReportsTimings,
    StaticTweezers,
    Trigger,
)
from labseq.roles.shot import Clock, Context, NeverStopped, Repeatable, RunObserver, Shot, Step, StepContext
from labseq.roles.simulation import (
    WHOLE_SENSOR,
    ReceivesOutput,
    ReportsEvents,
    ReportsLoading,
    ReportsLosses,
    ReportsSensor,
    ReportsTruth,
    RfSource,
    Signal,
    Simulation,
    ToneSource,
    WiresTriggers,
)

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
