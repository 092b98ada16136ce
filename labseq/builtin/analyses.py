"""The built-in analysis: survival from image to image."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from pydantic import Field

from labseq.plugin import Context, CycleRecord, ImageRecord, Occupancy, Plan, RecordedShot, Settings


class SurvivalSettings(Settings):
    """How many atoms are there on the next image, site by site."""

    atoms: Literal["all", "moved", "held"] = Field(
        default="all",
        description="which atoms count: all, those that were moved in between, or those that were not",
    )


class SurvivalAnalysis:
    """Site-resolved survival from each image of a shot to the next.

    An atom counts at the site where it should be on the next image: that to which the batches
    that were played between the two have moved it. Atoms that they ejected do not count. What
    detection gets wrong is part of it.
    """

    results = ("survival",)

    def __init__(self, settings: SurvivalSettings, context: Context) -> None:  # noqa: ARG002 - as every factory
        self.atoms = settings.atoms

    def shot(self, shot: RecordedShot) -> dict[str, Any]:
        """Count the atoms of a shot.

        Returns:
            "survival" of all atoms and pairs of images (nan without any), "n_expected" and
            "n_survived" of each pair, and over all pairs "expected" and "survived" at each
            site, int64 (n_rows, n_cols).
        """
        images, n_expected, n_survived = shot.images, list[int](), list[int]()
        shape = images[0].occupancy.shape if images else (0, 0)
        expected, survived = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        for before, after in pairwise(images):
            played = [cycle for cycle in shot.cycles if _place(before) < _place(cycle) <= _place(after)]
            sites = self._expected(before.occupancy, played)
            expected += sites
            survived += sites & after.occupancy
            n_expected.append(int(np.count_nonzero(sites)))
            n_survived.append(int(np.count_nonzero(sites & after.occupancy)))
        total = sum(n_expected)
        return {
            "survival": sum(n_survived) / total if total else float("nan"),
            "n_expected": n_expected,
            "n_survived": n_survived,
            "expected": expected,
            "survived": survived,
        }

    def _expected(self, before: Occupancy, played: Sequence[CycleRecord]) -> Occupancy:
        held, moved = before.copy(), np.zeros(before.shape, np.bool_)
        for cycle in played:
            held, moved = after_moves(held, moved, cycle.plan.first(cycle.n_batches_played))
        return {"all": held | moved, "moved": moved, "held": held}[self.atoms]


def after_moves(held: Occupancy, moved: Occupancy, plan: Plan) -> tuple[Occupancy, Occupancy]:
    """Where atoms are after a plan if none is lost.

    Args:
        held: bool (n_rows, n_cols), atoms that have not been moved yet.
        moved: bool (n_rows, n_cols), those that have.
        plan: The plan.

    Returns:
        The same after the plan; what left the grid is in neither.

    Example:
        >>> row = np.array([[True, True, False]])
        >>> plan = Plan.from_batches([([(0, 1)], [(0, 2)])])
        >>> held, moved = after_moves(row, np.zeros_like(row), plan)
        >>> held.astype(int).tolist(), moved.astype(int).tolist()
        ([[1, 0, 0]], [[0, 0, 1]])
    """
    held, moved = held.copy(), moved.copy()
    for batch in plan.batches:
        sources, goals = tuple(batch.from_sites.T), batch.to_sites
        carried = held[sources] | moved[sources]
        held[sources] = moved[sources] = False
        inside = carried & ((goals >= 0) & (goals < held.shape)).all(axis=1)
        moved[tuple(goals[inside].T)] = True
    return held, moved


def _place(record: ImageRecord | CycleRecord) -> tuple[int, int]:
    """Its place in the shot: the image that ends a cycle has the place of the cycle."""
    return record.step, record.cycle
