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
from labseq.roles.deciding import Detector, Planner, SignalTeller, Warmable
from labseq.roles.hardware import (
    Camera,
    Device,
    Hardware,
    KnownCamera,
    Lines,
    MobileTweezers,
    SelfTesting,
    StaticTweezers,
    Trigger,
)
from labseq.roles.shot import Context, RunObserver, Shot, Step, StepContext
from labseq.roles.simulation import (
    KnownLoading,
    Listening,
    LossTeller,
    RfSource,
    Simulation,
    Storyteller,
    TruthTeller,
)

__all__ = [
    "Camera",
    "Clock",
    "Context",
    "Detector",
    "Device",
    "Hardware",
    "KnownCamera",
    "KnownLoading",
    "Lines",
    "Listening",
    "LossTeller",
    "MobileTweezers",
    "NeverStopped",
    "Planner",
    "RfSource",
    "RunObserver",
    "SelfTesting",
    "Shot",
    "SignalTeller",
    "Simulation",
    "StaticTweezers",
    "Step",
    "StepContext",
    "Storyteller",
    "Trigger",
    "TruthTeller",
    "Warmable",
]
