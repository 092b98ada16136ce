"""Draw the README's picture: ``labseq run`` in a terminal, in the middle of its run.

    python docs/make_run_picture.py

The run is the README's own, with a seed; what the computer took for each stage differs from time to time.
"""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from labseq import Session
from labseq.cli.live import LiveView

DOCS = Path(__file__).parent
SEQUENCE = DOCS.parent / "sequences" / "compact_225.yaml"
PICTURE = DOCS / "_static" / "run.svg"
AFTER = 14
"""Shots that are over on the picture."""


class Photographer(LiveView):
    """The live view, without a screen; writes it as SVG after ``AFTER`` shots."""

    def __init__(self, picture: Path, after: int = AFTER) -> None:
        super().__init__(Console(file=io.StringIO(), width=110, height=27))
        self._path, self._left = picture, after

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        super().event(name, values)
        if name == "shot_finished":
            self._left -= 1
            if self._left == 0:
                screen = Console(
                    file=io.StringIO(), width=110, height=27, record=True, color_system="truecolor"
                )
                screen.print(self.picture)
                svg = screen.export_svg(title="labseq run")
                self._path.write_text(re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL), "utf-8")


def take(picture: Path = PICTURE, shots: int | None = None, after: int = AFTER) -> None:
    """Take the run, and its picture."""
    with tempfile.TemporaryDirectory() as data:
        observer = Photographer(picture, after)
        with Session.open(SEQUENCE, shots=shots, seed=1, output=Path(data), observer=observer) as session:
            session.run()


if __name__ == "__main__":
    take()
