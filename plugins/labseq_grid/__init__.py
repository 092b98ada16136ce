"""A planner that moves rows x columns of atoms at once, directly from the reservoir to the vacancies."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planner ``grid``."""
    registry.planner("grid", "labseq_grid.planner:GridPlanner", "labseq_grid.planner:GridSettings")
