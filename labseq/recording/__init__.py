"""Writes the folder of a run, with one HDF5 file per shot, according to one schema that readers share."""

from labseq.files import data_root
from labseq.recording.markers import (
    clear_active,
    find_dead_run,
    lock_file,
    mark_active,
    runs_in_progress,
)

__all__ = [
    "clear_active",
    "data_root",
    "find_dead_run",
    "lock_file",
    "mark_active",
    "runs_in_progress",
]
