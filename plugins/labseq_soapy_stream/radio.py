"""A radio with two tuned channels, and a stream that starts on both at one time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

from labseq_soapy_stream.messages import LO_LOCKED, REF_LOCKED, Facts, Setup, unlocked
from labseq_soapy_stream.output import Samples
from labseq_soapy_stream.soapysdr import (
    CORRUPTION,
    NOT_SUPPORTED,
    TIME_ERROR,
    TIMEOUT,
    UNDERFLOW,
    LibraryError,
    SoapyDevice,
    SoapyError,
)

if TYPE_CHECKING:
    from labseq_soapy_sim.device import SimulatedDevice

Device: TypeAlias = "SoapyDevice | SimulatedDevice"
OpenDevice: TypeAlias = Callable[[str], Device]

ERRORS: Final = {UNDERFLOW: "underflows", CORRUPTION: "sequence_errors", TIME_ERROR: "late_packets"}
"""Codes of errors that a stream survives -> key of the counts."""
LOCK_S: Final = 2.0
"""How long clocks and oscillators may take to lock."""
START_S: Final = 0.1
"""Time from setting a start to the start."""


def open_radio(open_device: OpenDevice, setup: Setup) -> Device:
    """Open the radio.

    Raises:
        SoapyError: There is none, another program has it, or it has too few channels.
    """
    try:
        radio = open_device(setup.device)
    except LibraryError:
        raise
    except SoapyError as error:
        hint = "`SoapySDRUtil --find` lists the radios that are connected"
        raise SoapyError(f"'{setup.device}' cannot be opened: {error}; {hint}") from error
    n_channels, needed = radio.n_channels, max(setup.channels) + 1
    if n_channels < needed:
        radio.close()
        text = f"it has {n_channels} channel(s) that transmit, not {needed}, one for each AOD"
        raise SoapyError(text)
    return radio


def set_up(radio: Device, setup: Setup) -> Stream:
    """Set up both channels and their stream.

    Raises:
        SoapyError: The radio refuses something.
    """
    if setup.clock_source:
        radio.set_clock_source(setup.clock_source)
    for channel, gain_db in zip(setup.channels, setup.gain_db, strict=True):
        radio.set("SampleRate", channel, setup.rate_hz)
        if setup.bandwidth_hz is not None:
            radio.set("Bandwidth", channel, setup.bandwidth_hz)
        if setup.antenna:
            radio.set("Antenna", channel, setup.antenna)
        _tune(radio, channel, setup.oscillator_hz, setup.lo_offset_hz)
        lowest, highest = radio.gain_range(channel)
        if gain_db is not None and not lowest <= gain_db <= highest:
            text = f"no gain of {gain_db:g} dB; channel {channel} has {lowest:g} to {highest:g} dB"
            raise SoapyError(text)
        radio.set("Gain", channel, lowest if gain_db is None else gain_db)
    radio.set_up_stream(sorted(setup.channels), setup.stream)
    return Stream(radio)


def read_back(radio: Device, setup: Setup) -> Facts:
    """Read the values of both channels back after the stream is set up, since some radios change them then.

    Raises:
        SoapyError: Its channels have different rates.
    """
    rates = [radio.get("SampleRate", channel) for channel in setup.channels]
    if rates[0] != rates[1]:
        raise SoapyError(f"its channels have different sample rates: {rates[0]:.10g} and {rates[1]:.10g} Hz")
    end_s = time.monotonic() + LOCK_S
    while unlocked(locks := _locks(radio, setup.channels), setup.clock_source) and time.monotonic() < end_s:
        time.sleep(LOCK_S / 100)
    return Facts(
        radio=radio.identify(),
        rate_hz=rates[0],
        zero_hz=[radio.get("Frequency", channel) for channel in setup.channels],
        oscillator_hz=[_oscillator_hz(radio, channel) for channel in setup.channels],
        gain_db=[radio.get("Gain", channel) for channel in setup.channels],
        locks=locks,
    )


def lower_gains(open_device: OpenDevice, device: str, channels: Sequence[int]) -> None:
    """Open a radio that a killed process left transmitting, set the lowest gains, and close it.

    Raises:
        SoapyError: It cannot be opened, or refuses something.
    """
    radio = open_device(device)
    try:
        for channel in channels:
            radio.set("Gain", channel, radio.gain_range(channel)[0])
    finally:
        radio.close()


def _tunes_digitally(radio: Device, channel: int) -> bool:
    return {"RF", "BB"} <= radio.components(channel)


def _tune(radio: Device, channel: int, frequency_hz: float, offset_hz: float) -> None:
    """Tune the local oscillator to a frequency plus an offset.

    If the radio can shift the samples digitally their zero stays at the frequency, else it shifts too.
    """
    if offset_hz and not _tunes_digitally(radio, channel):
        frequency_hz, offset_hz = frequency_hz + offset_hz, 0.0
    radio.set_frequency(channel, frequency_hz, offset_hz)


def _oscillator_hz(radio: Device, channel: int) -> float:
    """Frequency of the local oscillator, where it leaks."""
    if _tunes_digitally(radio, channel):
        return radio.component_hz(channel, "RF")
    return radio.get("Frequency", channel)


def _locks(radio: Device, channels: Sequence[int]) -> dict[str, bool]:
    """Whether its clocks are locked to their reference, and the local oscillators of channels to them.

    Only sensors that the radio has, by the names of UHD: "ref_locked", "lo_locked" with its channel.
    """
    locks: dict[str, bool] = {}
    if REF_LOCKED in radio.sensors(None):
        locks[REF_LOCKED] = radio.read_sensor(None, REF_LOCKED) == "true"
    for channel in channels:
        if LO_LOCKED in radio.sensors(channel):
            locks[f"{LO_LOCKED} {channel}"] = radio.read_sensor(channel, LO_LOCKED) == "true"
    return locks


class Stream:
    """A stream of complex samples to all channels at once.

    Attributes:
        starts_together: Whether the first samples are played on all channels at one time.
    """

    def __init__(self, radio: Device) -> None:
        self._radio = radio
        self._knows_status = True
        self._errors: Counter[str] = Counter()
        self._starts_ns: int | None = None
        self.starts_together = False

    def activate(self) -> None:
        """Let the first samples start to play, on all channels at one time if the radio has a clock.

        Raises:
            SoapyError: The radio refuses to transmit.
        """
        if code := self._radio.activate():
            raise SoapyError(f"starting the stream: {self._radio.code_text(code)}")
        self.starts_together = self._radio.has_time
        if self.starts_together:
            self._starts_ns = self._radio.time_ns + round(START_S * 1e9)
        self._activated_s = time.monotonic()

    def check_start(self) -> None:
        """Find out whether the first samples came in time, without waiting until they are played."""
        left_s = self._activated_s + START_S / 2 - time.monotonic()
        if self.starts_together and self.errors(max(0.0, left_s))["late_packets"]:
            self.starts_together = False

    def write(self, samples: Samples, start: int, timeout_s: float) -> int:
        """Write samples to the stream.

        Args:
            samples: float32 (n_channels, 2 n), I and Q in turn, each row in one piece.
            start: Index of the first sample to write.
            timeout_s: How long to wait for room.

        Returns:
            Number of samples that the radio took, 0 if there was no room in time.

        Raises:
            SoapyError: The stream is broken.
        """
        n_taken = self._radio.write(samples, start, self._starts_ns, timeout_s)
        if n_taken > 0:
            self._starts_ns = None
        elif n_taken == NOT_SUPPORTED and self._starts_ns is not None:  # it has a clock, but not for this
            self._starts_ns, self.starts_together = None, False
            return self.write(samples, start, timeout_s)
        elif n_taken in ERRORS:
            self._errors[ERRORS[n_taken]] += 1
        elif n_taken not in {0, TIMEOUT}:
            raise SoapyError(f"writing to the stream: {self._radio.code_text(n_taken)}")
        return max(0, n_taken)

    def errors(self, timeout_s: float = 0.0) -> Counter[str]:
        """How often the radio reported each of :data:`ERRORS` since the last call. Waits for the first."""
        while self._knows_status:
            code = self._radio.read_status(timeout_s)
            if code in ERRORS:
                self._errors[ERRORS[code]] += 1
                timeout_s = 0.0
                continue
            if code == NOT_SUPPORTED:
                self._knows_status = False
            elif code < 0 and code != TIMEOUT:
                raise SoapyError(f"the stream's status: {self._radio.code_text(code)}")
            break
        counts, self._errors = self._errors, Counter()
        return counts

    def close(self) -> None:
        """Stop playing and close the stream.

        Raises:
            SoapyError: The radio does not obey, and its transmitters may still be on.
        """
        try:
            code = self._radio.deactivate()
        finally:
            self._radio.close_stream()
        if code:
            raise SoapyError(f"stopping the stream: {self._radio.code_text(code)}")
