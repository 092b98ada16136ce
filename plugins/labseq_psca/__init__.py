"""A generalised PSCA for any target on any grid, PSCA as in the text of Tian et al., and repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from labseq.plugin import Context, Registry, hookimpl

if TYPE_CHECKING:
    from labseq_psca.repair import RepairPlanner, RepairSettings

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planners ``psca`` and ``repair``."""

    def repair(settings: RepairSettings, context: Context) -> RepairPlanner:
        """Uses another planner, but fills few defects with few atom moves if that loses fewer atoms."""
        from labseq_psca.repair import RepairPlanner, construct_other

        return RepairPlanner(settings, context, construct_other(registry, settings.after, context))

    registry.planner("psca", "labseq_psca.planner:PscaPlanner", "labseq_psca.planner:PscaSettings")
    registry.planner("repair", repair, "labseq_psca.repair:RepairSettings")
