"""The file with a simulated radio's state and received samples, shared with other processes."""

from __future__ import annotations

import enum
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

MAGIC: Final = 0x3471616371657362
"""Changes with the layout of the header."""
CHANNELS: Final = 2
SAMPLES: Final = 1 << 18
"""Length of the ring of each channel."""

HEADER: Final = np.dtype(
    [
        *((name, np.uint64) for name in ("magic", "sent", "is_active", "fault")),
        *((name, np.uint64) for name in ("underflows", "sequence_errors", "late_packets")),
        *((name, np.uint64) for name in ("silent", "silence")),
        *((name, np.float64) for name in ("rate_hz", "speed", "patience_s", "t0_s", "leakage")),
        *((name, np.float64, CHANNELS) for name in ("frequency_hz", "gain_db", "oscillator_hz", "start_s")),
    ]
)
"""State of the radio: samples received, whether it transmits, errors, settings.

``silent`` counts samples of the present silence, ``silence`` of the last one. Sample n is played at t0_s + n
/ (rate_hz speed) of ``time.monotonic``. ``frequency_hz`` is the zero of the samples, ``oscillator_hz`` where
it leaks, ``start_s`` when the first sample of a channel was played.
"""


class Fault(enum.IntFlag):
    """Faults of the radio while they are set. An underflow, and a lost or late packet, happen once."""

    NONE = 0
    UNDERFLOW = enum.auto()
    STREAM_ERROR = enum.auto()
    MUTE_0 = enum.auto()
    MUTE_1 = enum.auto()
    STALL = enum.auto()
    LOST_PACKET = enum.auto()
    LATE_PACKET = enum.auto()
    HANG = enum.auto()
    GONE = enum.auto()


def read_trace(folder: Path) -> list[tuple[float, str, float, float]]:
    """Changes of the transmitters (time, name, two numbers), with ``record`` among the radio's arguments.

    "open", "close", "stop", "gain" (channel, dB), "play" (sample n is at the connectors at the first number
    + n / the second).
    """
    lines = (line.split() for line in (folder / "trace").read_text("ascii").splitlines())
    return [(float(time_s), name, float(first), float(second)) for time_s, name, first, second in lines]


def radio_lock(folder: Path) -> FileLock:
    """The lock that a process holds while it has the radio open."""
    return FileLock(folder / "lock")


def create(folder: Path) -> tuple[Any, NDArray[np.uint64]]:
    """Create or empty the file. Returns its header and its samples, uint64 (2, SAMPLES), for writing."""
    n_bytes = HEADER.itemsize + CHANNELS * SAMPLES * 8
    path = folder / "ring"
    path.touch(0o600)
    with path.open("r+b") as file:
        file.truncate(n_bytes)
    memory = np.memmap(path, np.uint8, "r+")
    memory[:] = 0
    header = memory[: HEADER.itemsize].view(HEADER)[0]
    header["magic"] = MAGIC
    return header, memory[HEADER.itemsize :].view(np.uint64).reshape(CHANNELS, SAMPLES)


class Ring:
    """The latest samples of both channels.

    Args:
        folder: Folder of the radio's files.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / "ring"
        self._lock = radio_lock(folder)
        memory = np.memmap(path, np.uint8, "r+")
        self._header: Any = memory[: HEADER.itemsize].view(HEADER)[0]
        if self._header["magic"] != MAGIC:
            raise ValueError(f"{path} was written by another version of labseq_soapy_sim")
        samples = memory[HEADER.itemsize :].view(np.complex64)
        self._samples: NDArray[np.complex64] = samples.reshape(CHANNELS, SAMPLES)

    def __getitem__(self, name: str) -> Any:
        """A value of the :data:`HEADER`."""
        return self._header[name]

    def set_fault(self, fault: Fault) -> None:
        """Set the radio's faults from now on."""
        self._header["fault"] = int(fault)

    @property
    def is_transmitting(self) -> bool:
        """Whether its transmitters are on, also without samples, as after the death of the process."""
        return bool(self._header["is_active"])

    @property
    def is_playing(self) -> bool:
        """Whether the radio plays, so that a process has it open and its buffer has not run dry."""
        header = self._header
        if not header["is_active"] or not self._is_held():
            return False
        late_s = time.monotonic() - header["t0_s"] - header["sent"] / (header["rate_hz"] * header["speed"])
        return bool(late_s <= header["patience_s"])

    def latest(self, n: int) -> NDArray[np.complex64]:
        """The latest samples that it received, complex64 (2, n), fewer if there were fewer."""
        while True:
            end = int(self._header["sent"])
            places = np.arange(max(0, end - n), end) % SAMPLES
            found = self._samples[:, places]
            if int(self._header["sent"]) - end < SAMPLES - n - (1 << 16):  # not overwritten meanwhile
                return found

    def output(self, n: int) -> NDArray[np.complex64]:
        """As :meth:`latest`, with the leakage of the local oscillators."""
        samples = self.latest(n)
        offsets_hz = self._header["oscillator_hz"] - self._header["frequency_hz"]
        times_s = np.arange(samples.shape[1]) / self._header["rate_hz"]
        waves = np.exp(2j * np.pi * np.outer(offsets_hz, times_s))
        return samples + (self._header["leakage"] * waves).astype(np.complex64)

    def _is_held(self) -> bool:
        try:
            with self._lock.acquire(timeout=0):
                return False
        except Timeout:
            return True
