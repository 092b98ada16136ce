"""The roles that plugins implement, and the objects that labseq passes to them.

Roles are synchronous. Only ``open()`` does I/O, not a constructor. Hardware roles share ``open``, ``close``,
``safe_state`` (legal in any state, also before ``open``, and any number of times) and ``describe``. Optional
abilities are methods of the role's base class that do nothing by default, so the core calls them without
asking. The few Protocols that remain (``ChoosesPlanner``, ``LeaderLink``, ``NeedsWarmUp``,
``ReportsSignals``, ``ReceivesOutput``) change the core's behaviour for plugins that implement them.
:data:`ROLES` lists the roles. Each object from a factory is checked against it once.

If a device fails, it raises ``DeviceError`` (or ``DeviceTimeoutError``). It raises ``LimitError`` before
anything moves if the request is out of range, and ``TransientError`` if repeating the shot may help.
"""

from labseq.roles.deciding import (
    Analysis,
    ChoosesPlanner,
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
    LeaderDialogue,
    LeaderLink,
    Lines,
    LineTrigger,
    MobileTweezers,
    StaticTweezers,
    Trigger,
    find_leader,
    leaders,
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
    loading_of,
)
from labseq.roles.table import ROLES, in_opening_order, in_safe_order, overrides

__all__ = [
    "EVENTS",
    "ROLES",
    "WHOLE_SENSOR",
    "Analysis",
    "Camera",
    "ChoosesPlanner",
    "Clock",
    "Context",
    "Detection",
    "Detector",
    "Device",
    "Emergency",
    "Hardware",
    "LeaderDialogue",
    "LeaderLink",
    "LineTrigger",
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
    "in_opening_order",
    "in_safe_order",
    "leaders",
    "loading_of",
    "overrides",
    "unknown_name",
]
