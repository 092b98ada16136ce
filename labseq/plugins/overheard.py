"""What a plugin prints while it is loaded: heard, and led to stderr."""

from __future__ import annotations

import sys
from typing import Any, Final, TextIO

MAX_HEARD: Final = 200
"""Characters that are remembered."""


class RedirectedStdout:
    """Stands in for ``sys.stdout``: stdout may belong to a program that reads JSON from it.

    A plugin may keep it; afterwards it leads to where stdout led before.
    """

    def __init__(self, real: TextIO | Any) -> None:
        self._real = real
        self._is_over = False
        self._text = ""

    def restore(self) -> list[str]:
        """End it.

        Returns:
            What it heard, a sentence.
        """
        self._is_over = True
        heard: list[str] = []
        if sys.stdout is not self:
            heard.append(
                "it replaced sys.stdout; this was put back: change it only around the calls that need it"
            )
        sys.stdout = self._real
        if words := " ".join(self._text.split()):
            heard.append(
                f"it printed ('{words[:60]}'); this went to stderr: use 'logging.getLogger(__name__)'"
            )
        return heard

    def write(self, text: str) -> int:
        """Write to stderr, or once it is over to the real stdout."""
        if not self._is_over:
            self._text = (self._text + text)[:MAX_HEARD]
        stream = self._stream
        return len(text) if stream is None else stream.write(text)

    @property
    def _stream(self) -> Any:
        return self._real if self._is_over else sys.stderr

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
