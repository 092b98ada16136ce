"""What plugins import from labseq: the roles, the types of their methods, settings, errors and kernels.

What only some plugins need is in modules by subject:

- ``camera``: base class of camera drivers, their settings, cooling, a simulated sensor
- ``camera_simulator``, ``sdk_camera``: what simulators of cameras, and drivers on a vendor's library, share
- ``first_contact``: steps that prove what a driver assumes, and the file of what they measured
- ``geometry``: sites of a grid: blocks, patterns, their order from the centre
- ``leader``: settings, log and simulation of another control system that starts the shots
- ``lines``: programs of a timing box, and the line that triggers a device
- ``messages``: wording of error messages
- ``motion``: from a plan to tones, and to the samples of an AWG
- ``native``: calls of C from compiled code; clocks, signals and priority of threads without Python
- ``planning``: checking, comparing and following plans
- ``runs``: reading recorded runs
- ``serial``: serial ports, and devices that are switched off over one
- ``simulation``: what simulated devices pass to a simulation that acts on their outputs
- ``system``: folders for files that outlive a run, other processes, a clock outside of a run
- ``tweezers``: checks and amplitudes that drivers of static tweezers share
- ``units``, ``wire``: quantities as text; messages between computers

A plugin needs no other module of labseq, except :mod:`labseq.testing` in its tests.
"""

from __future__ import annotations

from labseq.drivers.waiting import wait_for
from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceTimeoutError,
    LabseqError,
    LimitError,
    PlanError,
    Problem,
    ShotAbortedError,
    StopRequested,
    TransientError,
)
from labseq.hookspecs import hookimpl
from labseq.kernels.kernel import const, helper_kernel, kernel
from labseq.model import (
    COMPUTER,
    AxisTones,
    Batch,
    CalibrationEntry,
    CameraFacts,
    CycleRecord,
    DepthRamp,
    Frame,
    FrequencyComb,
    ImageRecord,
    LineProgram,
    LinesFacts,
    LineSpec,
    MotionSpec,
    Occupancy,
    Plan,
    RandomStream,
    RunRecord,
    ScanRange,
    ScanSpace,
    SensorMode,
    ShotRecord,
    SiteGrid,
    TargetPattern,
    TimedBy,
    TimelineEntry,
    ToneProgram,
    TweezerAmplitudes,
    TweezersFacts,
    VisitedPoint,
    as_occupancy,
)
from labseq.registry import Registry
from labseq.roles import (
    Analysis,
    Camera,
    ChoosesPlanner,
    Clock,
    Context,
    Detector,
    Device,
    Emergency,
    Hardware,
    LeaderDialogue,
    LeaderLink,
    Lines,
    MobileTweezers,
    NeedsWarmUp,
    Planner,
    RecordedShot,
    ReportsSignals,
    Scanner,
    Shot,
    Signal,
    Simulation,
    StaticTweezers,
    Step,
    StepContext,
    Trigger,
)
from labseq.settings import (
    Angle,
    Duration,
    FilePath,
    Fraction,
    Frequency,
    Length,
    PositiveDuration,
    Power,
    Settings,
    Speed,
    Temperature,
    Text,
    Voltage,
    empty_is,
    setting_error,
)
from labseq.units import format_quantity

__all__ = [
    "COMPUTER",
    "Analysis",
    "Angle",
    "AxisTones",
    "Batch",
    "CalibrationEntry",
    "Camera",
    "CameraFacts",
    "ChoosesPlanner",
    "Clock",
    "ConfigError",
    "Context",
    "CycleRecord",
    "DepthRamp",
    "Detector",
    "Device",
    "DeviceError",
    "DeviceTimeoutError",
    "Duration",
    "Emergency",
    "FilePath",
    "Fraction",
    "Frame",
    "Frequency",
    "FrequencyComb",
    "Hardware",
    "ImageRecord",
    "LabseqError",
    "LeaderDialogue",
    "LeaderLink",
    "Length",
    "LimitError",
    "LineProgram",
    "LineSpec",
    "Lines",
    "LinesFacts",
    "MobileTweezers",
    "MotionSpec",
    "NeedsWarmUp",
    "Occupancy",
    "Plan",
    "PlanError",
    "Planner",
    "PositiveDuration",
    "Power",
    "Problem",
    "RandomStream",
    "RecordedShot",
    "Registry",
    "ReportsSignals",
    "RunRecord",
    "ScanRange",
    "ScanSpace",
    "Scanner",
    "SensorMode",
    "Settings",
    "Shot",
    "ShotAbortedError",
    "ShotRecord",
    "Signal",
    "Simulation",
    "SiteGrid",
    "Speed",
    "StaticTweezers",
    "Step",
    "StepContext",
    "StopRequested",
    "TargetPattern",
    "Temperature",
    "Text",
    "TimedBy",
    "TimelineEntry",
    "ToneProgram",
    "TransientError",
    "Trigger",
    "TweezerAmplitudes",
    "TweezersFacts",
    "VisitedPoint",
    "Voltage",
    "as_occupancy",
    "const",
    "empty_is",
    "format_quantity",
    "helper_kernel",
    "hookimpl",
    "kernel",
    "setting_error",
    "wait_for",
]
