"""The built-in analysis: survival from image to image."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from pydantic import Field

from labseq.plugin import Context, CycleRecord, ImageRecord, Occupancy, RecordedShot, Settings
from labseq.plugin.planning import follow_atoms


class SurvivalSettings(Settings):
    """``survival``: the survival of atoms from image to image, site by site."""

    atoms: Literal["all", "moved", "held"] = Field(
        default="all",
        description="which atoms count: all, atoms that were moved in between, or atoms that were not",
    )


class SurvivalAnalysis:
    """Site-resolved survival from each image of a shot to the next.

    An atom counts at the site to which the batches between the two images have moved it. Ejected atoms do not
    count. The survival includes detection errors.
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
        moved, held = follow_atoms(before, played)
        return {"all": held | moved, "moved": moved, "held": held}[self.atoms]


def _place(record: ImageRecord | CycleRecord) -> tuple[int, int]:
    """Place of a record in the shot. The image that ends a cycle has the place of the cycle."""
    return record.step, record.cycle
