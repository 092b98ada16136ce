"""Runs on disk: a folder per run, one HDF5 file per shot, and the way back."""

from labseq.recording.active import clear_active, died, in_progress, mark_active, marker_roots
from labseq.recording.folders import data_root
from labseq.recording.reader import Run, Shot, open_run
from labseq.recording.writer import RunWriter

__all__ = [
    "Run",
    "RunWriter",
    "Shot",
    "clear_active",
    "data_root",
    "died",
    "in_progress",
    "mark_active",
    "marker_roots",
    "open_run",
]
