"""What a line to a leader is for the device that speaks on it."""

from __future__ import annotations

from typing import Final, Protocol

SLICE_S: Final = 0.02
"""Longest wait for something to come: how soon a deadline is seen, and the end."""
SEND_S: Final = 0.5
"""Longest time that a line may take to be sent; a leader that reads nothing counts as gone."""


class Listener(Protocol):
    """Told what happens on a line."""

    def connected(self, who: str) -> None:
        """A leader is there."""
        ...

    def came(self, data: bytes) -> None:
        """It said something, perhaps a part of a line."""
        ...

    def lost(self, reason: str) -> None:
        """It is gone."""
        ...

    def note(self, text: str) -> None:
        """Something for the log."""
        ...


class Link(Protocol):
    """A line on which one leader at a time may come and go."""

    @property
    def address(self) -> str:
        """Where a leader finds labseq."""
        ...

    def open(self) -> None:
        """Get ready for a leader.

        Raises:
            DeviceError: It cannot be.
        """
        ...

    def serve(self, listener: Listener) -> None:
        """Wait for what happens, for at most :data:`SLICE_S`, and tell it; called again and again."""
        ...

    def send(self, line: bytes) -> None:
        """Send a line; from any thread.

        Raises:
            OSError: There is no leader, or it takes nothing.
        """
        ...

    def close(self) -> None:
        """Let the leader go; nothing serves any more."""
        ...
