"""Recorded runs: writes and reads a folder per run with one HDF5 file per shot."""

from labseq.files import data_root
from labseq.recording.columns import quantities_in
from labseq.recording.markers import (
    clear_active,
    find_dead_run,
    lock_file,
    mark_active,
    runs_in_progress,
)
from labseq.recording.reader import Run, open_run
from labseq.recording.shot import Shot
from labseq.recording.writer import RunWriter

__all__ = [
    "Run",
    "RunWriter",
    "Shot",
    "clear_active",
    "data_root",
    "find_dead_run",
    "lock_file",
    "mark_active",
    "open_run",
    "quantities_in",
    "runs_in_progress",
]
