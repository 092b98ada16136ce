"""How the mobile tweezers move, and what they can do at most."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SpeedProfile = Literal["constant", "minimum_jerk", "constant_jerk"]


@dataclass(frozen=True, slots=True)
class MotionSpec:
    """Ramps, speed, overheads and limits of the mobile tweezers.

    Ramps and speed are the paper's ("Experimental Setup"). The overheads are
    ours: the paper's windows (60-200 ms) imply about 1 ms per batch at its
    slowest, and its cycle time of x1.8 over ten cycles leaves about 13 ms per
    later cycle beside the exposure.

    Attributes:
        pick_up_s: Pick-up ramp, in seconds.
        drop_off_s: Drop-off ramp, in seconds.
        speed_m_s: Transport speed, in m/s.
        speed_profile: Course of the speed during a transport.
        overhead_per_batch_s: Time that passes before each batch, tweezers off.
        overhead_per_cycle_s: Time that passes before the first batch of a cycle
            (planning, rendering, upload); not spent on an empty plan.
        max_tweezers: Most mobile tweezers on at once, whatever the planner's
            degree of parallelism.
        max_row_tones: Most tones on the row axis at once.
        max_column_tones: Most tones on the column axis at once.
        eject_slots: Sites beyond the grid that the AOD band reaches, each side.
    """

    pick_up_s: float = 60e-6
    drop_off_s: float = 60e-6
    speed_m_s: float = 0.130
    speed_profile: SpeedProfile = "constant"
    overhead_per_batch_s: float = 0.5e-3
    overhead_per_cycle_s: float = 13e-3
    max_tweezers: int = 20
    max_row_tones: int = 20
    max_column_tones: int = 20
    eject_slots: int = 1

    def __post_init__(self) -> None:
        if not self.speed_m_s > 0:
            raise ValueError(f"the transport speed is {self.speed_m_s} m/s; expected more than 0")
        times = (self.pick_up_s, self.drop_off_s, self.overhead_per_batch_s, self.overhead_per_cycle_s)
        if any(not t >= 0 for t in times):
            raise ValueError("ramps and overheads cannot be negative")
        if min(self.max_tweezers, self.max_row_tones, self.max_column_tones) < 1:
            raise ValueError("at least one tweezer and one tone per axis are needed")
        if self.eject_slots < 0:
            raise ValueError("eject_slots cannot be negative")
