"""The settings and steps of a run at one point of its scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from labseq.assembly.plugin_choice import ChosenPlugin

if TYPE_CHECKING:
    from labseq.assembly.profile import ResolvedProfile
    from labseq.config.document import Document
    from labseq.model import TargetPattern
    from labseq.roles import Step


@dataclass(frozen=True, slots=True)
class Point:
    """A run's settings at one point.

    Attributes:
        planner: The planner and its settings.
        steps: Name and step, in order.
        hardware: The profile.
        parameters: Scanned address -> value, SI, JSON-ready.
        document: The sequence's file with the values of the point.
        target: The target. None for the target of the run.
    """

    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    hardware: ResolvedProfile
    parameters: Mapping[str, Any]
    document: Document
    target: TargetPattern | None = None

    @property
    def lab_key(self) -> tuple[int, int]:
        """A key that is equal for points with the same devices and planner, as long as the points exist."""
        return id(self.planner), id(self.hardware)
