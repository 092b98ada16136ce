"""The planner ``auto``, which compares other planners on random loadings of the target and uses the best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from numpy.typing import ArrayLike
from pydantic import Field

from labseq.plugin import (
    Context,
    Fraction,
    LimitError,
    Plan,
    PlanError,
    Planner,
    Registry,
    Settings,
    TargetPattern,
    as_occupancy,
)
from labseq.plugin.planning import Expected, expect, loading_of, random_loadings


class AutoSettings(Settings):
    """Settings of the planner ``auto``."""

    loading: Fraction | None = Field(
        default=None,
        gt=0,
        description="fraction of sites with an atom in the loadings on which planners are compared; default: "
        "loading of the simulation, else 75 %",
    )


TWEEZERS: Final = (2, 4, 7, 10, 15, 20, 40)
"""Numbers of tweezers to compare, including those in the figures of the paper."""
PLANNERS: Final[dict[str, dict[str, Any]]] = {"psca": {}, "grid": {"lanes": "weaving"}}
"""Planners to compare, with their settings. They lose fewer atoms than labseq's other planners."""
SHALLOWEST: Final = 0.8
"""Least depth of tweezers on paths at which predicted losses are valid, see docs/explanation/survival.md."""
SITES: Final = 5000
"""Approximate number of sites in all loadings, 12 of 20 x 20."""
LOADINGS: Final = (3, 12)
"""Least and greatest number of loadings."""


@dataclass(frozen=True)
class Candidate:
    """A planner with its settings.

    Attributes:
        name: Name for messages.
        planner: The planner.
        tweezers: Most tweezers on at once.
    """

    name: str
    planner: Planner
    tweezers: int


class AutoPlanner:
    """Plans with the planner that is expected to leave the fewest defects of a target.

    The best planner depends on grid, lattice, target, light and losses. When a target first comes, it is
    found by :func:`labseq.plugin.planning.expect` on loadings that are always the same.

    Args:
        context: Its grid, motion and losses decide.
        registry: Registry with the other planners.

    Attributes:
        degree_of_parallelism: Most tweezers on at once of any candidate.
    """

    def __init__(self, settings: AutoSettings, context: Context, registry: Registry) -> None:
        self._context = context
        self._loading = loading_of(context.simulation) if settings.loading is None else settings.loading
        self._why_not: list[str] = []
        self._candidates = self._all(registry)
        self.degree_of_parallelism = max(candidate.tweezers for candidate in self._candidates)
        self._key: tuple[bytes, bytes, float] | None = None
        self._window_s = math.inf
        self._chosen, self._why = self._candidates[0], list[str]()

    def _all(self, registry: Registry) -> list[Candidate]:
        """The planners that this machine allows. They always include psca, which needs no lanes."""
        most, found = self._context.motion.max_tweezers, list[Candidate]()
        for name, settings in PLANNERS.items():
            entry = registry.get("planner", name)
            model: Any = entry.settings_model
            if "lanes" in settings and self._context.motion.path_depth < SHALLOWEST:
                depth = f"at a path_depth below {SHALLOWEST:g} more atoms fall out than predicted"
                self._why_not.append(f"{name} is left out: {depth}")
                continue
            try:
                for n in sorted({min(n, most) for n in TWEEZERS}):
                    values = model.model_validate({**settings, "degree_of_parallelism": n})
                    words = f"{name} with {n} tweezer{'s' * (n > 1)}"
                    found.append(Candidate(words, entry.factory(values, self._context), n))
            except LimitError as error:
                why = "; ".join(str(error).split("; ")[:2])  # the rest is for users who named the planner
                self._why_not.append(f"{name} is left out: {why}")
        return found

    def warm(self) -> None:
        """Compile the kernels, or load them from the cache."""
        for candidate in self._candidates:
            getattr(candidate.planner, "warm", lambda: None)()

    def choose(self, target: TargetPattern, window_s: float = math.inf) -> Sequence[str]:
        """Choose the planner of a target, if that is not done.

        Args:
            window_s: Time from the start of the first cycle in which its batches must end.

        Returns:
            The choice, the next best of each planner, and why others cannot be chosen.
        """
        if (key := (target.fill.tobytes(), target.clear.tobytes(), window_s)) != self._key:
            fewest, most = LOADINGS
            n_loadings = min(max(fewest, SITES // target.fill.size), most)
            loadings = random_loadings(target.shape, self._loading, n_loadings)
            results = [(self._expect(one, loadings, target, window_s), one) for one in self._candidates]
            results.sort(key=lambda result: result[0].n_defects)
            self._chosen = results[0][1]
            texts = [f"{candidate.name}: {expected}" for expected, candidate in results]
            next_best = (next((text for text in texts[1:] if text.startswith(name)), "") for name in PLANNERS)
            self._why = [texts[0], *filter(None, next_best), *self._why_not]
            self._key, self._window_s = key, window_s
        return self._why

    def _expect(
        self, candidate: Candidate, loadings: Any, target: TargetPattern, window_s: float
    ) -> Expected:
        grid, motion = self._context.grid, self._context.motion
        return expect(candidate.planner.plan, loadings, target, candidate.tweezers, grid, motion, window_s)

    def plan(self, occupancy: ArrayLike, target: TargetPattern) -> Plan:
        """Plan with the planner that was chosen for the target.

        Args:
            occupancy: bool (n_rows, n_cols), as detected.
            target: The wanted pattern, of the same shape.

        Raises:
            PlanError: The occupancy is not an array of zeros and ones in the target's shape.
        """
        try:
            occupied = as_occupancy(occupancy, target.shape)
        except (TypeError, ValueError) as error:
            raise PlanError(str(error), "auto") from error
        self.choose(target, self._window_s)
        return self._chosen.planner.plan(occupied, target)
