"""The messages between labseq and the streaming process, lines of JSON through two pipes.

labseq's first line is a :class:`Setup`. Then come commands, each with a key ``do``:

==========  =====================================  ==============================================
``do``      further keys                           answer
==========  =====================================  ==============================================
``loop``    ``id``, ``file``, ``fade_s``           ``{"done": id}`` when it is at the connectors
``ramp``    ``id``, ``depth``, ``duration_s``      the same
``release``  ``id``, ``n_samples``                 the same; silence, then the loop at the same depth
``leave``   ``id``                                 the same; it then goes on without labseq
``end``     none                                   none: it ramps down, closes the radio and ends
``beat``    none                                   none: shows that labseq is alive
==========  =====================================  ==============================================

The process sends ``{"facts": ...}`` or ``{"failed": text}`` once, then ``{"status": ...}`` regularly,
and ``{"ended": text}`` if it ends for another reason than ``end``. The status counts each error that a
stream survives: ``{"all": {"underflows": 2}, "lit": {"underflows": 1}}``, "lit" while the array was on.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

REF_LOCKED, LO_LOCKED = "ref_locked", "lo_locked"
"""Sensors of a radio for its clocks and its local oscillators, by their names in UHD."""


@dataclass(frozen=True, slots=True)
class Setup:
    """The first message to the streaming process.

    Attributes:
        device: Arguments that open the radio.
        stream: Arguments of its stream.
        channels: Channel of the row axis and of the column axis.
        rate_hz: Sample rate.
        oscillator_hz: Frequency of the local oscillators, without their offset.
        lo_offset_hz: Distance of the local oscillators from it.
        bandwidth_hz: Bandwidth of the analog filters, None to let the radio choose.
        gain_db: Gain of each axis, None for the lowest.
        antenna: Name of the connector, "" to let the radio choose.
        clock_source: Reference of its clocks, "" to let the radio choose.
        ramp_s: Duration of the ramp to zero at its end.
        max_wait_s: How long labseq may be silent.
        marker: File that the process writes when it continues without labseq. Deleting it ends the process.
    """

    device: str
    stream: str
    channels: Sequence[int]
    rate_hz: float
    oscillator_hz: float
    lo_offset_hz: float
    bandwidth_hz: float | None
    gain_db: Sequence[float | None]
    antenna: str
    clock_source: str
    ramp_s: float
    max_wait_s: float
    marker: str


@dataclass(frozen=True, slots=True)
class Facts:
    """The radio's report after it was set up.

    Attributes:
        radio: Driver, hardware, serial number and the like.
        rate_hz: Sample rate.
        zero_hz: Frequency at which constant samples are played, of the row and the column channel.
        oscillator_hz: Their local oscillators.
        gain_db: Their gains.
        locks: Which clocks and local oscillators are locked, where the radio has sensors for that.
        buffered: Number of samples in its buffer when it takes no more.
        starts_together: Whether both channels started at one time.
        no_real_time: Why the process has no real-time priority, "" if it has.
    """

    radio: Mapping[str, str]
    rate_hz: float
    zero_hz: Sequence[float]
    oscillator_hz: Sequence[float]
    gain_db: Sequence[float]
    locks: Mapping[str, bool]
    buffered: int = 0
    starts_together: bool = True
    no_real_time: str = ""


def unlocked(locks: Mapping[str, bool], clock_source: str) -> list[str]:
    """Which of the radio's locks are open that must not be. Its own clock follows no reference."""
    own = (REF_LOCKED,) if clock_source in ("", "internal") else ()
    return [name for name, is_locked in locks.items() if not is_locked and name not in own]


def send(pipe: int, message: Mapping[str, Any]) -> None:
    """Write a message.

    Raises:
        OSError: The other end is closed.
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
