"""From an exception to words on stderr and an exit code."""

from __future__ import annotations

import errno
import sys
import traceback
from contextlib import suppress
from typing import Final

from labseq.cli.excerpt import excerpt
from labseq.cli.output import say
from labseq.cli.words import plural
from labseq.errors import ConfigError, LabseqError, RecordingError, StopRequested

EXIT_SIGNALLED: Final = 128
"""Added to the signal's number, as shells do: 130 for Ctrl-C, 143 for SIGTERM."""
EXIT_INTERRUPTED: Final = EXIT_SIGNALLED + 2
EXIT_INTERNAL: Final = 1
MAX_REPORTED: Final = 50
"""Problems of a file that are told; a file with more of them is not what it was taken for."""


def report(error: BaseException, *, debug: bool = False) -> int:
    """Say on stderr what went wrong.

    Args:
        error: What ended the command.
        debug: Whether to print the traceback as well.

    Returns:
        The exit code.
    """
    if debug:
        traceback.print_exception(error)
    lines = format_config_error(error) if isinstance(error, ConfigError) else lines_of(error)
    with suppress(OSError, RecordingError):  # the exit code says it, too
        say(*lines, stream=sys.stderr)
    return exit_code_of(error)


def format_config_error(error: ConfigError) -> list[str]:
    """Every problem with the line that it is in, and what else there is to look at.

    Of very many problems only the first are told.
    """
    lines: list[str] = []
    for problem, text in zip(error.problems[:MAX_REPORTED], lines_of(error), strict=False):
        lines += [text, *excerpt(problem), *(f"      = {note}" for note in problem.notes)]
    n_more = len(error.problems) - MAX_REPORTED
    return [*lines, f"and {plural(n_more, 'more problem')}"] if n_more > 0 else lines


def lines_of(error: BaseException) -> list[str]:
    """The message for the user.

    A problem in a file starts with its place, as compilers print it.

    Example:
        >>> lines_of(ConfigError("a session runs once"))
        ['error: a session runs once']
    """
    if isinstance(error, ConfigError):
        return [str(p) if p.source else f"error: {p}" for p in error.problems]
    if isinstance(error, StopRequested):
        return [str(error)]
    if isinstance(error, LabseqError):
        return [f"error: {error}"]
    if isinstance(error, KeyboardInterrupt):
        return ["stopped by Ctrl-C"]
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return [f"error: {error.filename or 'output'} cannot be written: {error.strerror}"]
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return [f"internal error: {text}; please report it; run again with --debug to see where"]


def exit_code_of(error: BaseException) -> int:
    """The exit code of a command that ended so.

    Example:
        >>> exit_code_of(StopRequested(15))
        143
    """
    if isinstance(error, StopRequested):
        return EXIT_SIGNALLED + error.signal_number
    if isinstance(error, LabseqError):
        return error.exit_code
    return EXIT_INTERRUPTED if isinstance(error, KeyboardInterrupt) else EXIT_INTERNAL
