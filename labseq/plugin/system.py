"""Folders for files that outlive a run, other processes, and a clock for use outside of a run."""

from __future__ import annotations

from labseq.files import cache_root, state_root
from labseq.processes import Process
from labseq.roles.shot import NeverStopped

__all__ = [
    "NeverStopped",
    "Process",
    "cache_root",
    "state_root",
]
