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
from labseq.roles.deciding import Analysis, Detector, Planner, RecordedShot, Scanner, SignalTeller, Warmable
from labseq.roles.hardware import (
    Camera,
    Device,
    Hardware,
    Interlocked,
    KnownCamera,
    KnownCommands,
    KnownLines,
    Leading,
    Lines,
    MobileTweezers,
    Polled,
    SelfTesting,
    Settling,
    StaticTweezers,
    Timed,
    Trigger,
)
from labseq.roles.shot import Context, Shot
from labseq.roles.simulation import (
    WHOLE_SENSOR,
    KnownLoading,
    KnownSensor,
    Listening,
    LossTeller,
    RfSource,
    Signal,
    Simulation,
    Storyteller,
    ToneSource,
    TruthTeller,
    Wired,
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
    "KnownCamera",
    "KnownCommands",
    "KnownLines",
    "KnownLoading",
    "KnownSensor",
    "Leading",
    "Lines",
    "Listening",
    "LossTeller",
    "MobileTweezers",
    "NeverStopped",
    "Planner",
    "Polled",
    "RecordedShot",
    "Repeatable",
    "RfSource",
    "RunObserver",
    "Scanner",
    "SelfTesting",
    "Settling",
    "Shot",
    "Signal",
    "SignalTeller",
    "Simulation",
    "StaticTweezers",
    "Step",
    "StepContext",
    "Storyteller",
    "Timed",
    "ToneSource",
    "Trigger",
    "TruthTeller",
    "Warmable",
    "Wired",
]
