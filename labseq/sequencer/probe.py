"""The step that probes where the mobile tweezers stand: pick up, hold and drop in place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError
from labseq.model import Occupancy, SiteGrid, TimelineEntry
from labseq.motion import cross_offsets_m, hold_program, hold_time_s
from labseq.roles import Shot, StepContext
from labseq.sequencer.playing import play

Pattern = Literal["same", "cross"]


class HoldSettings(Protocol):
    """How atoms are held, from the settings of a step."""

    @property
    def hold(self) -> float:
        """Time between the ramps, in seconds."""
        ...

    @property
    def drop_off(self) -> float:
        """Duration of the drop-off, in seconds."""
        ...


class _Settings(HoldSettings, Protocol):
    @property
    def offset(self) -> tuple[float, float]: ...
    @property
    def pattern(self) -> Pattern: ...
    @property
    def sites(self) -> Literal["seen", "all"]: ...


class ProbeStep:
    """Picks atoms up, holds them and sets them down, beside their sites by an offset.

    Who survives tells where the mobile tweezers stand; an image after it shows that.
    """

    needs_image = True
    takes_image = False

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One bar, with all sites held.

        Raises:
            LimitError: At this offset, tones of the grid break a limit.
        """
        settings = self.settings
        duration_s = longest_s(context, self._offsets_m(context.grid), settings)
        return [TimelineEntry("probe", duration_s, duration_s if settings.sites == "all" else 0.0)]

    def run(self, shot: Shot) -> None:
        """Hold the atoms that the last image saw, or those of all sites."""
        seen = shot.occupancy
        if seen is None:
            raise ConfigError("probe needs an image before it in the shot")
        sites = np.ones_like(seen) if self.settings.sites == "all" else seen
        hold(shot, sites, self._offsets_m(shot.grid), self.settings)

    def _offsets_m(self, grid: SiteGrid) -> NDArray[np.float64]:
        offset_m = self.settings.offset
        if self.settings.pattern == "cross":
            return cross_offsets_m(grid.shape, offset_m)
        return np.broadcast_to(np.asarray(offset_m, np.float64), (*grid.shape, 2))


def hold(shot: Shot, sites: Occupancy, offsets_m: NDArray[np.float64], hold_settings: HoldSettings) -> None:
    """Pick up, hold and drop the atoms of some sites, each beside its site by an offset.

    Args:
        shot: The running shot.
        sites: bool (n_rows, n_cols); without any, nothing is played.
        offsets_m: float64 (n_rows, n_cols, 2), along a1 and a2.
        holding: How long.
    """
    if sites.any():
        start_s = shot.clock.now()
        times_s = hold_settings.hold, hold_settings.drop_off
        play(shot, lambda: hold_program(shot.grid, shot.motion, sites, offsets_m, *times_s), start_s)


def longest_s(context: StepContext, offsets_m: NDArray[np.float64], hold_settings: HoldSettings) -> float:
    """How long :func:`hold` takes if every site holds an atom.

    Raises:
        LimitError: The tone of a site leaves its band.
    """
    time_s = hold_time_s(context.grid, context.motion, offsets_m, hold_settings.hold, hold_settings.drop_off)
    return context.motion.overhead_per_cycle_s + time_s
