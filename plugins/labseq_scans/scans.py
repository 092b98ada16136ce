"""What a scan of the source is in labseq: batches to carry it out, and the time that it takes there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import MotionSpec, Plan, SiteGrid, site_time_s


@dataclass(frozen=True, slots=True, eq=False)
class ScannedPlan:
    """A plan that was made of scans.

    In a scan, tweezers in a row (or column) move over the array and each picks up
    and drops atoms in passing. A plan has no such thing: its tweezers pick up
    together and drop together. So a scan becomes one batch for every pair of a line
    where atoms are picked up and a line where they are dropped.

    Attributes:
        plan: The batches, in the order of the scans.
        lines_passed: int64 (n_scans,), rows (or columns) that each scan passes,
            the first and the last included.
    """

    plan: Plan
    lines_passed: NDArray[np.int64]

    @property
    def n_scans(self) -> int:
        """Number of scans: what the source counts as moves."""
        return len(self.lines_passed)

    def duration_s(self, grid: SiteGrid, motion: MotionSpec) -> float:
        """Time that the scans themselves would take, hardware delays left out.

        A scan waits on every line that it passes for one ramp, whether or not an
        atom is picked up or dropped there, and moves by one site in between.

        Args:
            grid: Tells the spacing of the sites.
            motion: Tells the speed and the ramps, of which the longer one counts.

        Returns:
            Seconds.

        Raises:
            LimitError: The speed profile is none that exists.
        """
        n_stops = int(self.lines_passed.sum())
        wait_s = max(motion.pick_up_s, motion.drop_off_s)
        return n_stops * wait_s + (n_stops - self.n_scans) * site_time_s(grid, motion)
