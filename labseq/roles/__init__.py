"""The roles that plugins implement, and the objects that labseq passes to them.

Roles are synchronous. A constructor does no I/O; ``open()`` does. Hardware roles
share ``open``, ``close``, ``safe_state`` (legal in any state, also before
``open``, and any number of times) and ``describe``. Optional abilities are methods
with a default on the role's base class. The few Protocols that remain
(``LeaderLink``, ``NeedsWarmUp``, ``ReportsSignals``, ``ReceivesOutput``)
change what the core does where a plugin has them.

Failures: a device raises ``DeviceError`` (or ``DeviceTimeoutError``),
``LimitError`` before anything moves when the request is out of range, and
``TransientError`` when repeating the shot may help.
"""

from labseq.roles.deciding import (
    Analysis,
    Detection,
    Detector,
    NeedsWarmUp,
    Planner,
    RecordedShot,
    ReportsSignals,
    Scanner,
)
from labseq.roles.hardware import (
    Camera,
    Device,
    Emergency,
    Hardware,
    LeaderLink,
    Lines,
    MobileTweezers,
    StaticTweezers,
    Trigger,
    find_leader,
    leaders,
    offers,
    unknown_name,
)
from labseq.roles.shot import EVENTS, Clock, Context, NeverStopped, RunObserver, Shot, Step, StepContext
from labseq.roles.simulation import (
    WHOLE_SENSOR,
    ReceivesOutput,
    RfSource,
    Signal,
    Simulation,
    ToneSource,
)

__all__ = [
    "EVENTS",
    "WHOLE_SENSOR",
    "Analysis",
    "Camera",
    "Clock",
    "Context",
    "Detection",
    "Detector",
    "Device",
    "Emergency",
    "Hardware",
    "LeaderLink",
    "Lines",
    "MobileTweezers",
    "NeedsWarmUp",
    "NeverStopped",
    "Planner",
    "ReceivesOutput",
    "RecordedShot",
    "ReportsSignals",
    "RfSource",
    "RunObserver",
    "Scanner",
    "Shot",
    "Signal",
    "Simulation",
    "StaticTweezers",
    "Step",
    "StepContext",
    "ToneSource",
    "Trigger",
    "find_leader",
    "leaders",
    "offers",
    "unknown_name",
]
