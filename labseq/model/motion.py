"""Limits and settings of moves and of their tones."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass as settings

from labseq.model.grid import read_only
from labseq.settings import (
    IN_SI,
    Duration,
    Fraction,
    Frequency,
    Length,
    PositiveDuration,
    Power,
    Speed,
    Voltage,
    empty_is,
)
from labseq.units import format_quantity

SpeedProfile = Literal["constant", "minimum_jerk", "constant_jerk"]
PhaseChoice = Literal["random", "low_crest"]

LOAD_OHM = 50.0
"""Load of an output, in ohms. Full scale is the voltage across it."""


def _rises(band: tuple[float, float]) -> tuple[float, float]:
    low, high = band
    if not 0 <= low < high:
        from_, to = (format_quantity(hz, "frequency") for hz in band)
        raise ValueError(f"the band goes from {from_} to {to}; expected [lowest, highest], both above 0 Hz")
    return band


Band: TypeAlias = Annotated[tuple[Frequency, Frequency], AfterValidator(_rises)]
Amplitudes: TypeAlias = tuple[Annotated[Fraction, Field(gt=0)], ...]


@settings(frozen=True, slots=True, config=IN_SI)
class RfSpec:
    """The RF drive of the mobile tweezers' AODs, and its limits.

    Random phases and preassigned amplitudes for each tone are as in the paper ("RF intermodulation"). The
    paper states no numbers, so all of them are ours. More than 2 V at the input destroys amplifiers of this
    kind.
    """

    row_band_hz: Annotated[Band, Field(description="[lowest, highest] frequency of the row axis' AOD")] = (
        82e6,
        118e6,
    )
    column_band_hz: Annotated[
        Band, Field(description="[lowest, highest] frequency of the column axis' AOD")
    ] = (82e6, 118e6)
    min_spacing_hz: Annotated[
        Frequency, Field(ge=0, description="smallest distance of two tones of an axis")
    ] = 0.5e6
    row_amplitudes: Annotated[
        Amplitudes,
        Field(
            description="amplitude of each row's tone, as a fraction of full scale. By default all are "
            "equal, and `max_row_tones` of them reach full scale together"
        ),
    ] = ()
    column_amplitudes: Annotated[
        Amplitudes,
        Field(
            description="amplitude of each column's tone, as a fraction of full scale. By default all are "
            "equal, and `max_column_tones` of them reach full scale together"
        ),
    ] = ()
    phases: Annotated[
        PhaseChoice,
        Field(
            description="phases of the tones at pick-up: random but fixed for each site, or chosen "
            "for each batch so that the sum of the tones has a low crest"  # by Schroeder's rule
        ),
    ] = "random"
    phase_seed: Annotated[int, Field(ge=0, description="seed of the random phases")] = 20220711
    full_scale_v: Annotated[
        Voltage, Field(gt=0, description="peak voltage of the output at full scale, across 50 Ohm")
    ] = 1.6
    max_peak_v: Annotated[
        Voltage, Field(gt=0, description="largest peak voltage that the amplifiers tolerate")
    ] = 2.0
    amplifier_gain_db: Annotated[
        float, Field(description="power gain between the output and each AOD, in dB")
    ] = 20.0
    max_mean_power_w: Annotated[Power, Field(gt=0, description="largest mean RF power at each AOD")] = 3.0
    snap_within_m: Annotated[
        Length,
        Field(
            ge=0,
            description="distance in the atom plane within which calibrated tones are moved to an equally "
            "spaced comb. 0 moves no tone",
        ),
    ] = 20e-9

    @property
    def full_scale_power_w(self) -> float:
        """Mean power at an AOD of one tone at full scale, in watts."""
        return self.full_scale_v**2 / (2 * LOAD_OHM) * 10 ** (self.amplifier_gain_db / 10)


Loss: TypeAlias = Annotated[Fraction, Field(lt=1)]


@settings(frozen=True, slots=True, config=IN_SI)
class LossSpec:
    """Loss probabilities of atoms, by which plans are compared. They cause no losses themselves."""

    # About the paper's filling after one cycle (derived).
    move: Annotated[Loss, Field(description="loss of an atom that is picked up, moved and dropped off")] = (
        0.0188
    )
    tone: Annotated[Loss, Field(description="further loss for each tone beyond one per axis")] = 0.0
    distance_per_m: Annotated[float, Field(ge=0, description="further loss per metre of the path")] = 0.0
    # Ours. At the paper's depths it is 99.6 % or more in the simulation, however slow the tweezer is.
    landing: Annotated[
        Loss,
        Field(description="loss of an atom on a site where a tweezer without an atom is ramped down"),
    ] = 0.99
    # Ours, simulated for the paper's depths and waists at 15 uK.
    passing: Annotated[
        Loss,
        Field(
            description="loss of an atom that a tweezer of full depth passes at 1.944 um, as in a straight "
            "lane of the paper's lattice. The loss falls by a factor e for each further 0.12 um, and in "
            "shallower tweezers (see `path_depth`). With the atom, the tweezer's own atom is lost too"
        ),
    ] = 0.0022
    spread: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            description="spread of these losses from shot to shot, as the standard deviation of the "
            "logarithm of a log-normal factor with mean 1",
        ),
    ] = 0.5
    # The paper's, 0.45 %.
    image: Annotated[Loss, Field(description="loss of an atom by one image, in addition to the moves")] = (
        0.0045
    )
    # The paper's.
    lifetime_s: Annotated[PositiveDuration, Field(description="lifetime of an atom in a static tweezer")] = (
        33.0
    )


Sites: TypeAlias = Annotated[int, Field(ge=1, le=1000)]
"""A number of sites, tweezers or tones."""


@settings(frozen=True, slots=True, config=IN_SI)
class MotionSpec:
    """Motion of the mobile tweezers for every driver: ramps, speed, overheads and limits.

    Ramps and speed are the paper's ("Experimental Setup"). The overhead of a cycle is our estimate. The
    paper's cycle time of x1.8 over ten cycles leaves about 13 ms per later cycle in addition to the exposure.
    An empty plan has no overhead.
    """

    pick_up_s: Annotated[Duration, Field(description="duration of the pick-up ramp, linear in depth")] = 60e-6
    drop_off_s: Annotated[Duration, Field(description="duration of the drop-off ramp, linear in depth")] = (
        60e-6
    )
    speed_m_s: Annotated[Speed, Field(description="transport speed")] = 0.130
    speed_profile: Annotated[
        SpeedProfile,
        Field(
            description="speed over time during a transport. `speed` is the mean on the longest path of a "
            "batch. Unless the speed is constant, all atoms of a batch start and arrive together"
        ),
    ] = "constant"
    overhead_per_batch_s: Annotated[
        Duration,
        Field(
            description="time before each batch with the tweezers off, only for `use: virtual` as a "
            "model of another setup"
        ),
    ] = 0.0
    overhead_per_cycle_s: Annotated[
        Duration,
        Field(
            description="time before the first batch of a cycle. The default is the typical value of the "
            "driver and its mode, if known. A calibration of the kind `timing` takes precedence"
        ),
    ] = 13e-3
    max_tweezers: Annotated[Sites, Field(description="largest number of mobile tweezers on at once")] = 20
    max_row_tones: Annotated[Sites, Field(description="largest number of tones on the row axis at once")] = 20
    max_column_tones: Annotated[
        Sites, Field(description="largest number of tones on the column axis at once")
    ] = 20
    eject_slots: Annotated[
        int,
        Field(ge=0, le=100, description="how many sites beyond the grid the tones reach, on each side"),
    ] = 1
    # Half-way between two rows of the paper's lattice the distance is 1.944 um. The losses there depend on
    # the atoms' temperature (ours).
    clearance_m: Annotated[
        Length,
        Field(
            gt=0,
            le=1e-3,
            description="least distance of a moving tweezer from resting atoms, and between neighbouring "
            "lines of tweezers, if rows and columns move at once",
        ),
    ] = 1.9e-6
    path_depth: Annotated[
        Fraction,
        Field(
            gt=0,
            description="depth of the tweezers if rows and columns move at once, as a fraction of the "
            "full depth. Shallower tweezers remove fewer of the atoms that they pass",
        ),
    ] = 1.0
    empty_tweezers_may_land: Annotated[
        bool,
        Field(
            description="whether a tweezer without an atom may end on a site with an atom, if rows and "
            "columns move at once"
        ),
    ] = False
    rf: Annotated[RfSpec, empty_is({}), Field(description="the RF drive of the AODs, and its limits")] = (
        RfSpec()
    )
    losses: Annotated[
        LossSpec, empty_is({}), Field(description="losses of atoms, by which plans are compared")
    ] = LossSpec()


@dataclass(frozen=True, slots=True, eq=False)
class RfSamples:
    """Samples that an output played without a gap.

    Attributes:
        start_s: When the first sample was at the output, on the session's clock.
        sample_rate_hz: Samples per second.
        samples: int16 (n,).
        volts_per_step: Voltage into 50 Ohm of a sample of 1.
    """

    start_s: float
    sample_rate_hz: float
    samples: NDArray[np.int16]
    volts_per_step: float

    @property
    def end_s(self) -> float:
        """End of the last sample."""
        return self.start_s + len(self.samples) / self.sample_rate_hz


@dataclass(frozen=True, slots=True, eq=False)
class RfTones:
    """Tones that an output generated itself, without a gap.

    At the time t after the start, tone i is
    ``(amplitude_v + amplitude_slope t) cos(phase_rad + 2 pi (frequency_hz t + frequency_slope t^2 / 2))``.

    Attributes:
        start_s: When they began, on the session's clock.
        end_s: When they ended.
        frequency_hz: float64 (n,), at the start.
        frequency_slope: float64 (n,), in Hz/s.
        amplitude_v: float64 (n,), peak volts into 50 Ohm at the start.
        amplitude_slope: float64 (n,), in V/s.
        phase_rad: float64 (n,), at the start.
    """

    start_s: float
    end_s: float
    frequency_hz: NDArray[np.float64]
    frequency_slope: NDArray[np.float64]
    amplitude_v: NDArray[np.float64]
    amplitude_slope: NDArray[np.float64]
    phase_rad: NDArray[np.float64]

    def __post_init__(self) -> None:
        n_tones = len(self.frequency_hz)
        for item in fields(self)[2:]:
            values = read_only(getattr(self, item.name), np.float64, (n_tones,), item.name)
            object.__setattr__(self, item.name, values)


RfSpan: TypeAlias = RfSamples | RfTones
"""A part of an output without a gap. The output is silent between parts."""
