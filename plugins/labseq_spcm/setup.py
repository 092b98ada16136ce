"""Setting a card up: every value is written, read back, and told."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_spcm import limits
from labseq_spcm.card import AwgCard
from labseq_spcm.settings import SpcmSettings

ALL_CHANNELS: Final = 0b11


def output_registers(spcm: Any) -> tuple[int, int]:
    """The registers that switch the outputs on and off."""
    return spcm.SPC_ENABLEOUT0, spcm.SPC_ENABLEOUT1


def set_up(card: AwgCard, settings: SpcmSettings, amplitude_mv: int) -> dict[str, Any]:
    """Bring the card from any state into the driver's, outputs off.

    Args:
        card: The open card.
        settings: The driver's settings.
        amplitude_mv: Peak voltage into 50 Ohm of both outputs.

    Returns:
        What the card is, and what it reads back: JSON-ready.

    Raises:
        DeviceError: It is another card than it should be, or does not take a value.
    """
    _check_type(card, settings)
    spcm = card.spcm
    card.command(spcm.M2CMD_CARD_RESET, "reset")
    card.set(spcm.SPC_CHENABLE, ALL_CHANNELS, "active channels")
    rate_hz = _set_clock(card, settings)
    card.set_all((register, 0, "output") for register in output_registers(spcm))
    card.set_all(
        [
            (spcm.SPC_AMP0, amplitude_mv, "amplitude of output 0 in mV"),
            (spcm.SPC_AMP1, amplitude_mv, "amplitude of output 1 in mV"),
            (spcm.SPC_CH0_STOPLEVEL, spcm.SPCM_STOPLVL_ZERO, "output 0 when stopped"),
            (spcm.SPC_CH1_STOPLEVEL, spcm.SPCM_STOPLVL_ZERO, "output 1 when stopped"),
            (spcm.SPC_FILTER0, 0, "filter of output 0"),
            (spcm.SPC_FILTER1, 0, "filter of output 1"),
        ]
    )
    _set_trigger(card, settings)
    version = card.read(spcm.SPC_GETDRVVERSION)
    return {
        "model": card.product,
        "serial_number": card.serial_number,
        "driver_version": f"{version >> 24}.{version >> 16 & 0xFF}.{version & 0xFFFF}",
        "sample_rate_hz": rate_hz,
        "trigger_delay_s": limits.DDS_DELAY_S if settings.mode == "dds" else limits.trigger_delay_s(rate_hz),
        "amplitude_mv": amplitude_mv,
        "trigger_level_mv": card.read(spcm.SPC_TRIG_EXT0_LEVEL0),
    }


def _check_type(card: AwgCard, settings: SpcmSettings) -> None:
    spcm, name = card.spcm, card.name
    n_channels = card.read(spcm.SPC_MIINST_MODULES) * card.read(spcm.SPC_MIINST_CHPERMODULE)
    family = (card.read(spcm.SPC_PCITYP) & spcm.TYP_FAMILYMASK) >> 8
    if family != limits.FAMILY or n_channels != 2:
        text = f"the card '{settings.card}' is a {card.product} with {n_channels} channels"
        raise DeviceError(name, f"{text}; expected {limits.FAMILY_NAME}: name another one as `card`")
    if settings.serial and card.serial_number != settings.serial:
        text = f"the card '{settings.card}' has the serial number {card.serial_number}"
        raise DeviceError(name, f"{text}; expected {settings.serial}: name another one as `card`")
    if settings.mode == "dds" and not card.read(spcm.SPC_PCIEXTFEATURES) & spcm.SPCM_FEAT_EXTFW_DDS20:
        raise DeviceError(name, f"the {card.product} was bought without DDS; use mode: replay")
    fastest_hz = card.read(spcm.SPC_MIINST_MAXADCLOCK)
    if settings.mode != "dds" and settings.sample_rate > fastest_hz:
        text = f"the {card.product} makes at most {fastest_hz / 1e6:g} MS/s"
        raise DeviceError(name, f"{text}; lower sample_rate from {settings.sample_rate / 1e6:g} MHz")


def _set_clock(card: AwgCard, settings: SpcmSettings) -> float:
    spcm, reference_hz = card.spcm, settings.reference_clock
    if reference_hz is None:
        card.set(spcm.SPC_CLOCKMODE, spcm.SPC_CM_INTPLL, "clock mode")
    else:
        card.set(spcm.SPC_CLOCKMODE, spcm.SPC_CM_EXTREFCLOCK, "clock mode")
        card.set(spcm.SPC_REFERENCECLOCK, round(reference_hz), "reference clock in Hz")
    rate_hz = round(limits.DDS_RATE_HZ if settings.mode == "dds" else settings.sample_rate)
    return float(card.set(spcm.SPC_SAMPLERATE, rate_hz, "sample rate in Hz", limits.RATE_STEP_HZ))


def _set_trigger(card: AwgCard, settings: SpcmSettings) -> None:
    """No source at all for the software trigger: it is forced, which works alike in all modes."""
    spcm = card.spcm
    card.set(spcm.SPC_TRIG_ANDMASK, spcm.SPC_TMASK_NONE, "trigger AND mask")
    if settings.trigger == "software":
        card.set(spcm.SPC_TRIG_ORMASK, spcm.SPC_TMASK_NONE, "trigger source")
        return
    edge = spcm.SPC_TM_POS if settings.trigger_edge == "rising" else spcm.SPC_TM_NEG
    card.set(spcm.SPC_TRIG_ORMASK, spcm.SPC_TMASK_EXT0, "trigger source")
    card.set(spcm.SPC_TRIG_EXT0_MODE, edge, "trigger edge")
    card.set(spcm.SPC_TRIG_TERM, int(settings.trigger_50_ohm), "trigger termination")
    level_mv = round(1e3 * settings.trigger_level)
    card.set(spcm.SPC_TRIG_EXT0_LEVEL0, level_mv, "trigger level in mV", limits.TRIGGER_STEP_MV)
