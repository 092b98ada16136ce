"""What is known of the card: limits, granularities, times.

Source, where no other is named: Spectrum's manual "M4i.66xx/M4i.96xx", chapters on analog
outputs, generation modes, trigger, sequence mode and DDS20; for the DDS steps and for
manners that the manual does not tell, what ColdMatter (EDMSuite, ``HANDOFF.md``) measured
on an M4i.9622-x8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class CardModel:
    """One model of the M4i.66xx family with two channels.

    Attributes:
        name: Product name.
        card_type: What the register SPC_PCITYP holds.
        memory_samples: On-board memory in samples of 16 bit, shared by the active channels.
        sample_rate_hz: Lowest and highest sample rate.
        rate_gaps_hz: Sample rates that the clock cannot make: pairs (from, to).
        rate_step_hz: Granularity of the sample rate.
        amplitude_mv: Smallest and largest amplitude into 50 Ohm, in millivolts.
        low_path_mv: The hysteresis between the amplifier's two paths: above the second the
            low path is left, below the first the high one.
        relay_s: How long the output is off when the path changes.
        bus_bytes_per_s: Transfer from the PC; PCIe x8 Gen 2.
        n_dds_cores: DDS cores on the chip; that a 6631 has 23 is not measured.
        temperature_c: What its sensors read, in degrees Celsius (ours).
        dds_queue: Commands that the DDS queue holds (an M4i.9622 reads 4098).
    """

    name: str = "M4i.6631-x8"
    card_type: int = 0x76631
    memory_samples: int = 2 * 1024**3
    sample_rate_hz: tuple[float, float] = (50e6, 1.25e9)
    rate_gaps_hz: tuple[tuple[float, float], ...] = ((750e6, 757e6), (1125e6, 1145e6))
    rate_step_hz: int = 8
    amplitude_mv: tuple[int, int] = (80, 2000)
    low_path_mv: tuple[int, int] = (420, 480)
    relay_s: float = 10e-3
    bus_bytes_per_s: float = 2.8e9
    n_dds_cores: int = 23
    temperature_c: int = 45
    dds_queue: int = 4096


M4I6631: Final = CardModel()

MEMORY_STEP: Final = 32
"""Step and minimum of the memory size, in samples per channel."""
SEGMENT_MIN: Final = 384
"""Shortest segment of the sequence mode with one channel, in samples; half of it with two."""
MAX_SEGMENTS: Final = 65536
MAX_STEPS: Final = 4096
MAX_LOOPS: Final = 2**32 - 1

FAST_CLOCK_HZ: Final = 625e6
"""Above this sample rate the trigger's way to the output takes twice as many clocks."""


def trigger_delay_s(sample_rate_hz: float) -> float:
    """From the trigger to the first sample: 476.5 clocks above 625 MS/s, else 238.5, and 16 ns."""
    clocks = 476.5 if sample_rate_hz > FAST_CLOCK_HZ else 238.5
    return clocks / sample_rate_hz + 16e-9


DDS_RATE_HZ: Final = 1.25e9
"""The DDS runs at the full sample rate."""
DDS_TIMER_STEP_S: Final = 6.4e-9
DDS_TIMER_S: Final = (83.2e-9, 27.487790730)
DDS_FREQUENCY_STEP_HZ: Final = DDS_RATE_HZ / 2**32
DDS_AMPLITUDE_STEP: Final = 1 / 32767
DDS_PHASE_STEP_DEG: Final = 360 / 4096
DDS_FREQUENCY_SLOPE_STEP: Final = 2775.5575615628914
"""In Hz/s, with a ramp step size of 1."""
DDS_FREQUENCY_SLOPE_MAX: Final = 1.90734863280903e14
DDS_AMPLITUDE_SLOPE_STEP: Final = 298.03231910153505
"""In 1/s, with a ramp step size of 1."""
DDS_AMPLITUDE_SLOPE_MAX: Final = 305174.6170612535
DDS_TRIGGER_DELAY_S: Final = 560e-9
"""From a trigger to the change of the output."""
DDS_RETRIGGER_S: Final = 72e-9
"""Least time between two triggers."""
DDS_SINGLE_PER_S: Final = 400e3
"""Commands per second that reach the card one by one; the caller is kept waiting meanwhile."""
DDS_DMA_PER_S: Final = 10e6
"""Commands per second that reach the card by DMA, in the background."""
DDS_DMA_LATENCY_S: Final = 20e-6
"""What a block takes at least by DMA."""
DDS_DMA_QUEUE: Final = 512 * 1024**2
"""Commands that the on-board memory queues in DMA mode."""
