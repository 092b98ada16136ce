"""What the set-up means for a run, and for a pulse at the trigger input."""

from __future__ import annotations

from typing import Final

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.fifo import Fifo
from labseq_spcm.simulator.memory import Memory, Samples
from labseq_spcm.simulator.replay import Replay, Run, Sequence
from labseq_spcm.simulator.rules import Refusal, Setup

EDGES: Final = (r.SPC_TM_POS, r.SPC_TM_NEG, r.SPC_TM_BOTH)


def new_run(
    setup: Setup, memory: Memory, steps: dict[int, int], segment_sizes: dict[int, int], fifo: Fifo | None
) -> Run | None:
    """The run that begins with a start of the card; None in DDS mode, where there are no samples.

    Raises:
        Refusal: FIFO mode without a buffer.
    """
    mode, n_channels, rate = setup.mode, len(setup.channels), setup[r.SPC_SAMPLERATE]
    loops = setup[r.SPC_LOOPS]
    if mode == r.SPC_REP_STD_DDS:
        return None
    if mode == r.SPC_REP_FIFO_SINGLE:
        if fifo is None:
            raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
        fifo.set_length(loops * setup[r.SPC_SEGMENTSIZE])
        return fifo
    if mode == r.SPC_REP_STD_SEQUENCE:

        def segment(index: int) -> Samples:
            return memory.read(index, max(1, segment_sizes.get(index, 0)), n_channels)

        return Sequence(segment, steps, setup[r.SPC_SEQMODE_STARTSTEP], rate)
    software = setup[r.SPC_TRIG_ORMASK] == r.SPC_TMASK_SOFTWARE
    restart = mode == r.SPC_REP_STD_SINGLERESTART and not software
    n_samples = setup[r.SPC_MEMSIZE]
    return Replay(lambda: memory.read(None, n_samples, n_channels), rate, loops, restart=restart)


def crosses(setup: Setup, voltage_v: float) -> bool:
    """Whether a pulse from 0 V at Ext0 crosses the level that is set, on an edge that counts."""
    level_v = setup[r.SPC_TRIG_EXT0_LEVEL0] / 1000
    return (
        setup[r.SPC_TRIG_ORMASK] == r.SPC_TMASK_EXT0
        and setup[r.SPC_TRIG_EXT0_MODE] in EDGES
        and min(0.0, voltage_v) < level_v < max(0.0, voltage_v)
    )
