"""Rivals of PSCA that move whole lines of atoms: MTA1 of Ebadi et al., Tetris of Wang et al."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners ``mta1`` and ``tetris`` and the pattern ``interleaved``."""
    planners, pattern = "labseq_scans.planners", "labseq_scans.pattern"
    registry.planner("mta1", f"{planners}:Mta1Planner", f"{planners}:LineSettings")
    registry.planner("tetris", f"{planners}:TetrisPlanner", f"{planners}:LineSettings")
    registry.pattern("interleaved", f"{pattern}:interleaved", f"{pattern}:InterleavedSettings")
