"""A run told line by line, where there is no terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, TextIO

from labseq.cli.output import say
from labseq.cli.telling import LASTING, event_text
from labseq.model import RunRecord

_TOLD: Final = LASTING | {"shot_finished", "scan_point", "scan_ended"}


class LogLines:
    """Implements ``RunObserver`` with plain lines of text.

    Args:
        stream: Where they go.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._run: RunRecord | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print a line if the event is worth one."""
        if name == "run_starting":
            self._run = values["record"]
        text = event_text(name, values, self._run) if name in _TOLD else ""
        if text:
            say(text, stream=self._stream)

    def refresh(self) -> None:
        """Every line was printed at once."""

    def close(self) -> None:
        """Nothing to leave in order."""
