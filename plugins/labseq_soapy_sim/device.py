"""A software-defined radio that keeps the samples it is sent, with the methods of a ``SoapyDevice``.

It plays from a buffer of finite length by a clock, and reports an underflow when that ran dry, and packets
that were lost or late as SoapySDR's module for UHD does.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from filelock import Timeout
from labseq_soapy_stream.output import Samples
from labseq_soapy_stream.soapysdr import (
    CORRUPTION,
    NOT_SUPPORTED,
    STREAM_ERROR,
    TIME_ERROR,
    TIMEOUT,
    UNDERFLOW,
    SoapyError,
)
from numpy.typing import NDArray

from labseq_soapy_sim.ring import CHANNELS, HEADER, SAMPLES, Fault, create, radio_lock

MTU: Final = 16384
"""Most samples of one packet."""
APART_S: Final = 5e-6
"""By how much channel 1 starts after channel 0 without a timed start."""
GAINS_DB: Final = (0.0, 60.0, 0.25)
"""Lowest gain, highest, and step."""
COMPONENTS_HZ: Final[Mapping[str, tuple[float, float]]] = {"RF": (1e6, 6e9), "BB": (-100e6, 100e6)}
"""Range of the local oscillators, and of the shift of the samples away from them."""
ANTENNAS: Final = ("TX/RX",)
CLOCK_SOURCES: Final = ("internal", "external")
DRIVER: Final = "capture"
CODES: Final[Mapping[int, str]] = {
    STREAM_ERROR: "STREAM_ERROR",
    NOT_SUPPORTED: "NOT_SUPPORTED",
}
"""Codes that end a stream, and their names."""
PAUSE_S: Final = 1e-3
"""Time between two looks at a state that another process may change."""


class Clock(Protocol):
    """Methods of a clock that a radio needs, which labseq's clocks have."""

    def now(self) -> float:
        """Time in seconds."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        ...


class ComputerClock:
    """The clock of this computer, which all its processes share."""

    def now(self) -> float:
        """Time in seconds."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        time.sleep(duration_s)


class SimulatedDevice:
    """One radio that is open.

    Args:
        arguments: ``driver=capture``, with arguments of ``device: simulated,...``, which the package's README
            describes.
        clock: Clock by which it plays, by default the computer's.

    Raises:
        SoapyError: It is lost, or another process has it open. Methods raise this for refused values.
    """

    def __init__(self, arguments: str, clock: Clock | None = None) -> None:
        given = read_markup(arguments)
        self._clock = clock or ComputerClock()
        self._folder = Path(given.get("folder", "."))
        self._unlocked = given.get("unlocked", "")
        self._fault = given.get("fault", "")
        self._number = {key: float(given.get(key, default)) for key, (default, _) in NUMBERS.items()}
        self._shift_hz = [0.0] * CHANNELS
        self._resources = ExitStack()
        if given.get("driver") != DRIVER:
            raise SoapyError("no match")
        if self._fault == "absent" or _is_gone(self._folder):
            raise SoapyError("no such radio")
        try:
            self._resources.enter_context(radio_lock(self._folder).acquire(timeout=0.1))
        except Timeout:
            raise SoapyError("the device is busy, since another program has opened it") from None
        self._header, self._ring = create(self._folder)
        for name in ("speed", "patience", "leakage"):
            self._header["patience_s" if name == "patience" else name] = self._number[name]
        self._zero_s = self._clock.now()
        self._channels: Sequence[int] = ()
        self._records: list[Any] = []
        self._is_dry = False  # an underflow was counted, and no samples came since
        self._told = dict.fromkeys(REPORTED, 0)
        self._n_record = int(self._number["record"])
        self._trace_file: Any = None
        if self._n_record:
            self._trace_file = (self._folder / "trace").open("a", encoding="ascii", buffering=1)
            self._resources.enter_context(self._trace_file)
        self._trace("open")

    def close(self) -> None:
        """Switch the transmitters off. Another process may open the radio then."""
        if self._channels:
            raise SoapyError("the radio was closed before its stream, which would end a real program")
        self._header["is_active"] = 0
        self._trace("close")
        self._resources.close()

    def identify(self) -> dict[str, str]:
        """Driver, hardware, serial number."""
        return {"driver": DRIVER, "hardware": DRIVER, "serial": "simulated"}

    @property
    def n_channels(self) -> int:
        """Number of channels that transmit."""
        return int(self._number["channels"])

    def set_clock_source(self, source: str) -> None:
        """Choose the reference of its clocks."""
        if source not in CLOCK_SOURCES:
            raise SoapyError(f"there is no clock source {source}")

    def set(self, what: str, channel: int, value: float | str) -> None:
        """Set "Antenna", "SampleRate" or "Gain" of a channel, as near as the radio can. It has no filters."""
        self._check_channel(channel)
        if what == "Antenna" and value not in ANTENNAS:
            raise SoapyError(f"there is no antenna {value}")
        if what == "SampleRate":  # of all channels
            self._header["rate_hz"] = value
        if what == "Gain":
            lowest, highest, step = GAINS_DB
            gain_db = min(max(round(float(value) / step) * step, lowest), highest)
            self._header["gain_db"][channel] = gain_db
            self._trace("gain", channel, gain_db)

    def get(self, what: str, channel: int) -> float:
        """Read "SampleRate", "Frequency" or "Gain" of a channel back."""
        self._check_channel(channel)
        if what == "SampleRate":
            return float(self._header["rate_hz"])
        return float(self._header[{"Frequency": "frequency_hz", "Gain": "gain_db"}[what]][channel])

    def gain_range(self, channel: int) -> tuple[float, float]:
        """Lowest and highest gain in dB."""
        self._check_channel(channel)
        return GAINS_DB[:2]

    def set_frequency(self, channel: int, frequency_hz: float, offset_hz: float) -> None:
        """Tune RF to a frequency plus an offset, and BB to the rest, each as near as the radio can."""
        self._check_channel(channel)
        (low_hz, high_hz), (least_hz, most_hz) = COMPONENTS_HZ["RF"], COMPONENTS_HZ["BB"]
        tuned_hz = min(max(frequency_hz + offset_hz + self._number["detune"], low_hz), high_hz)
        self._header["oscillator_hz"][channel] = tuned_hz
        if "BB" in self.components(channel):
            self._shift_hz[channel] = min(max(frequency_hz - tuned_hz, least_hz), most_hz)
        self._header["frequency_hz"][channel] = tuned_hz + self._shift_hz[channel]

    def components(self, channel: int) -> set[str]:
        """Components of the frequency."""
        self._check_channel(channel)
        return {"RF", "BB"} if self._number["components"] > 1 else {"RF"}

    def component_hz(self, channel: int, name: str) -> float:
        """A component of the frequency."""
        return float(self._header["oscillator_hz"][channel] if name == "RF" else self._shift_hz[channel])

    def sensors(self, channel: int | None) -> set[str]:
        """Sensors of a channel, or of the whole radio."""
        return {"ref_locked"} if channel is None else {"lo_locked"}

    def read_sensor(self, channel: int | None, name: str) -> str:
        """Value of a sensor."""
        del channel
        return "false" if f"{self._unlocked}_locked" == name else "true"

    @property
    def has_time(self) -> bool:
        """Whether it has a clock that can be read."""
        return self._number["time"] > 0.0

    @property
    def time_ns(self) -> int:
        """Time of its clock, which runs as fast as the computer's clock."""
        return int(1e9 * (self._clock.now() - self._zero_s))

    def set_up_stream(self, channels: Sequence[int], arguments: str) -> None:
        """Prepare for samples to these channels."""
        del arguments
        for channel in channels:
            self._check_channel(channel)
        self._channels = channels
        if coerced_hz := self._number["coerce_rate"]:  # as its clock is set for this number of channels
            self._header["rate_hz"] = coerced_hz
        if self._n_record:
            self._records = [
                self._resources.enter_context((self._folder / f"channel{channel}").open("wb", buffering=0))
                for channel in channels
            ]

    def close_stream(self) -> None:
        """Take no more samples."""
        self._channels = ()

    def activate(self) -> int:
        """Switch the transmitters on, and return a code of SoapySDR."""
        if self._fault == "inactive":
            return STREAM_ERROR
        self._header["sent"] = 0
        self._header["t0_s"] = self._clock.now()
        self._header["is_active"] = 1
        return 0

    def deactivate(self) -> int:
        """Switch the transmitters off, and return a code of SoapySDR."""
        if self._has(Fault.GONE):
            raise SoapyError("the radio does not answer; was it unplugged?")
        self._header["is_active"] = 0
        self._trace("stop")
        return 0

    def write(self, samples: Samples, start: int, start_ns: int | None, timeout_s: float) -> int:
        """Take samples, after ``timeout_s`` at most. Returns how many, or a code of SoapySDR."""
        while self._has(Fault.HANG):
            self._clock.sleep(0.1)
        if not self._header["is_active"] or self._has(Fault.STREAM_ERROR | Fault.GONE):
            return STREAM_ERROR
        if start_ns is not None and self._number["time"] > 1.0:
            return NOT_SUPPORTED
        if self._header["sent"] == 0:
            self._start(start_ns)
        rows = samples[:, 2 * start :].view(np.uint64)
        n = min(rows.shape[1], MTU, max(1, int(self._buffer)))
        n = self._wait_for_room(n, timeout_s)
        if n == 0:
            return TIMEOUT
        for fault, count in ((Fault.LOST_PACKET, "sequence_errors"), (Fault.LATE_PACKET, "late_packets")):
            if self._drops(fault, count):
                return n
        self._keep(rows[:, :n], n)
        return n

    def read_status(self, timeout_s: float) -> int:
        """Report an event of the stream, after ``timeout_s`` at most, as a code of SoapySDR."""
        deadline_s = self._clock.now() + timeout_s
        while True:
            self._notice_underflow()
            for name, code in REPORTED.items():
                if self._told[name] != self._header[name]:
                    self._told[name] += 1
                    return code
            if self._clock.now() >= deadline_s:
                return TIMEOUT
            self._clock.sleep(PAUSE_S)

    def code_text(self, code: int) -> str:
        """A code with its name."""
        return f"{CODES[code]} ({code})"

    def _check_channel(self, channel: int) -> None:
        if channel >= self.n_channels:
            raise SoapyError(f"there is no channel {channel}")

    def _has(self, fault: Fault) -> bool:
        return bool(int(self._header["fault"]) & fault)

    def _trace(self, name: str, first: float = 0.0, second: float = 0.0) -> None:
        if self._trace_file is not None:
            self._trace_file.write(f"{self._clock.now():.6f} {name} {first:.6f} {second:.6f}\n")

    @property
    def _buffer(self) -> float:
        """Length of its buffer in samples."""
        return self._number["buffer"] * float(self._header["rate_hz"])

    @property
    def _speed_hz(self) -> float:
        return float(self._header["rate_hz"]) * self._number["speed"]

    def _start(self, start_ns: int | None) -> None:
        """Start the channels together at a time that is not over, otherwise each with its first packet."""
        now_s, header = self._clock.now(), self._header
        start_s = None if start_ns is None else self._zero_s + 1e-9 * start_ns
        if start_s is not None and start_s <= now_s + self._number["delay"]:
            header["late_packets"] += 1
            start_s = None
        header["t0_s"] = now_s if start_s is None else start_s
        header["start_s"] = header["t0_s"] + (0.0 if start_s else np.arange(CHANNELS) * APART_S)
        self._trace("play", header["t0_s"], self._speed_hz)

    def _drops(self, fault: Fault, count: str) -> bool:
        """Whether a packet is lost. Later samples then play earlier, and the phases of all tones jump."""
        if not self._has(fault):
            return False
        self._clear(fault)
        self._header[count] += 1
        return True

    def _clear(self, fault: Fault) -> None:
        self._header["fault"] = int(self._header["fault"]) & ~int(fault)

    def _late_s(self) -> float:
        """How long its buffer has been empty. If negative, how long its samples will last."""
        return self._clock.now() - float(self._header["t0_s"]) - int(self._header["sent"]) / self._speed_hz

    def _notice_underflow(self) -> None:
        """Count an underflow, once until more samples come."""
        is_forced = self._has(Fault.UNDERFLOW)
        if not self._header["is_active"] or not self._header["sent"] or self._is_dry:
            return
        if is_forced or self._late_s() > self._number["patience"]:
            self._header["underflows"] += 1
            self._is_dry = True
            self._clear(Fault.UNDERFLOW)

    def _buffered(self) -> float:
        """Samples in its buffer. An underflow, or a wait for late samples, sets its clock back."""
        header, sent = self._header, int(self._header["sent"])
        self._notice_underflow()
        late_s = self._late_s()
        if sent and (self._is_dry or late_s > 0.0):
            late_s = 0.0
            header["t0_s"] = self._clock.now() - sent / self._speed_hz
            self._trace("play", header["t0_s"], self._speed_hz)
        return min(sent, -late_s * self._speed_hz)

    def _wait_for_room(self, n: int, timeout_s: float) -> int:
        """How many of n samples the buffer takes. Waits for all of them as long as it may."""
        deadline_s = self._clock.now() + timeout_s
        while True:
            is_stalled = self._has(Fault.STALL)
            free = 0.0 if is_stalled else self._buffer - self._buffered()
            left_s = deadline_s - self._clock.now()
            if free >= n:
                return n
            if left_s <= 0.0:
                return int(free)
            wait_s = PAUSE_S if is_stalled else max(1.0, n - free) / self._speed_hz
            self._clock.sleep(min(wait_s, left_s, 0.05))

    def _keep(self, rows: NDArray[np.uint64], n: int) -> None:
        header = self._header
        sent = int(header["sent"])
        first = sent % SAMPLES
        head = min(n, SAMPLES - first)
        for channel, row in zip(self._channels, rows, strict=True):
            is_mute = channel < CHANNELS and self._has((Fault.MUTE_0, Fault.MUTE_1)[channel])
            kept = np.zeros_like(row) if is_mute else row
            self._ring[channel, first : first + head] = kept[:head]
            self._ring[channel, : n - head] = kept[head:]
        for record, row in zip(self._records, rows, strict=False):
            if sent < self._n_record:
                record.write(row[: self._n_record - sent].tobytes())
        silent = int(header["silent"])
        if rows.any():
            header["silence"], silent = silent or header["silence"], 0
        else:
            silent += n
        header["silent"] = silent
        self._is_dry = False
        header["sent"] = sent + n


REPORTED: Final[Mapping[str, int]] = {
    "underflows": UNDERFLOW,
    "sequence_errors": CORRUPTION,
    "late_packets": TIME_ERROR,
}
"""Count in the header -> code with which SoapySDR reports it."""
NUMBERS: Final[Mapping[str, tuple[float, float]]] = {
    "speed": (0.1, 1e-4),
    "buffer": (0.002, 1e-4),
    "patience": (60.0, 0.0),
    "record": (0.0, 0.0),
    "channels": (2.0, 1.0),
    "coerce_rate": (0.0, 0.0),
    "leakage": (0.003, 0.0),
    "components": (2.0, 1.0),
    "time": (1.0, 0.0),
    "delay": (0.0, 0.0),
    "detune": (0.0, -1e9),
}
"""Arguments that are numbers -> their defaults, and their lowest values.

A tenth of real time costs a tenth of the work. On a busy computer samples sometimes come late. The radio's
clock then waits for them, so that equal runs give equal atoms.
"""


def read_markup(markup: str) -> dict[str, str]:
    """Keys and values of a text such as "driver=uhd, type=b200", as SoapySDR reads it."""
    pairs = (part.partition("=") for part in markup.split(","))
    return {key.strip(): value.strip() for key, _, value in pairs if key.strip()}


def _is_gone(folder: Path) -> bool:
    """Whether the radio of this folder was unplugged."""
    path = folder / "ring"
    if not path.exists() or path.stat().st_size < HEADER.itemsize:
        return False
    return bool(int(np.fromfile(path, HEADER, 1)["fault"][0]) & Fault.GONE)
