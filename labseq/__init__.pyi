"""Types of the flat public namespace; the table in ``__init__.py`` resolves the same names."""

from labseq.api import (
    make_planner as make_planner,
    make_target as make_target,
    tone_program as tone_program,
)
from labseq.config.settings import (
    Angle as Angle,
    Duration as Duration,
    FilePath as FilePath,
    Fraction as Fraction,
    Frequency as Frequency,
    Length as Length,
    Power as Power,
    Settings as Settings,
    Speed as Speed,
    Temperature as Temperature,
    Voltage as Voltage,
)
from labseq.drivers import (
    CameraDriver as CameraDriver,
    Cooling as Cooling,
    ExposureResult as ExposureResult,
    Series as Series,
    SimulatedSensor as SimulatedSensor,
    settle as settle,
    wait_for as wait_for,
)
from labseq.drivers.settings import (
    CameraSettings as CameraSettings,
    CoolingSettings as CoolingSettings,
)
from labseq.errors import (
    ConfigError as ConfigError,
    DeviceError as DeviceError,
    DeviceTimeoutError as DeviceTimeoutError,
    InvalidPlanError as InvalidPlanError,
    LabseqError as LabseqError,
    LimitError as LimitError,
    PlanError as PlanError,
    PluginLoadError as PluginLoadError,
    RecordingError as RecordingError,
    StopRequested as StopRequested,
    TransientError as TransientError,
    UnknownPluginError as UnknownPluginError,
)
from labseq.hookspecs import (
    LABSEQ_API as LABSEQ_API,
    hookimpl as hookimpl,
)
from labseq.model import (
    Batch as Batch,
    CalibrationEntry as CalibrationEntry,
    CameraFacts as CameraFacts,
    DepthRamp as DepthRamp,
    Frame as Frame,
    LineProgram as LineProgram,
    LinesFacts as LinesFacts,
    LineSpec as LineSpec,
    MotionSpec as MotionSpec,
    Occupancy as Occupancy,
    Plan as Plan,
    PlanReport as PlanReport,
    RandomStream as RandomStream,
    RfSamples as RfSamples,
    RfSpan as RfSpan,
    RfSpec as RfSpec,
    RfTones as RfTones,
    RunRecord as RunRecord,
    ScanRange as ScanRange,
    ScanSpace as ScanSpace,
    SensorMode as SensorMode,
    ShotRecord as ShotRecord,
    SiteGrid as SiteGrid,
    TargetPattern as TargetPattern,
    TimelineEntry as TimelineEntry,
    ToneProgram as ToneProgram,
    TweezerAmplitudes as TweezerAmplitudes,
    VisitedPoint as VisitedPoint,
    Waveform as Waveform,
    as_occupancy as as_occupancy,
)
from labseq.motion import (
    check_plan as check_plan,
    render as render,
)
from labseq.recording import (
    Run as Run,
    open_run as open_run,
)
from labseq.registry import (
    Registry as Registry,
)
from labseq.roles import (
    Analysis as Analysis,
    Camera as Camera,
    Clock as Clock,
    Context as Context,
    Detector as Detector,
    Device as Device,
    LeaderLink as LeaderLink,
    Lines as Lines,
    MobileTweezers as MobileTweezers,
    NeedsWarmUp as NeedsWarmUp,
    Planner as Planner,
    ReceivesOutput as ReceivesOutput,
    RecordedShot as RecordedShot,
    ReportsSignals as ReportsSignals,
    RfSource as RfSource,
    Scanner as Scanner,
    Shot as Shot,
    Simulation as Simulation,
    StaticTweezers as StaticTweezers,
    Step as Step,
    StepContext as StepContext,
    ToneSource as ToneSource,
    Trigger as Trigger,
)
from labseq.session import (
    Session as Session,
)

__version__: str
