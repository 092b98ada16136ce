"""Reading recorded runs."""

from __future__ import annotations

from labseq.data.reader import Run, open_run
from labseq.errors import RecordingError

__all__ = [
    "RecordingError",
    "Run",
    "open_run",
]
