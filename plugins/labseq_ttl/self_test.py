"""What can be tested of a box without a change on any line."""

from __future__ import annotations

import time
from typing import Final

from labseq.plugin import DeviceError, format_quantity
from labseq_ttl.connection import SIMULATED_MAX_WAIT_S, Connection
from labseq_ttl.protocol import EDGES, LONGEST, OUTPUTS, SHORTEST, TICK_S, Edge

BLANK_TICKS: Final = 200_000
EARLY: Final = 0.95
"""The box may be so much faster than this computer says; it may be slower, which is the computer's fault."""


def check_box(connection: Connection, slot: int, device: str, polarity: int) -> None:
    """Write a program, read it back, and play one that changes no line.

    Args:
        connection: The box; no program runs.
        slot: Where the program may be.
        device: Name of the box, for messages.
        polarity: Outputs that are low when they are on.

    Raises:
        DeviceError: The box does something else.
    """
    box = connection.box
    written = pattern()
    box.put(slot, written)
    for i, edge in enumerate(written):
        if (read := box.get(slot, i)) != edge:
            raise DeviceError(device, f"edge {i} in slot {slot} reads {read}; expected {edge}")
    on = box.state().on
    box.put(slot, ((0, on), (BLANK_TICKS, on)))
    box.arm(slot, 2)
    started_s, wanted_s = time.monotonic(), BLANK_TICKS * TICK_S
    box.fire()
    if connection.counterpart is not None:
        connection.counterpart.played(polarity)
    new_events = box.line.new_events(SIMULATED_MAX_WAIT_S)
    took_s = time.monotonic() - started_s
    if new_events is None or new_events[0] != "done":
        said = "nothing" if new_events is None else " ".join(new_events)
        raise DeviceError(device, f"at the end of a program the box says '{said}'; expected 'done'")
    if connection.counterpart is None and took_s < EARLY * wanted_s:
        text = f"the box played {format_quantity(wanted_s, 'time')} in {format_quantity(took_s, 'time')}"
        raise DeviceError(device, f"{text}; does its processor run at 16 MHz?")


def pattern() -> tuple[Edge, ...]:
    """Edges in which every bit is once 0 and once 1."""
    first = (0, OUTPUTS & 0x5555)
    others = [(LONGEST ^ i, OUTPUTS & 0xAAAA) if i % 2 else (SHORTEST + i, OUTPUTS) for i in range(1, EDGES)]
    return first, *others
