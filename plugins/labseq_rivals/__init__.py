"""Rivals of PSCA for comparisons, which are MTA1, Tetris, and planners with a single mobile tweezer."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners and the pattern ``interleaved``."""
    planners, pattern = "labseq_rivals.planners", "labseq_rivals.interleaved"
    registry.planner("mta1", f"{planners}:Mta1Planner", f"{planners}:LineSettings")
    registry.planner("tetris", f"{planners}:TetrisPlanner", f"{planners}:LineSettings")
    registry.planner("lsap", f"{planners}:LsapPlanner")
    registry.planner("lsap_squared", f"{planners}:LsapSquaredPlanner")
    registry.planner("compression", f"{planners}:CompressionPlanner")
    registry.planner("hca", f"{planners}:HcaPlanner")
    registry.pattern("interleaved", f"{pattern}:interleaved", f"{pattern}:InterleavedSettings")
