"""Settings of what drives the AODs of the mobile tweezers."""

from __future__ import annotations

from typing import Annotated, Final, TypeAlias

from pydantic import AfterValidator, Field

from labseq.config.settings import Fraction, Frequency, Length, Power, Settings, Voltage
from labseq.model import RfSpec
from labseq.model.motion import PhaseChoice
from labseq.units import format_quantity

_RF: Final = RfSpec()


def _rises(band: tuple[float, float]) -> tuple[float, float]:
    low, high = band
    if not 0 <= low < high:
        from_, to = (format_quantity(hz, "frequency") for hz in band)
        raise ValueError(f"the band goes from {from_} to {to}; expected [lowest, highest], both above 0 Hz")
    return band


Band: TypeAlias = Annotated[tuple[Frequency, Frequency], AfterValidator(_rises)]
Amplitudes: TypeAlias = tuple[Annotated[Fraction, Field(gt=0)], ...]


class RfSettings(Settings):
    """What drives the AODs of the mobile tweezers, and what they bear."""

    row_band: Band = Field(
        default=_RF.row_band_hz, description="[lowest, highest] frequency of the row axis' AOD"
    )
    column_band: Band = Field(
        default=_RF.column_band_hz, description="[lowest, highest] frequency of the column axis' AOD"
    )
    min_spacing: Annotated[Frequency, Field(ge=0)] = Field(
        default=_RF.min_spacing_hz, description="least distance of two tones of an axis"
    )
    row_amplitudes: Amplitudes = Field(
        default=_RF.row_amplitudes,
        description="amplitude of each row's tone, as a fraction of full scale; none: all equal, such that "
        "`max_row_tones` reach full scale together",
    )
    column_amplitudes: Amplitudes = Field(
        default=_RF.column_amplitudes,
        description="amplitude of each column's tone, as a fraction of full scale; none: all equal, such "
        "that `max_column_tones` reach full scale together",
    )
    phases: PhaseChoice = Field(
        default=_RF.phases,
        description="phases of the tones at pick-up: random, but always the same for a site, or chosen for "
        "each batch so that the tones' sum has a low crest",
    )
    phase_seed: int = Field(default=_RF.phase_seed, ge=0, description="seed of the random phases")
    full_scale: Annotated[Voltage, Field(gt=0)] = Field(
        default=_RF.full_scale_v, description="peak voltage of the output at full scale, across 50 Ohm"
    )
    max_peak: Annotated[Voltage, Field(gt=0)] = Field(
        default=_RF.max_peak_v, description="greatest peak voltage that the amplifiers bear"
    )
    amplifier_gain: float = Field(
        default=_RF.amplifier_gain_db, description="power gain between the output and each AOD, in dB"
    )
    max_mean_power: Annotated[Power, Field(gt=0)] = Field(
        default=_RF.max_mean_power_w, description="greatest mean RF power at each AOD"
    )
    snap_within: Annotated[Length, Field(ge=0)] = Field(
        default=_RF.snap_within_m,
        description="distance in the atom plane within which calibrated tones are moved to an equally "
        "spaced comb; 0: none is moved",
    )

    def spec(self) -> RfSpec:
        """The same for the core."""
        return RfSpec(
            row_band_hz=self.row_band,
            column_band_hz=self.column_band,
            min_spacing_hz=self.min_spacing,
            row_amplitudes=self.row_amplitudes,
            column_amplitudes=self.column_amplitudes,
            phases=self.phases,
            phase_seed=self.phase_seed,
            full_scale_v=self.full_scale,
            max_peak_v=self.max_peak,
            amplifier_gain_db=self.amplifier_gain,
            max_mean_power_w=self.max_mean_power,
            snap_within_m=self.snap_within,
        )
