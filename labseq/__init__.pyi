"""Types of the flat public namespace; the table in ``__init__.py`` resolves the same names."""

from labseq._markers import (
    hookimpl as hookimpl,
)
from labseq.api import (
    make_planner as make_planner,
)
from labseq.api import (
    make_target as make_target,
)
from labseq.config.settings import (
    Angle as Angle,
)
from labseq.config.settings import (
    Duration as Duration,
)
from labseq.config.settings import (
    Fraction as Fraction,
)
from labseq.config.settings import (
    Frequency as Frequency,
)
from labseq.config.settings import (
    Length as Length,
)
from labseq.config.settings import (
    Settings as Settings,
)
from labseq.config.settings import (
    Speed as Speed,
)
from labseq.config.settings import (
    Temperature as Temperature,
)
from labseq.config.settings import (
    Voltage as Voltage,
)
from labseq.errors import (
    ConfigError as ConfigError,
)
from labseq.errors import (
    DeviceError as DeviceError,
)
from labseq.errors import (
    DeviceTimeoutError as DeviceTimeoutError,
)
from labseq.errors import (
    InvalidPlanError as InvalidPlanError,
)
from labseq.errors import (
    LabseqError as LabseqError,
)
from labseq.errors import (
    LimitError as LimitError,
)
from labseq.errors import (
    PlanError as PlanError,
)
from labseq.errors import (
    PluginLoadError as PluginLoadError,
)
from labseq.errors import (
    RecordingError as RecordingError,
)
from labseq.errors import (
    StopRequested as StopRequested,
)
from labseq.errors import (
    TransientError as TransientError,
)
from labseq.errors import (
    UnknownPluginError as UnknownPluginError,
)
from labseq.hookspecs import (
    LABSEQ_API as LABSEQ_API,
)
from labseq.model import (
    Batch as Batch,
)
from labseq.model import (
    DepthRamp as DepthRamp,
)
from labseq.model import (
    Frame as Frame,
)
from labseq.model import (
    MotionSpec as MotionSpec,
)
from labseq.model import (
    Occupancy as Occupancy,
)
from labseq.model import (
    Plan as Plan,
)
from labseq.model import (
    PlanReport as PlanReport,
)
from labseq.model import (
    RandomStream as RandomStream,
)
from labseq.model import (
    RunRecord as RunRecord,
)
from labseq.model import (
    ShotRecord as ShotRecord,
)
from labseq.model import (
    SiteGrid as SiteGrid,
)
from labseq.model import (
    TargetPattern as TargetPattern,
)
from labseq.model import (
    TimelineEntry as TimelineEntry,
)
from labseq.model import (
    ToneProgram as ToneProgram,
)
from labseq.model import (
    Waveform as Waveform,
)
from labseq.model import (
    as_occupancy as as_occupancy,
)
from labseq.motion import (
    check_plan as check_plan,
)
from labseq.motion import (
    tone_program as tone_program,
)
from labseq.recording import (
    Run as Run,
)
from labseq.recording import (
    open_run as open_run,
)
from labseq.registry import (
    Registry as Registry,
)
from labseq.roles import (
    Camera as Camera,
)
from labseq.roles import (
    Clock as Clock,
)
from labseq.roles import (
    Context as Context,
)
from labseq.roles import (
    Detector as Detector,
)
from labseq.roles import (
    Device as Device,
)
from labseq.roles import (
    Lines as Lines,
)
from labseq.roles import (
    MobileTweezers as MobileTweezers,
)
from labseq.roles import (
    Planner as Planner,
)
from labseq.roles import (
    ReadsOut as ReadsOut,
)
from labseq.roles import (
    Shot as Shot,
)
from labseq.roles import (
    Simulation as Simulation,
)
from labseq.roles import (
    StaticTweezers as StaticTweezers,
)
from labseq.roles import (
    Step as Step,
)
from labseq.roles import (
    StepContext as StepContext,
)
from labseq.roles import (
    Trigger as Trigger,
)
from labseq.roles import (
    TruthTeller as TruthTeller,
)
from labseq.roles import (
    Warmable as Warmable,
)
from labseq.session import (
    Session as Session,
)

__version__: str
