"""The planner ``auto``, which uses ``psca`` or ``grid``, whichever is expected to leave fewer defects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from labseq.plugin import Context, Registry, hookimpl

if TYPE_CHECKING:
    from labseq_auto.planner import AutoPlanner, AutoSettings

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the planner ``auto``."""

    def auto(settings: AutoSettings, context: Context) -> AutoPlanner:
        """Chooses planner, lanes and number of tweezers for grid, target and light, by expected defects."""
        from labseq_auto.planner import AutoPlanner

        return AutoPlanner(settings, context, registry)

    registry.planner("auto", auto, "labseq_auto.planner:AutoSettings")
