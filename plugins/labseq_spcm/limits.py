"""What the card can do, and what is refused because it cannot.

Source of the figures, where no other is named: Spectrum's manual "M4i.66xx/M4i.96xx", chapters on
analog outputs, clock, generation modes, trigger and DDS20.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import AxisTones, LimitError, RfSpec, ToneProgram, format_quantity

FAMILY: Final = 0x66
"""Second byte of the card type: M4i.66xx."""
FAMILY_NAME: Final = "a Spectrum M4i.66xx with two outputs, such as the M4i.6631-x8"

SAMPLE_RATE_HZ: Final = (50e6, 1.25e9)
RATE_GAPS_HZ: Final = ((750e6, 757e6), (1125e6, 1145e6))
"""Sample rates that the clock cannot make."""
RATE_STEP_HZ: Final = 8
REFERENCE_HZ: Final = (10e6, 1.25e9)
FIFO_RATE_HZ: Final = 700e6
"""2.8 GB/s over PCIe x8 Gen 2 (the vendor's page on generator modes), for two channels of 2 bytes."""

AMPLITUDE_MV: Final = (80, 2000)
"""Peak voltage into 50 Ohm of an M4i.663x, in steps of 1 mV."""
RELAY_MV: Final = (420, 480)
"""Either path of the amplifier makes these amplitudes; which one it is depends on the past."""
RELAY_S: Final = 10e-3
"""How long the output is off when the path changes."""

SAMPLE_STEP: Final = 32
"""Memory sizes are multiples of this, in samples per channel."""
TRIGGER_CLOCKS: Final = 476.5
"""From the trigger to the output, in sample clocks above 625 MS/s; 238.5 below."""
TRIGGER_S: Final = 16e-9
"""And this on top."""

TRIGGER_STEP_MV: Final = 10
"""The level of Ext0 is rounded to this."""

DDS_RATE_HZ: Final = 1.25e9
"""The DDS runs at the full sample rate."""
DDS_FREQUENCY_SLOPE: Final = 1.9e14
"""Steepest, in Hz/s; as read from an M4i.9622 (ColdMatter/EDMSuite)."""
DDS_AMPLITUDE_SLOPE: Final = 3.05e5
"""Steepest, in 1/s; likewise."""
DDS_DELAY_S: Final = 560e-9
"""From the trigger to the output; likewise."""

ROUNDING: Final = 1e-9
"""How far a sum of amplitudes may exceed its limit by rounding."""


def trigger_delay_s(sample_rate_hz: float) -> float:
    """From the trigger to the first sample, at most, in seconds."""
    return TRIGGER_CLOCKS / sample_rate_hz + TRIGGER_S


def amplitude_mv(name: str, rf: RfSpec) -> int:
    """The amplitude that makes full scale the profile's ``rf.full_scale``, in millivolts.

    Raises:
        LimitError: The card cannot make it, its relay might switch, or the amplifiers do not bear it.
    """
    what, wanted_mv = f"{name}: rf.full_scale", round(1e3 * rf.full_scale_v)
    value = format_quantity(rf.full_scale_v, "voltage")
    low, high = AMPLITUDE_MV
    if not low <= wanted_mv <= high:
        raise LimitError(what, value, f"the card's {low} mV to {high} mV")
    if RELAY_MV[0] <= wanted_mv <= RELAY_MV[1]:
        gap = f"below {RELAY_MV[0]} mV or above {RELAY_MV[1]} mV"
        raise LimitError(what, value, gap, "between them the card's output relay may switch, for 10 ms")
    if rf.full_scale_v > rf.max_peak_v:
        most = format_quantity(rf.max_peak_v, "voltage")
        raise LimitError(what, value, f"rf.max_peak, {most}", "the amplifiers bear no more")
    return wanted_mv


def check_rate(name: str, sample_rate_hz: float, rf: RfSpec) -> None:
    """Refuse a sample rate at which tones in the AODs' bands would come out mirrored.

    Raises:
        LimitError: It is not above twice the highest frequency.
    """
    max_hz = max(*rf.row_band_hz, *rf.column_band_hz)
    if sample_rate_hz <= 2 * max_hz:
        rate, highest = (format_quantity(hz, "frequency") for hz in (sample_rate_hz, max_hz))
        least = format_quantity(2 * max_hz, "frequency")
        raise LimitError(
            f"{name}: sample_rate", rate, f"above {least}, twice the end of the AODs' band, {highest}"
        )


def refuse_excess(name: str, program: ToneProgram, rf: RfSpec) -> None:
    """Refuse what must not come to the output, whatever made the program.

    Args:
        name: Name of the device, for the message.
        program: What shall be played.
        rf: Bands of the AODs.

    Raises:
        LimitError: The program has no length, leaves an AOD's band, clips, or has values that
            are no numbers.
    """
    durations = program.duration_s
    if not (np.isfinite(durations).all() and (durations >= 0).all()):
        raise LimitError(f"{name}: a segment's duration", "negative or not finite", "0 s or more")
    if not program.total_duration_s > 0:
        raise LimitError(f"{name}: length of the program", "0 s", "more than 0 s")
    _refuse_axis(f"{name}: {{}} of a row tone", program.row, program, rf.row_band_hz)
    _refuse_axis(f"{name}: {{}} of a column tone", program.column, program, rf.column_band_hz)


def _refuse_axis(what: str, axis: AxisTones, program: ToneProgram, band_hz: tuple[float, float]) -> None:
    low, high = band_hz
    band = f"the AOD's band, {low / 1e6:g} to {high / 1e6:g} MHz"
    for values in (axis.start_hz, axis.end_hz):
        _refuse(what.format("frequency"), values, axis, program, low, high, band)
    _refuse(
        what.format("phase"), axis.phase_rad, axis, program, -np.inf, np.inf, "a finite number of radians"
    )
    for values in (axis.start_amplitude, axis.end_amplitude):
        limit = "0 to 1 of full scale"
        _refuse(what.format("amplitude"), values, axis, program, 0.0, 1.0 + ROUNDING, limit)
        sums = np.diff(np.concatenate([[0.0], np.cumsum(values)])[axis.offsets])
        if len(sums) and sums.max() > 1.0 + ROUNDING:
            worst = int(sums.argmax())
            where = f"{what.format('sum of the amplitudes')}s in batch {program.batch[worst]}"
            raise LimitError(where, f"{sums[worst]:.9g} of full scale", "1: the output would clip")


def _refuse(
    what: str,
    values: NDArray[np.float64],
    axis: AxisTones,
    program: ToneProgram,
    low: float,
    high: float,
    limit: str,
) -> None:
    fine = np.isfinite(values) & (values >= low) & (values <= high)
    if not fine.all():
        tone = int(fine.argmin())
        segment = int(np.searchsorted(axis.offsets, tone, "right")) - 1
        raise LimitError(f"{what} in batch {program.batch[segment]}", f"{values[tone]:.9g}", limit)
