"""labseq: lab control for neutral-atom tweezer arrays.

The namespace for notebooks and scripts: sessions, runs, plans, domain types and errors. Authors of
plugins import :mod:`labseq.plugin`. Names are resolved when they are first used, so that importing labseq
takes little time.
"""

from __future__ import annotations

import importlib

_HOMES = {
    "labseq.api": (
        "make_planner",
        "make_target",
        "tone_program",
    ),
    "labseq.errors": (
        "ConfigError",
        "DeviceError",
        "DeviceTimeoutError",
        "InvalidPlanError",
        "LabseqError",
        "LimitError",
        "PlanError",
        "PluginLoadError",
        "RecordingError",
        "StopRequested",
        "TransientError",
        "UnknownPluginError",
    ),
    "labseq.model": (
        "Batch",
        "CalibrationEntry",
        "Frame",
        "LineProgram",
        "LineSpec",
        "MotionSpec",
        "Occupancy",
        "Plan",
        "PlanReport",
        "RfSpec",
        "RunRecord",
        "ScanRange",
        "ShotRecord",
        "SiteGrid",
        "TargetPattern",
        "TonePaths",
        "ToneProgram",
        "VisitedPoint",
        "as_occupancy",
    ),
    "labseq.motion": ("check_plan",),
    "labseq.motion.rendering": ("render",),
    "labseq.data.catalogue": ("runs",),
    "labseq.data.entry": ("RunEntry",),
    "labseq.data.reader": ("Run", "open_run"),
    "labseq.session.asked": ("ShotResult", "serve"),
    "labseq.session.session": ("Session",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__version__ = "0.3.0"


def __getattr__(name: str) -> object:
    if name == "plugin":
        return importlib.import_module("labseq.plugin")
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'labseq' has no attribute '{name}'")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
