"""How far the commands of ``labseq bench`` are."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final

from labseq.cli.output import say

_STEPS: Final = 10
"""How often progress is told where there is no terminal."""


@contextmanager
def progress_of(what: str) -> Generator[Callable[[int, int], None]]:
    """A bar on stderr if that is a terminal, else a line now and then.

    Args:
        what: What is counted, in the plural.
    """
    if not sys.stderr.isatty():
        told = 0

        def report_progress(done: int, wanted: int) -> None:
            nonlocal told
            if done * _STEPS // wanted > told:
                told = done * _STEPS // wanted
                say(f"{done} of {wanted} {what}", stream=sys.stderr)

        yield report_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, wanted: bar.update(task, completed=done, total=wanted)
