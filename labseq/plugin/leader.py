"""Shared code of devices that receive the start signal of another control system. See ``LeaderLink``."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final

from pydantic import Field

from labseq.errors import DeviceError, DeviceTimeoutError, one_of
from labseq.roles import Context, LeaderDialogue, Simulation
from labseq.settings import Duration, PositiveDuration, Settings
from labseq.units import format_quantity

__all__ = [
    "GO",
    "LEADER",
    "LeaderLog",
    "LeaderSettings",
    "check_signal",
    "load_atoms",
    "load_until_go",
    "speaking_leader",
]

GO: Final = "go"
"""The start signal."""
LEADER: Final = "leader"
"""Name of the clock of steps that the other control system carries out."""


class LeaderSettings(Settings):
    """Settings for any connection to another control system."""

    deadline: PositiveDuration = Field(
        default=10.0, description="longest time from `go` to `ready` or `failed`"
    )
    simulated_go_delay: Duration = Field(
        default=0.5,
        description="with a simulated control system, time after which it sends `go`, while atoms load",
    )


class LeaderLog:
    """Messages about the other control system, for ``LeaderLink.new_events``."""

    def __init__(self) -> None:
        self._events: deque[str] = deque(maxlen=100)  # a noisy line must not fill the memory

    def note(self, text: str) -> None:
        """Keep a message."""
        self._events.append(text)

    def note_refused(self) -> None:
        """`go` came during a shot."""
        self.note("`go` came while labseq was busy, and was refused")

    def note_unawaited(self) -> None:
        """The deadline of a `go` has passed before a step waited for it."""
        self.note("no step waited for `go` before its deadline; the leader received `failed`")

    def note_late(self) -> None:
        """The deadline of a `go` has passed during its shot."""
        self.note("the shot is not over at the deadline; the leader received `failed`")

    def new_events(self) -> list[str]:
        """The messages since the last call."""
        new_events = [*self._events]
        self._events.clear()
        return new_events


def speaking_leader(devices: Mapping[str, object], name: str = "") -> str:
    """Why no device can pass a step to another control system, or "" if one can.

    Args:
        devices: All hardware of the profile.
        name: Name of the device. "" for the only such device.
    """
    able = [other for other, device in devices.items() if isinstance(device, LeaderDialogue)]
    if not able:
        hint = "`leader: {use: tcp_leader}` among its `devices`"
        return f"the profile has no device that connects to a leader; expected {hint}"
    if name in able or (not name and len(able) == 1):
        return ""
    return f"expected {one_of(able)} as `device`"


def check_signal(signal: str, device: str) -> None:
    """Refuse to wait for anything but `go`.

    Raises:
        DeviceError: The signal is another one.
    """
    if signal != GO:
        raise DeviceError(device, f"unknown signal '{signal}'; expected '{GO}'")


def load_until_go(context: Context, delay_s: float, timeout_s: float) -> None:
    """Do what a simulated control system does before it sends `go`: load the atoms.

    Args:
        context: The context of the device.
        delay_s: Loading time, in seconds of the session's clock.
        timeout_s: Longest wait of the device for `go`.

    Raises:
        DeviceTimeoutError: `go` comes too late.
    """
    if delay_s > timeout_s:
        context.clock.sleep(timeout_s)
        text = f"the simulated leader sends '{GO}' after {format_quantity(delay_s, 'time')}"
        raise DeviceTimeoutError(context.name, f"{text}; see 'simulated_go_delay'", timeout_s)
    load_atoms(context, delay_s)


def load_atoms(context: Context, duration_s: float) -> None:
    """Load the simulated lab like the other control system, unless this shot has atoms already.

    At a second wait in a shot, the atoms are the rearranged ones.
    """
    start_s = context.clock.now()
    context.clock.sleep(duration_s)
    simulation: Simulation | None = context.simulation
    if simulation is not None and ((truth := simulation.truth()) is None or not truth.any()):
        simulation.load(start_s, duration_s)
