"""The live view of a run in a terminal."""

from __future__ import annotations

import io
import math
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

from labseq.cli.glyphs import UNICODE, glyphs_for
from labseq.cli.log_lines import LogLines
from labseq.cli.picture import draw
from labseq.cli.tally import Tally
from labseq.cli.telling import LASTING, event_text
from labseq.roles import RunObserver

REDRAW_S: Final = 0.25
"""The view is drawn at most this often."""

_BETWEEN_SHOTS: Final = frozenset(
    {"run_started", "leader_awaited", "shot_finished", "shot_repeated", "run_finished"}
)


class ClosableObserver(RunObserver, Protocol):
    """An observer that must be told when the run is over, in whatever way."""

    def refresh(self) -> None:
        """Show what has been told so far."""
        ...

    def close(self) -> None:
        """Leave the screen in order."""
        ...


def observer_for(stream: TextIO, run_now: Callable[[], float] | None = None) -> ClosableObserver:
    """The live view if the stream is a terminal that can show it, else plain lines.

    Args:
        stream: Where it is shown.
        run_now: Time of the run in seconds, where that is not the time of this process.
    """
    if stream.isatty() and os.environ.get("TERM", "") not in {"dumb", "unknown"}:
        return LiveView(Console(file=stream), run_now=run_now)
    return LogLines(stream)


class LiveView:
    """Implements ``RunObserver`` with a picture of the run that is drawn again and again.

    It is drawn from events only, never by a thread of its own, so never while a
    device is called; and with real hardware only between shots, since atoms are
    lost while the loop waits for a screen.

    Args:
        console: The terminal.
        now: Monotonic time in seconds.
        run_now: Time of the run in seconds; by default the same.
    """

    def __init__(
        self,
        console: Console,
        now: Callable[[], float] = time.monotonic,
        run_now: Callable[[], float] | None = None,
    ) -> None:
        self._console = console
        self._now = now
        self._glyphs = glyphs_for(console.encoding)
        self._tally = Tally(run_now or now)
        self._recent: deque[str] = deque(maxlen=3)
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")
        self._drawn_s = -math.inf

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Take an event into account and draw if it is time."""
        self._tally.note(name, values)
        text = event_text(name, values, self._tally.record)
        if text and name in LASTING:
            self._print(text)
        elif text:
            self._recent.append(text)
        if name == "run_starting":
            self._live.start()
            self._draw()
        elif name == "run_finished":
            self.close()
        elif self._is_time(name):
            self._draw()

    def refresh(self) -> None:
        """Draw now, as far as the view is on."""
        if self._live.is_started:
            self._draw()

    def close(self) -> None:
        """Draw a last time and give the terminal back; any number of times."""
        if self._live.is_started:
            try:
                self._draw()
            finally:
                self._live.stop()

    def export_svg(self, path: Path, width: int = 110, height: int = 27) -> None:
        """Write the present view as a picture that needs no fonts from elsewhere.

        Args:
            path: The SVG file.
            width: Columns of the terminal that is shown.
            height: Lines of it.
        """
        console = Console(
            record=True, file=io.StringIO(), width=width, height=height, color_system="truecolor"
        )
        console.print(draw(self._tally, list(self._recent), width, height, UNICODE))
        svg = console.export_svg(title="labseq run")
        path.write_text(re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL), "utf-8")

    def _is_time(self, name: str) -> bool:
        run = self._tally.record
        may_draw = name in _BETWEEN_SHOTS or (run is not None and run.simulated)
        return self._live.is_started and may_draw and self._now() - self._drawn_s >= REDRAW_S

    def _draw(self) -> None:
        self._drawn_s = self._now()
        width, height = self._console.size
        picture = draw(self._tally, list(self._recent), width, height, self._glyphs)
        self._live.update(picture, refresh=True)

    def _print(self, text: str) -> None:
        self._console.print(Text(text), soft_wrap=True)
