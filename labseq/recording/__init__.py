"""Writes the folder of a run, with one HDF5 file per shot; one schema, which readers follow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from labseq.files import data_root
from labseq.recording.markers import (
    clear_active,
    find_dead_run,
    lock_file,
    mark_active,
    runs_in_progress,
)

if TYPE_CHECKING:
    from labseq.recording.writer import RunWriter

__all__ = [
    "RunWriter",
    "clear_active",
    "data_root",
    "find_dead_run",
    "lock_file",
    "mark_active",
    "runs_in_progress",
]


def __getattr__(name: str) -> object:
    if name != "RunWriter":
        raise AttributeError(f"module 'labseq.recording' has no attribute '{name}'")
    from labseq.recording.writer import RunWriter  # with numpy, which readers of names and notes do not need

    globals()[name] = RunWriter
    return RunWriter
