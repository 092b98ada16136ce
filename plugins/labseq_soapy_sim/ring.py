"""The samples that the simulated radio received, in the file that it shares."""

from __future__ import annotations

import enum
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

MAGIC: Final = 0x3370616371657362
CHANNELS: Final = 2

_COUNTS: Final = (
    *("magic", "ring", "sent", "underflows", "is_active", "fault", "silent", "silence"),
    *("sequence_errors", "late_packets"),
)
_HEADER: Final = np.dtype(
    [
        *((name, np.uint64) for name in _COUNTS),
        *((name, np.float64) for name in ("rate_hz", "speed", "max_wait_s", "t0_s", "leakage")),
        *((name, np.float64, CHANNELS) for name in ("frequency_hz", "gain_db", "oscillator_hz", "start_s")),
    ]
)


class Fault(enum.IntFlag):
    """Faults of the radio while they are set; an underflow, and a lost or late packet, happen once."""

    NONE = 0
    UNDERFLOW = 1
    STREAM_ERROR = 2
    MUTE_0 = 4
    MUTE_1 = 8
    STALL = 16
    LOST_PACKET = 32
    LATE_PACKET = 64


def read_trace(folder: Path) -> list[tuple[float, str, float, float]]:
    """Changes of the transmitters, with ``record`` among the radio's arguments: time, name, two numbers.

    "open", "close", "stop", "gain" (channel, dB), "play" (sample n is at the connectors at the first number
    + n / the second).
    """
    lines = (line.split() for line in (folder / "trace").read_text("ascii").splitlines())
    return [(float(time_s), name, float(first), float(second)) for time_s, name, first, second in lines]


class Ring:
    """The latest samples of both channels.

    Args:
        folder: Folder of the radio's files.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "ring"
        memory = np.memmap(self._path, np.uint8, "r+")
        self._header: Any = memory[: _HEADER.itemsize].view(_HEADER)[0]
        if self._header["magic"] != MAGIC:
            raise ValueError(f"{self._path} was written by another version of labseq_soapy_sim")
        samples = memory[_HEADER.itemsize :].view(np.complex64)
        self._samples: NDArray[np.complex64] = samples.reshape(CHANNELS, int(self._header["ring"]))

    def __getitem__(self, name: str) -> Any:
        """A value of the header; see ``struct Header`` in capture.cpp."""
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
        """Whether the radio plays: a process has it open, and its buffer has not run dry."""
        header = self._header
        if not header["is_active"] or not self._is_held():
            return False
        late_s = time.monotonic() - header["t0_s"] - header["sent"] / (header["rate_hz"] * header["speed"])
        return bool(late_s <= header["max_wait_s"])

    def latest(self, n: int) -> NDArray[np.complex64]:
        """The latest samples that it received, complex64 (2, n); fewer if there were fewer."""
        size = self._samples.shape[1]
        while True:
            end = int(self._header["sent"])
            places = np.arange(max(0, end - n), end) % size
            found = self._samples[:, places]
            if int(self._header["sent"]) - end < size - n - (1 << 16):  # not overwritten meanwhile
                return found

    def output(self, n: int) -> NDArray[np.complex64]:
        """As :meth:`latest`, with the leakage of the local oscillators."""
        samples = self.latest(n)
        offsets_hz = self._header["oscillator_hz"] - self._header["frequency_hz"]
        times_s = np.arange(samples.shape[1]) / self._header["rate_hz"]
        waves = np.exp(2j * np.pi * np.outer(offsets_hz, times_s))
        return samples + (self._header["leakage"] * waves).astype(np.complex64)

    def _is_held(self) -> bool:
        import fcntl

        with self._path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            return False
