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
"""Load of an output in ohms; full scale is the voltage across it."""


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

    Random phases and amplitudes preassigned per tone are the paper's ("RF
    intermodulation"). All numbers are ours, because the paper is silent. Amplifiers of this kind
    die above 2 V at their input.
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
            description="amplitude of each row's tone, as a fraction of full scale; none: all equal, such "
            "that `max_row_tones` reach full scale together"
        ),
    ] = ()
    column_amplitudes: Annotated[
        Amplitudes,
        Field(
            description="amplitude of each column's tone, as a fraction of full scale; none: all equal, such "
            "that `max_column_tones` reach full scale together"
        ),
    ] = ()
    phases: Annotated[
        PhaseChoice,
        Field(
            description="phases of the tones at pick-up: random, but always the same for a site, or chosen "
            "for each batch so that the tones' sum has a low crest"  # by Schroeder's rule
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
            "spaced comb; 0: none is moved",
        ),
    ] = 20e-9

    @property
    def full_scale_power_w(self) -> float:
        """Mean power at an AOD of one tone at full scale, in watts."""
        return self.full_scale_v**2 / (2 * LOAD_OHM) * 10 ** (self.amplifier_gain_db / 10)


Loss: TypeAlias = Annotated[Fraction, Field(lt=1)]


@settings(frozen=True, slots=True, config=IN_SI)
class LossSpec:
    """How probably atoms are lost, to compare plans by what survives; nothing is lost because of it."""

    # About the paper's filling after one cycle (derived).
    move: Annotated[Loss, Field(description="loss of an atom that is picked up, moved and dropped off")] = (
        0.0188
    )
    tone: Annotated[Loss, Field(description="added to it for each tone on beyond one per axis")] = 0.0
    distance_per_m: Annotated[float, Field(ge=0, description="added to it per metre of the way")] = 0.0
    # Ours: at the paper's depths 99.6 % or more in the simulation, however slowly the tweezer comes.
    landing: Annotated[
        Loss,
        Field(description="loss of an atom that stands where a tweezer without an atom is ramped down"),
    ] = 0.99
    # Ours: simulated for the paper's depths and waists at 15 uK.
    passing: Annotated[
        Loss,
        Field(
            description="loss of an atom that a tweezer of full depth passes at 1.944 um, as in a straight "
            "lane of the paper's lattice; a factor e less for each further 0.12 um, and less in shallower "
            "tweezers, see `path_depth`; the tweezer's own atom is then lost too"
        ),
    ] = 0.0022
    spread: Annotated[
        float,
        Field(
            ge=0,
            le=5,
            description="spread of these losses from shot to shot: s.d. of the logarithm of a log-normal "
            "factor with mean 1",
        ),
    ] = 0.5
    # The paper's, 0.45 %.
    image: Annotated[Loss, Field(description="loss of an atom by one image, beyond that of the moves")] = (
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
    """How the mobile tweezers move, for every driver: ramps, speed, overheads and limits.

    Ramps and speed are the paper's ("Experimental Setup"). The overhead of a cycle is ours:
    the paper's cycle time of x1.8 over ten cycles leaves about 13 ms per later cycle
    beside the exposure; it is not spent on an empty plan.
    """

    pick_up_s: Annotated[Duration, Field(description="duration of the pick-up ramp, linear in depth")] = 60e-6
    drop_off_s: Annotated[Duration, Field(description="duration of the drop-off ramp, linear in depth")] = (
        60e-6
    )
    speed_m_s: Annotated[Speed, Field(description="transport speed")] = 0.130
    speed_profile: Annotated[
        SpeedProfile,
        Field(
            description="course of the speed during a transport; `speed` is the mean on the longest way of a "
            "batch, and with a course other than constant all atoms of a batch start and arrive together"
        ),
    ] = "constant"
    overhead_per_batch_s: Annotated[
        Duration,
        Field(
            description="time that passes before each batch, tweezers off; only of `use: virtual`, as a "
            "model of another setup"
        ),
    ] = 0.0
    overhead_per_cycle_s: Annotated[
        Duration,
        Field(
            description="time that passes before the first batch of a cycle; left out: what is typical of "
            "the driver and its mode, if it says so; a calibration of the kind `timing` takes precedence"
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
    # Half-way between two rows of the paper's lattice it is 1.944 um; how many atoms are lost there depends
    # on their temperature (ours).
    clearance_m: Annotated[
        Length,
        Field(
            gt=0,
            le=1e-3,
            description="least distance of a moving tweezer from atoms that stand, and of neighbouring lines "
            "of tweezers, where rows and columns move at once",
        ),
    ] = 1.9e-6
    path_depth: Annotated[
        Fraction,
        Field(
            gt=0,
            description="depth of the tweezers where rows and columns move at once, as a fraction of the "
            "full depth: shallower ones take fewer of the atoms that they pass",
        ),
    ] = 1.0
    empty_tweezers_may_land: Annotated[
        bool,
        Field(
            description="whether a tweezer without an atom may end on a site that holds one, where rows and "
            "columns move at once"
        ),
    ] = False
    rf: Annotated[RfSpec, empty_is({}), Field(description="the RF drive of the AODs, and its limits")] = (
        RfSpec()
    )
    losses: Annotated[
        LossSpec, empty_is({}), Field(description="losses of atoms that plans are compared by")
    ] = LossSpec()


@dataclass(frozen=True, slots=True, eq=False)
class RfSamples:
    """Samples that an output played without interruption.

    Attributes:
        start_s: When the first sample was at the output, on the session's clock.
        sample_rate_hz: Samples per second.
        samples: int16 (n,).
        volts_per_step: Volts into 50 Ohm that a sample of 1 stands for.
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
    """Tones that an output generated itself, without interruption.

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
"""A part of an output; between two of them it is silent."""
