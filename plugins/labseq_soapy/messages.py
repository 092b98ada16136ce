"""What labseq and the streaming process tell each other: lines of JSON through two pipes.

labseq's first line is a :class:`Setup`; then come commands, each with a key ``do``:

==========  =====================================  ==============================================
``do``      further keys                           answer
==========  =====================================  ==============================================
``loop``    ``id``, ``file``, ``fade_s``           ``{"done": id}`` when it is at the connectors
``ramp``    ``id``, ``depth``, ``duration_s``      the same
``end``     none                                   none: it ramps down, lets the radio go and ends
``beat``    none                                   none: labseq lives
==========  =====================================  ==============================================

The process says ``{"facts": ...}`` or ``{"failed": text}`` once, then ``{"status": ...}`` again and
again, and ``{"ended": text}`` if it ends for another reason than ``end``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Setup:
    """What the streaming process is told first.

    Attributes:
        device: Arguments that open the radio.
        stream: Arguments of its stream.
        channels: Channel of the row axis and of the column axis.
        rate_hz: Sample rate.
        oscillator_hz: Frequency of the local oscillators.
        bandwidth_hz: Bandwidth of the analog filters; None: as the radio chooses.
        gain_db: Gain of each axis; None: the lowest.
        antenna: Name of the connector; "": as the radio chooses.
        clock_source: Reference of its clocks; "": as the radio chooses.
        ramp_s: Duration of its own ramp to nothing.
        max_wait_s: How long labseq may be silent.
        hold: Whether to go on without labseq.
        marker: File that says that it goes on without labseq; who deletes it ends it.
    """

    device: str
    stream: str
    channels: tuple[int, int]
    rate_hz: float
    oscillator_hz: float
    bandwidth_hz: float | None
    gain_db: tuple[float | None, float | None]
    antenna: str
    clock_source: str
    ramp_s: float
    max_wait_s: float
    hold: bool
    marker: str

    def as_message(self) -> Mapping[str, Any]:
        """The same, for JSON."""
        return asdict(self)

    @classmethod
    def from_message(cls, values: Mapping[str, Any]) -> Setup:
        """Read back what ``as_message`` made."""
        rows, columns = values["channels"]
        row_gain, column_gain = values["gain_db"]
        pairs: dict[str, Any] = {"channels": (rows, columns), "gain_db": (row_gain, column_gain)}
        told: dict[str, Any] = {**values, **pairs}
        return cls(**told)


def send(pipe: int, message: Mapping[str, Any]) -> None:
    """Write a message whole.

    Raises:
        OSError: Nobody is at the other end.
    """
    data = json.dumps(message).encode() + b"\n"
    while data:
        data = data[os.write(pipe, data) :]


def received(pipe: int) -> Iterator[dict[str, Any]]:
    """All messages until the other end is closed."""
    rest = b""
    while True:
        try:
            data = os.read(pipe, 1 << 16)
        except OSError:
            return
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        yield from map(json.loads, lines)
