"""Runs shots: steps, declared states, retries, and the safe state however a run ends.

Depends on the roles only, not on plugins, files, YAML or numba.
"""

from labseq.sequencer.clock import PacedClock, RealClock, VirtualClock
from labseq.sequencer.lab import Lab
from labseq.sequencer.run import Sequencer, State

__all__ = ["Lab", "PacedClock", "RealClock", "Sequencer", "State", "VirtualClock"]
