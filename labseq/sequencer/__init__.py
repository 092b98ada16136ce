"""Runs shots: steps, declared states, retries, and the safe state on every way out.

Knows roles; knows nothing of plugins, files, YAML or numba.
"""

from labseq.sequencer.clock import PacedClock, RealClock, StopFlag, VirtualClock
from labseq.sequencer.guard import Guard
from labseq.sequencer.lab import Lab
from labseq.sequencer.run import Sequencer, State

__all__ = ["Guard", "Lab", "PacedClock", "RealClock", "Sequencer", "State", "StopFlag", "VirtualClock"]
