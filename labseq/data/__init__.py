"""Reads recorded runs, in progress or finished: shots, quantities, tables, exports."""

from labseq.data.reader import Run, open_run
from labseq.data.shot import Shot

__all__ = ["Run", "Shot", "open_run"]
