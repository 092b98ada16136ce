"""A run told line by line, where there is no terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, TextIO

from labseq.cli.notice import FIRST_RUN, Notice
from labseq.cli.output import say
from labseq.cli.telling import LASTING, tell
from labseq.model import RunRecord

_TOLD: Final = LASTING | {"shot_finished"}


class LogLines:
    """Implements ``RunObserver`` with plain lines of text.

    Args:
        stream: Where they go.
        notice: Announces what takes long before the first shot; made if left out.
    """

    def __init__(self, stream: TextIO, notice: Notice | None = None) -> None:
        self._stream = stream
        self._notice = notice or Notice(self._print)
        self._run: RunRecord | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print a line if the event is worth one."""
        if name == "warming":
            self._notice.begin(f"preparing {values['part']}", FIRST_RUN)
            return
        self._notice.end()
        if name == "run_starting":
            self._run = values["record"]
        text = tell(name, values, self._run) if name in _TOLD else ""
        if text:
            self._print(text)

    def close(self) -> None:
        """The run is over, in whatever way."""
        self._notice.end()

    def _print(self, text: str) -> None:
        say(text, stream=self._stream)
