"""Types of the flat public namespace; the table in ``__init__.py`` resolves the same names."""

from labseq import plugin as plugin
from labseq.api import (
    make_planner as make_planner,
    make_target as make_target,
    tone_program as tone_program,
)
from labseq.data.catalogue import runs as runs
from labseq.data.entry import RunEntry as RunEntry
from labseq.data.reader import Run as Run, open_run as open_run
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
from labseq.model import (
    Batch as Batch,
    CalibrationEntry as CalibrationEntry,
    Frame as Frame,
    LineProgram as LineProgram,
    LineSpec as LineSpec,
    MotionSpec as MotionSpec,
    Occupancy as Occupancy,
    Plan as Plan,
    PlanReport as PlanReport,
    RfSpec as RfSpec,
    RunRecord as RunRecord,
    ScanRange as ScanRange,
    ShotRecord as ShotRecord,
    SiteGrid as SiteGrid,
    TargetPattern as TargetPattern,
    TonePaths as TonePaths,
    ToneProgram as ToneProgram,
    VisitedPoint as VisitedPoint,
    as_occupancy as as_occupancy,
)
from labseq.motion import check_plan as check_plan
from labseq.motion.rendering import render as render
from labseq.session.asked import ShotResult as ShotResult, serve as serve
from labseq.session.session import Session as Session

__version__: str
