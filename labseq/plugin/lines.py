"""Programs of a timing box, the line that triggers a device, and the leader."""

from __future__ import annotations

from labseq.roles import find_leader
from labseq.sequencer.lines import idle_program, off_program, trigger_line

__all__ = [
    "find_leader",
    "idle_program",
    "off_program",
    "trigger_line",
]
