"""Figures of the card, and the checks of the set-up against them (for memory see ``replay_fifo.py``).

Source of the figures, where no other is named: Spectrum's manual "M4i.66xx/M4i.96xx", chapters on
analog outputs, clock, generation modes and trigger.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from labseq.plugin import LimitError, SiteGrid, format_quantity
from labseq.plugin.motion import RfSpec
from labseq.plugin.rendering import comb_sample_rate

if TYPE_CHECKING:
    from labseq_spcm.models import Model

RATE_GAPS_HZ: Final = ((750e6, 757e6), (1125e6, 1145e6))
"""Sample rates that the clock cannot make."""
RATE_STEP_HZ: Final = 8
"""Steps of the sample rate with the card's own clock."""
REFERENCE_TOLERANCE: Final = 1e-3
"""Allowed relative difference of the rate with an external reference, for which the manual gives no steps
(ours). The samples are made for the rate that the card reads."""
REFERENCE_HZ: Final = (10e6, 1.25e9)
FRAME_BYTES: Final = 4
"""Bytes of one sample of both outputs."""
OUTPUT_FIFO_BYTES: Final = 192 * 1024
"""Fixed size of the FIFO between the on-board memory and the outputs (manual, "Output latency")."""

RELAY_S: Final = 10e-3
"""Time that the output is off when the path changes. The manual gives none for the output's own relay."""

SAMPLE_STEP: Final = 32
"""Memory sizes are multiples of this, in samples per channel."""
TRIGGER_STEP_MV: Final = 10
"""The card rounds the level of Ext0 to this."""


def trigger_delay_s(sample_rate_hz: float) -> float:
    """Delay from the trigger to the first sample, 476.5 clocks above 625 MS/s, else 238.5, and 16 ns."""
    return (476.5 if sample_rate_hz > 625e6 else 238.5) / sample_rate_hz + 16e-9


def full_scale_mv(name: str, rf: RfSpec, model: Model) -> int:
    """The output amplitude for the profile's ``rf.full_scale``, in millivolts.

    Args:
        name: Name of the device, for messages.
        rf: The profile's section.
        model: What the card can do.

    Raises:
        LimitError: The card cannot make it, its relay might switch, or it is too much for the amplifiers.
    """
    setting, amplitude_mv = f"{name}: rf.full_scale", round(1e3 * rf.full_scale_v)
    value = format_quantity(rf.full_scale_v, "voltage")
    low, high = model.amplitude_mv
    if not low <= amplitude_mv <= high:
        raise LimitError(setting, value, f"the {model.name}'s {low} mV to {high} mV")
    relay_mv = model.relay_mv
    if relay_mv is not None and relay_mv[0] <= amplitude_mv <= relay_mv[1]:
        gap = f"below {relay_mv[0]} mV or above {relay_mv[1]} mV"
        why = "between them the card's output relay may switch, for 10 ms (for a card with -hbw set `model`)"
        raise LimitError(setting, value, gap, why)
    if rf.full_scale_v > rf.max_peak_v:
        most = format_quantity(rf.max_peak_v, "voltage")
        raise LimitError(setting, value, f"rf.max_peak, {most}", "more damages the amplifiers")
    return amplitude_mv


def reference_warnings(name: str, rate_hz: float, reference_hz: float | None, grid: SiteGrid) -> list[str]:
    """Warn if a sample rate is not a whole multiple of the reference clock, as the manual asks."""
    if reference_hz is None or rate_hz % reference_hz == 0:
        return []
    below = math.floor(rate_hz / reference_hz)
    near = [n * reference_hz for n in (below, below + 1)]
    spacings = [
        abs(float(hz[1] - hz[0])) for hz in (grid.row_frequency_hz, grid.column_frequency_hz) if len(hz) > 1
    ]
    most = math.floor(1.1 * rate_hz / reference_hz)
    multiples = [n * reference_hz for n in range(math.ceil(0.9 * rate_hz / reference_hz), most + 1)]
    combs = [hz for hz in multiples if all(abs(hz / s - round(hz / s)) < 1e-6 for s in spacings)]
    best = min(combs or near, key=lambda hz: abs(hz - rate_hz))
    rate, reference, low, high, good = (
        format_quantity(hz, "frequency") for hz in (rate_hz, reference_hz, *near, best)
    )
    what = f"profile.{name}.sample_rate is {rate}, not a whole multiple of reference_clock, {reference}"
    why = "the PLL may be unable to make it, and its phase may differ from start to start"
    renders = ", which also has a whole number of samples per tone spacing" if combs else ""
    return [f"{what}, so {why} (nearest multiples: {low}, {high}); set sample_rate: {good}{renders}"]


def check_sample_rate(name: str, sample_rate_hz: float, rf: RfSpec) -> None:
    """Refuse a sample rate at which tones in the AODs' bands would be aliased.

    Raises:
        LimitError: It is not above twice the highest frequency.
    """
    max_hz = max(*rf.row_band_hz, *rf.column_band_hz)
    if sample_rate_hz <= 2 * max_hz:
        rate, highest, least = (format_quantity(f, "frequency") for f in (sample_rate_hz, max_hz, 2 * max_hz))
        limit = f"above {least}, twice the end of the AODs' band, {highest}"
        raise LimitError(f"{name}: sample_rate", rate, limit)


LONG_COMB: Final = 1024
"""Samples. Rates whose comb repeats later are rendered up to three times as slowly, with 19 moving tones on
one core in 0.29 of the playing time at 624 MHz (390 samples), 0.39 at 500 MHz (625), 0.93 at 625 MHz (3125).
"""


def rendering_warnings(name: str, sample_rate_hz: float, grid: SiteGrid) -> list[str]:
    """Warn of a rate at which the tones of the sites make no short comb, if another rate does better."""
    axes = [hz for hz in (grid.row_frequency_hz, grid.column_frequency_hz) if len(hz) > 1]
    ratios = [Fraction(abs(float(hz[1] - hz[0])) / sample_rate_hz).limit_denominator(4096) for hz in axes]
    if all(ratio.denominator <= LONG_COMB for ratio in ratios):
        return []
    try:
        best_hz = comb_sample_rate(grid, sample_rate_hz)
    except LimitError:
        return []
    rate, best = (f"{hz / 1e6:.9g} MHz" for hz in (sample_rate_hz, best_hz))
    what = f"profile.{name}.sample_rate is {rate}; its samples take up to three times as long to render"
    return [f"{what} as those at {best}, a whole number per tone spacing; set sample_rate: {best}"]
