"""The API for plugins: roles, the types of their methods, settings, errors and kernels.

Parts that only some plugins need are in modules by subject:

- ``camera``: base class of camera drivers, their settings, cooling, a simulated sensor
- ``camera_simulator``, ``sdk_camera``: shared code of camera simulators, and of drivers on vendors' libraries
- ``first_contact``: steps that test the assumptions of a driver, and the file with their results
- ``geometry``: blocks of sites of a grid, patterns, the order of sites from the centre
- ``leader``: settings, log and simulation of another control system that starts the shots
- ``lines``: programs of a timing box, and the line that triggers a device
- ``messages``: wording of error messages
- ``motion``: conversion of a plan to tones, and to the samples of an AWG
- ``native``: calls of C from compiled code, and clocks, signals and thread priorities without Python
- ``planning``: checking, comparing and following plans
- ``runs``: reading recorded runs
- ``serial``: serial ports, and devices that are switched off over a serial port
- ``simulation``: data from simulated devices to a simulation that acts on their outputs
- ``system``: folders for files that outlive a run, other processes, a clock outside of a run
- ``tweezers``: shared checks and amplitudes for drivers of static tweezers
- ``units``, ``wire``: quantities as text, messages between computers

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
