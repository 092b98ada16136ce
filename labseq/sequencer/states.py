"""The states of a run, and which may follow which."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from types import MappingProxyType
from typing import Final


class State(Enum):
    """Where a run stands."""

    CLOSED = "closed"
    OPENING = "opening"
    IDLE = "idle"
    """Between shots: mobile tweezers silent, camera not exposing, static tweezers on."""
    SHOT = "shot"
    WRITING = "writing"
    RECOVERING = "recovering"
    """After a failure that does not end the run: what may be busy is silenced."""
    REOPENING = "reopening"
    """Between shots: devices whose settings change are closed through their safe state and opened anew."""
    MAKING_SAFE = "making safe"
    SAFE = "safe"
    CLOSING = "closing"


TRANSITIONS: Final = MappingProxyType(
    {
        State.CLOSED: frozenset({State.OPENING}),
        State.OPENING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.IDLE: frozenset({State.SHOT, State.REOPENING, State.MAKING_SAFE}),
        State.REOPENING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.SHOT: frozenset({State.WRITING, State.RECOVERING, State.MAKING_SAFE}),
        State.RECOVERING: frozenset({State.WRITING, State.SHOT, State.MAKING_SAFE}),
        State.WRITING: frozenset({State.IDLE, State.MAKING_SAFE}),
        State.MAKING_SAFE: frozenset({State.SAFE, State.MAKING_SAFE}),
        State.SAFE: frozenset({State.CLOSING}),
        State.CLOSING: frozenset({State.CLOSED, State.MAKING_SAFE}),
    }
)
"""The state table: state -> states that may follow.

Every state in which a device may be on leads to MAKING_SAFE; an ending that was itself cut short begins anew.
"""


class StateTable:
    """Holds the state and refuses a change that the table does not declare."""

    def __init__(self, changed: Callable[[State], None]) -> None:
        self.state = State.CLOSED
        self._changed = changed

    def to(self, state: State) -> None:
        """Change the state."""
        if state not in TRANSITIONS[self.state]:
            raise AssertionError(f"a run cannot go from {self.state.value} to {state.value}")
        self.state = state
        self._changed(state)
