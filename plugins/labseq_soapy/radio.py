"""Setting the radio up, and reading back what it made of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from labseq_soapy.library import Radio, SoapyError
from labseq_soapy.messages import Setup


@dataclass(frozen=True, slots=True)
class Facts:
    """What the radio says of itself after it was set up.

    Attributes:
        radio: Driver, hardware, serial number and the like.
        rate_hz: Sample rate.
        oscillator_hz: Local oscillator of the row and the column channel.
        gain_db: Gain of the row and the column channel.
        buffered: Samples that wait in it when it takes no more.
    """

    radio: dict[str, str]
    rate_hz: float
    oscillator_hz: tuple[float, float]
    gain_db: tuple[float, float]
    buffered: int = 0

    def as_message(self) -> dict[str, Any]:
        """The same, for JSON."""
        return asdict(self)

    @classmethod
    def from_message(cls, values: dict[str, Any]) -> Facts:
        """Read back what ``as_message`` made."""
        (row_hz, column_hz), (row_db, column_db) = values["oscillator_hz"], values["gain_db"]
        return cls(
            values["radio"], values["rate_hz"], (row_hz, column_hz), (row_db, column_db), values["buffered"]
        )


def open_radio(setup: Setup) -> Radio:
    """Open the radio that is meant.

    Raises:
        SoapyError: There is none, another program has it, or it has too few channels.
    """
    try:
        radio = Radio(setup.device)
    except SoapyError as error:
        text = f"'{setup.device}' cannot be opened: {error}"
        hint = "`SoapySDRUtil --find` lists what is there"
        raise SoapyError(text if "library" in str(error) else f"{text}; {hint}") from error
    needed = max(setup.channels) + 1
    if radio.n_channels < needed:
        n_channels = radio.n_channels
        radio.close()
        text = f"it has {n_channels} channel(s) that transmit; expected {needed}, one for each AOD"
        raise SoapyError(text)
    return radio


def set_up(radio: Radio, setup: Setup) -> Facts:
    """Set both channels up, and read back.

    Raises:
        SoapyError: The radio refuses something, or its channels have different rates.
    """
    if setup.clock_source:
        radio.set_clock_source(setup.clock_source)
    for channel, gain_db in zip(setup.channels, setup.gain_db, strict=True):
        radio.set("SampleRate", channel, setup.rate_hz)
        if setup.bandwidth_hz is not None:
            radio.set("Bandwidth", channel, setup.bandwidth_hz)
        if setup.antenna:
            radio.set("Antenna", channel, setup.antenna)
        radio.set("Frequency", channel, setup.oscillator_hz)
        lowest, highest = radio.gain_range(channel)
        if gain_db is not None and not lowest <= gain_db <= highest:
            text = f"a gain of {gain_db:g} dB; channel {channel} has {lowest:g} to {highest:g} dB"
            raise SoapyError(text)
        radio.set("Gain", channel, lowest if gain_db is None else gain_db)
    rows, columns = setup.channels
    rates = [radio.get("SampleRate", channel) for channel in setup.channels]
    if rates[0] != rates[1]:
        raise SoapyError(f"its channels have different sample rates: {rates[0]:.10g} and {rates[1]:.10g} Hz")
    return Facts(
        radio.identify(),
        rates[0],
        (radio.get("Frequency", rows), radio.get("Frequency", columns)),
        (radio.get("Gain", rows), radio.get("Gain", columns)),
    )
