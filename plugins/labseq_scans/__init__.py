"""Rivals of PSCA that move whole lines of atoms: MTA1 of Ebadi et al., Tetris of Wang et al."""

from __future__ import annotations

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners ``mta1`` and ``tetris`` and the pattern ``interleaved``."""
    from labseq_scans import pattern, planners as mta1, planners as tetris

    registry.planner("mta1", mta1.Mta1Planner, mta1.Mta1Settings)
    registry.planner("tetris", tetris.TetrisPlanner, tetris.TetrisSettings)
    registry.pattern("interleaved", pattern.interleaved, pattern.InterleavedSettings)
