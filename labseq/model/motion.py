"""Limits and settings of moves and of their tones."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.model.grid import read_only

SpeedProfile = Literal["constant", "minimum_jerk", "constant_jerk"]
PhaseChoice = Literal["random", "low_crest"]

LOAD_OHM = 50.0
"""Load of an output in ohms; full scale is the voltage across it."""


@dataclass(frozen=True, slots=True)
class RfSpec:
    """The RF chain of the two AODs of the mobile tweezers: bands, amplitudes, phases, limits.

    Random phases and amplitudes preassigned per tone are the paper's ("RF
    intermodulation"). All numbers are ours, because the paper is silent. Amplifiers of this kind
    die above 2 V at their input.

    Attributes:
        row_band_hz: Lowest and highest frequency of the row axis' AOD.
        column_band_hz: The same for the columns.
        min_spacing_hz: Least distance of two tones of an axis.
        row_amplitudes: Amplitude of each row's tone as a fraction of full scale;
            empty: all equal, such that the most tones of the axis reach full scale together.
        column_amplitudes: The same for each column.
        phases: "random": preassigned to each tone; "low_crest": chosen for each batch
            by Schroeder's rule, for a low crest factor.
        phase_seed: Seed of the preassigned phases.
        full_scale_v: Peak voltage of a sum of amplitudes of 1, across 50 Ohm.
        max_peak_v: Greatest peak voltage that the amplifiers bear.
        amplifier_gain_db: Power gain between the output and each AOD, in dB.
        max_mean_power_w: Greatest mean RF power at each AOD.
        snap_within_m: How far, in the atom plane, a calibrated tone may be from an
            equally spaced comb to be played on the comb; 0: none is moved.
    """

    row_band_hz: tuple[float, float] = (82e6, 118e6)
    column_band_hz: tuple[float, float] = (82e6, 118e6)
    min_spacing_hz: float = 0.5e6
    row_amplitudes: tuple[float, ...] = ()
    column_amplitudes: tuple[float, ...] = ()
    phases: PhaseChoice = "random"
    phase_seed: int = 20220711
    full_scale_v: float = 1.6
    max_peak_v: float = 2.0
    amplifier_gain_db: float = 20.0
    max_mean_power_w: float = 3.0
    snap_within_m: float = 20e-9

    def __post_init__(self) -> None:
        for name in ("row_band_hz", "column_band_hz", "row_amplitudes", "column_amplitudes"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        for low, high in (self.row_band_hz, self.column_band_hz):
            if not 0 <= low < high:
                raise ValueError(f"a band goes from {low} to {high} Hz; expected 0 <= lowest < highest")
        if any(not 0 < a <= 1 for a in (*self.row_amplitudes, *self.column_amplitudes)):
            raise ValueError("an amplitude is a fraction of full scale, above 0 and at most 1")
        if any(not value > 0 for value in (self.full_scale_v, self.max_peak_v, self.max_mean_power_w)):
            raise ValueError("voltages and powers must be above 0")
        if any(not value >= 0 for value in (self.min_spacing_hz, self.snap_within_m, self.phase_seed)):
            raise ValueError("minimum spacing, snapping distance and seed cannot be negative")
        if not math.isfinite(self.amplifier_gain_db):
            raise ValueError(f"the amplifier's gain is {self.amplifier_gain_db} dB; expected a number")

    @property
    def full_scale_power_w(self) -> float:
        """Mean power at an AOD of one tone at full scale, in watts."""
        return self.full_scale_v**2 / (2 * LOAD_OHM) * 10 ** (self.amplifier_gain_db / 10)


@dataclass(frozen=True, slots=True)
class LossSpec:
    """How probably atoms are lost, to predict what a plan does to an array.

    Attributes:
        move: Loss of an atom that is picked up, moved and dropped off: about the paper's filling after one
            cycle (derived).
        tone: Added to it for each tone on beyond one per axis.
        distance_per_m: Added to it per metre of the way.
        landing: Loss of an atom that stands where a tweezer without an atom is ramped down (ours: at the
            paper's depths 99.6 % or more in the simulation, however slowly the tweezer comes).
        passing: Loss of an atom that a tweezer passes at 1.944 um, as in a straight lane of the paper's
            lattice, and a factor e less for each further 0.15 um; the tweezer's own atom is then lost
            too (ours: simulated for the paper's depths and waists at 15 uK).
        spread: Spread of these losses from shot to shot: s.d. of the logarithm of a log-normal factor with
            mean 1, common to all atoms.
        image: Loss of an atom by one image (the paper's, 0.45 %), beyond that of the moves.
        lifetime_s: Lifetime of an atom in a static tweezer (paper).
    """

    move: float = 0.0188
    tone: float = 0.0
    distance_per_m: float = 0.0
    landing: float = 0.99
    passing: float = 0.0027
    spread: float = 0.5
    image: float = 0.0045
    lifetime_s: float = 33.0

    def __post_init__(self) -> None:
        if any(not 0 <= loss < 1 for loss in (self.move, self.tone, self.landing, self.passing, self.image)):
            raise ValueError("a loss is a probability from 0 to below 1")
        if not (0 <= self.distance_per_m < math.inf and 0 <= self.spread < math.inf):
            raise ValueError("the loss per metre and the spread of losses cannot be negative")
        if not self.lifetime_s > 0:
            raise ValueError(f"the lifetime is {self.lifetime_s} s; expected more than 0")


@dataclass(frozen=True, slots=True)
class MotionSpec:
    """Ramps, speed, overheads and limits of the mobile tweezers.

    Ramps and speed are the paper's ("Experimental Setup"). The overhead of a cycle is ours:
    the paper's cycle time of x1.8 over ten cycles leaves about 13 ms per later cycle
    beside the exposure.

    Attributes:
        pick_up_s: Pick-up ramp, in seconds.
        drop_off_s: Drop-off ramp, in seconds.
        speed_m_s: Transport speed, in m/s; its mean over the longest way of a batch.
        speed_profile: Course of the speed during a transport. At "constant" speed all
            atoms of a batch are equally fast, and those with a shorter way arrive earlier.
            With "minimum_jerk" and "constant_jerk" they start and arrive together.
        overhead_per_batch_s: Time that passes before each batch, tweezers off. Outputs that play
            samples need none; the virtual tweezers model with it a setup that does.
        overhead_per_cycle_s: Time that passes before the first batch of a cycle
            (planning, rendering, upload); not spent on an empty plan.
        max_tweezers: Most mobile tweezers on at once, whatever the planner's
            degree of parallelism.
        max_row_tones: Most tones on the row axis at once.
        max_column_tones: Most tones on the column axis at once.
        eject_slots: Sites beyond the grid that the AOD band reaches, each side.
        clearance_m: Least distance of a tweezer from standing atoms, and of neighbouring lines of
            tweezers from one another, in batches with paths of tones (ours). Half-way between two rows
            of the paper's lattice it is 1.944 um; how many atoms are lost there depends on their
            temperature.
        path_depth: Depth of the tweezers in batches with paths of tones, as a fraction of the full
            depth: shallower ones take fewer of the atoms that they pass.
        empty_tweezers_may_land: Whether a tweezer without an atom may end on a site that holds one.
        rf: What drives the AODs.
        losses: How probably atoms are lost.
    """

    pick_up_s: float = 60e-6
    drop_off_s: float = 60e-6
    speed_m_s: float = 0.130
    speed_profile: SpeedProfile = "constant"
    overhead_per_batch_s: float = 0.0
    overhead_per_cycle_s: float = 13e-3
    max_tweezers: int = 20
    max_row_tones: int = 20
    max_column_tones: int = 20
    eject_slots: int = 1
    clearance_m: float = 1.9e-6
    path_depth: float = 1.0
    empty_tweezers_may_land: bool = False
    rf: RfSpec = field(default_factory=RfSpec)
    losses: LossSpec = field(default_factory=LossSpec)

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
        if not 0 < self.clearance_m < math.inf:
            raise ValueError(f"the clearance is {self.clearance_m} m; expected more than 0")
        if not 0 < self.path_depth <= 1:
            raise ValueError(f"path_depth is {self.path_depth}; expected a fraction, more than 0")


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
