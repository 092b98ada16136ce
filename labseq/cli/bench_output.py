"""What the commands of ``labseq bench`` write besides their tables."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from labseq.cli.output import say
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem

STDOUT: Final = "-"
_STEPS: Final = 10
"""How often progress is told where there is no terminal."""


def prove_writable(path: Path) -> None:
    """Find out that a file cannot be written before hours are spent.

    Raises:
        ConfigError: It cannot be written.
    """
    is_new = not path.exists()
    try:
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except (OSError, ValueError) as error:
        raise _unwritten(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Write a file.

    Raises:
        ConfigError: It cannot be written.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: Exception) -> ConfigError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return ConfigError(Problem(f"it cannot be written: {reason}", visible(str(path))))


def tell_compiling(module: str) -> None:
    """Say on stderr why it takes longer this time."""
    say(f"compiling {module}; later runs find it in the cache", stream=sys.stderr)


@contextmanager
def progress_of(what: str) -> Generator[Callable[[int, int], None]]:
    """A bar on stderr if that is a terminal, else a line now and then.

    Args:
        what: What is counted, in the plural.
    """
    if not sys.stderr.isatty():
        told = 0

        def tell(done: int, wanted: int) -> None:
            nonlocal told
            if done * _STEPS // wanted > told:
                told = done * _STEPS // wanted
                say(f"{done} of {wanted} {what}", stream=sys.stderr)

        yield tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, wanted: bar.update(task, completed=done, total=wanted)
