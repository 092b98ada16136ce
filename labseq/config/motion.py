"""How a profile says that the mobile tweezers move."""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

from pydantic import Field

from labseq.config.fields import Choice, empty_is
from labseq.config.rf import RfSettings
from labseq.config.settings import Duration, Settings, Speed
from labseq.model import MotionSpec
from labseq.model.motion import SpeedProfile

_MOTION: Final = MotionSpec()

Sites: TypeAlias = Annotated[int, Field(ge=1, le=1000)]
"""A number of sites, tweezers or tones."""


class MotionSettings(Settings):
    """How the mobile tweezers move, whatever their driver."""

    pick_up: Duration = Field(default=_MOTION.pick_up_s, description="duration of the pick-up ramp")
    drop_off: Duration = Field(default=_MOTION.drop_off_s, description="duration of the drop-off ramp")
    speed: Speed = Field(default=_MOTION.speed_m_s, description="transport speed")
    speed_profile: SpeedProfile = Field(
        default=_MOTION.speed_profile,
        description="course of the speed during a transport; `speed` is the mean on the longest way of a "
        "batch, and with a course other than constant all atoms of a batch start and arrive together",
    )
    overhead_per_batch: Duration = Field(
        default=_MOTION.overhead_per_batch_s, description="time that passes before each batch, tweezers off"
    )
    overhead_per_cycle: Duration = Field(
        default=_MOTION.overhead_per_cycle_s, description="time that passes before the first batch of a cycle"
    )
    max_tweezers: Sites = Field(default=_MOTION.max_tweezers, description="most mobile tweezers on at once")
    max_row_tones: Sites = Field(
        default=_MOTION.max_row_tones, description="most tones on the row axis at once"
    )
    max_column_tones: Sites = Field(
        default=_MOTION.max_column_tones, description="most tones on the column axis at once"
    )
    eject_slots: int = Field(
        default=_MOTION.eject_slots,
        ge=0,
        le=100,
        description="how many sites beyond the grid the tones reach, on each side",
    )
    rf: Annotated[RfSettings, empty_is({})] = Field(
        default=RfSettings(), description="what drives the AODs, and what they bear"
    )

    def spec(self) -> MotionSpec:
        """The same for the core."""
        return MotionSpec(
            pick_up_s=self.pick_up,
            drop_off_s=self.drop_off,
            speed_m_s=self.speed,
            speed_profile=self.speed_profile,
            overhead_per_batch_s=self.overhead_per_batch,
            overhead_per_cycle_s=self.overhead_per_cycle,
            max_tweezers=self.max_tweezers,
            max_row_tones=self.max_row_tones,
            max_column_tones=self.max_column_tones,
            eject_slots=self.eject_slots,
            rf=self.rf.spec(),
        )


MOTION_KEYS: Final = tuple(MotionSettings.model_fields)
"""Keys of ``mobile_tweezers`` that belong to the core, not to the plugin."""


class MobileTweezersChoice(MotionSettings, Choice):
    """The plugin of the mobile tweezers, and how they move."""
