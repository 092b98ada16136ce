"""The frozen domain types: what the rest of labseq talks about."""

from labseq.model.arrays import Occupancy, as_occupancy, read_only
from labseq.model.calibration import (
    CALIBRATION_KINDS,
    CalibrationEntry,
    CalibrationKind,
    grid_facts,
    same_grid,
)
from labseq.model.camera import CameraFacts, Flip, Frame, Orientation, SensorMode
from labseq.model.grid import SiteGrid, TargetPattern
from labseq.model.lines import LineProgram, LinesFacts, LineSpec
from labseq.model.motion import MotionSpec, RfSamples, RfSpan, RfSpec, RfTones
from labseq.model.plan import Batch, Plan, PlanReport, TonePaths
from labseq.model.records import (
    COMPUTER,
    CycleRecord,
    ImageRecord,
    RunRecord,
    ShotRecord,
    StageTiming,
    StepTiming,
    TimedBy,
    TimelineEntry,
    follow_atoms,
)
from labseq.model.scanning import RandomStream, ScanRange, ScanSpace, VisitedPoint
from labseq.model.signals import (
    AxisTones,
    DepthRamp,
    FrequencyCourse,
    SegmentKind,
    ToneProgram,
    TonesAt,
    TonesNow,
    TweezerAmplitudes,
    TweezersFacts,
    Waveform,
)

__all__ = [
    "CALIBRATION_KINDS",
    "COMPUTER",
    "AxisTones",
    "Batch",
    "CalibrationEntry",
    "CalibrationKind",
    "CameraFacts",
    "CycleRecord",
    "DepthRamp",
    "Flip",
    "Frame",
    "FrequencyCourse",
    "ImageRecord",
    "LineProgram",
    "LineSpec",
    "LinesFacts",
    "MotionSpec",
    "Occupancy",
    "Orientation",
    "Plan",
    "PlanReport",
    "RandomStream",
    "RfSamples",
    "RfSpan",
    "RfSpec",
    "RfTones",
    "RunRecord",
    "ScanRange",
    "ScanSpace",
    "SegmentKind",
    "SensorMode",
    "ShotRecord",
    "SiteGrid",
    "StageTiming",
    "StepTiming",
    "TargetPattern",
    "TimedBy",
    "TimelineEntry",
    "TonePaths",
    "ToneProgram",
    "TonesAt",
    "TonesNow",
    "TweezerAmplitudes",
    "TweezersFacts",
    "VisitedPoint",
    "Waveform",
    "as_occupancy",
    "follow_atoms",
    "grid_facts",
    "read_only",
    "same_grid",
]
