"""What a card can be tested for with its outputs off."""

from __future__ import annotations

from typing import Final

from labseq.plugin import DeviceError, format_quantity
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.settings import SpcmSettings

HOT_C: Final = 80
"""Highest temperature of a card that is well, in degrees Celsius (ours; the driver has limits of its own)."""
UPLOAD: Final = 1 << 16
"""Samples of both outputs, all 0, that are sent to the card's memory."""


def check_card(card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
    """See whether the card is cool, its clock is as it was set, and its memory takes samples.

    Samples are sent in the mode ``replay`` only: the others have no use for the whole memory.

    Args:
        card: The open card; it does not play.
        settings: The driver's settings.
        sample_rate_hz: What the clock was set to.

    Raises:
        DeviceError: Something is wrong, or the card does not answer.
    """
    spcm = card.spcm
    sensors = (("base card", spcm.SPC_MON_TC_BASE_CTRL), ("output module", spcm.SPC_MON_TC_MODULE_0))
    for place, register in sensors:
        temperature_c = card.read(register)
        if temperature_c > HOT_C:
            text = f"the {place} has {temperature_c} degrees Celsius; expected at most {HOT_C}"
            raise DeviceError(card.name, f"{text}: look at the fans")
    rate_hz = card.read(spcm.SPC_SAMPLERATE)
    if rate_hz != sample_rate_hz:
        found, expected = (format_quantity(hz, "frequency") for hz in (rate_hz, sample_rate_hz))
        raise DeviceError(card.name, f"the sample rate is {found}; expected {expected}, as it was set")
    if settings.mode == "replay":
        frames = Buffer().reserve(UPLOAD)
        frames[:] = 0
        card.set(spcm.SPC_MEMSIZE, UPLOAD, "memory size")
        card.upload(frames)
