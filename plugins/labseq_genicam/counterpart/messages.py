"""What the simulated camera's process and its parent tell each other: raw messages through two pipes."""

from __future__ import annotations

import struct
import threading
from dataclasses import asdict, dataclass
from typing import IO, Any, Final

HEAD: Final = struct.Struct("<4sQ")
"""Kind of a message, and size of what follows, in bytes."""

SETUP: Final = b"SET1"  # parent: JSON of a Setup
FAULTS: Final = b"FAUL"  # parent: JSON of Faults; answered by DONE
IMAGE: Final = b"IMAG"  # parent: the bytes of a frame, in the camera's pixel format
NO_IMAGE: Final = b"NONE"  # parent: there is none; the frame fails
READY: Final = b"HELO"  # camera: its address
REFUSED: Final = b"ERRO"  # camera: why it cannot start
EXPOSE: Final = b"EXPO"  # camera: an Exposure
DONE: Final = b"DONE"  # camera: the faults are in force

_EXPOSURE: Final = struct.Struct("<10Q")


@dataclass(frozen=True, slots=True)
class Exposure:
    """What the camera tells of a frame that it begins.

    Attributes:
        n: Number of the frame, from 0.
        exposure_us: Exposure time, in microseconds.
        gain: Gain, in steps of its register.
        pixel_format: Code of the pixel format.
        x: First column.
        y: First row.
        width: Number of columns.
        height: Number of rows.
        binning_x: Columns that are added up.
        binning_y: Rows that are added up.
    """

    n: int
    exposure_us: int
    gain: int
    pixel_format: int
    x: int
    y: int
    width: int
    height: int
    binning_x: int
    binning_y: int

    def packed(self) -> bytes:
        """As bytes."""
        return _EXPOSURE.pack(*asdict(self).values())

    @classmethod
    def unpacked(cls, data: bytes | bytearray) -> Exposure:
        """Out of bytes."""
        return cls(*_EXPOSURE.unpack(data))


class Channel:
    """Messages over a pipe each way; any thread may send, one receives.

    Args:
        reader: Where messages come from, unbuffered or not.
        writer: Where they go, unbuffered.
    """

    def __init__(self, reader: IO[bytes], writer: IO[bytes]) -> None:
        self._reader = reader
        self._writer = writer
        self._sending = threading.Lock()

    def send(self, kind: bytes, data: Any = b"") -> None:
        """Send a message; ``data`` is anything with contiguous bytes.

        Raises:
            OSError: The other side is gone.
        """
        view = memoryview(data).cast("B")
        with self._sending:
            self._write(memoryview(HEAD.pack(kind, len(view))))
            self._write(view)

    def receive(self) -> tuple[bytes, bytearray] | None:
        """Wait for a message; None when the other side is gone."""
        head = self._read(HEAD.size)
        if head is None:
            return None
        kind, size = HEAD.unpack(head)
        data = self._read(size)
        return None if data is None else (kind, data)

    def _write(self, view: memoryview) -> None:
        while view:
            view = view[self._writer.write(view) :]

    def _read(self, size: int) -> bytearray | None:
        data = bytearray(size)
        view = memoryview(data)
        while view:
            n = self._reader.readinto(view)  # type: ignore[attr-defined]
            if not n:
                return None
            view = view[n:]
        return data
