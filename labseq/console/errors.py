"""Errors on the terminal: the faulty line of a file with a caret below it, and exit codes."""

from __future__ import annotations

import codecs
import errno
import re
import shutil
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from labseq.console.output import say
from labseq.console.text import plural
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, StopRequested
from labseq.messages import MAX_ERROR, error_text, format_error, visible

_WIDEST: Final = 100
_MARGIN: Final = 8  # "   12 | "
_PLAIN: Final = r"(?:[^\s,:\[\]{}]|:(?=[^\s,\[\]{}]))+"
_WORD: Final = re.compile(rf"\"[^\"]*\"?|'[^']*'?|{_PLAIN}(?: (?!#){_PLAIN})*")


def excerpt(problem: Problem) -> list[str]:
    """Show the line or option of a problem as compilers do.

    Returns:
        The line with its number, and a line with carets below the wrong word. Empty if the problem
        has no column, or its file cannot be read.
    """
    from rich.cells import cell_len

    line = _line_of(problem)
    if line is None or not line.strip():
        return []
    widest = max(20, min(_WIDEST, shutil.get_terminal_size((_WIDEST + _MARGIN, 24)).columns - _MARGIN))
    start = min(problem.column - 1, len(line))
    word = _WORD.match(line, start)
    end = max(start + 1, word.end() if word else 0)
    shift = min(start, max(0, end + _MARGIN - widest)) if len(line) > widest else 0
    while shift < start and cell_len(line[shift:end]) > widest:
        shift += 1
    shown = line[shift : shift + widest].rstrip()
    while cell_len(shown) > widest:
        shown = shown[:-1]
    # a tab is as wide in both lines
    pad = "".join("\t" if char == "\t" else " " * cell_len(char) for char in line[shift:start])
    carets = "^" * max(1, min(cell_len(line[start:end]), widest - cell_len(line[shift:start])))
    return [f"{problem.line or '':>5} | {shown}", " " * 5 + " | " + pad + carets]


def _line_of(problem: Problem) -> str | None:
    if not problem.column:
        return None
    if not problem.line:  # an option, which is its own line
        return problem.source
    try:
        data = Path(problem.source).read_bytes()
    except (OSError, ValueError):
        return None
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return None
    text = data.decode("utf-8-sig", errors="replace")
    lines = re.split(r"\r\n|\r|\n", text)
    if problem.line > len(lines):
        return None
    line = lines[problem.line - 1]
    return "".join(char if char.isprintable() or char == "\t" else "?" for char in line)


EXIT_SIGNALLED: Final = 128
"""Added to the signal's number, as shells do: 129 for SIGHUP, 130 for Ctrl-C, 143 for SIGTERM."""
EXIT_INTERRUPTED: Final = EXIT_SIGNALLED + 2
EXIT_INTERNAL: Final = 1
EXIT_CODES: Final = {
    "0": "done",
    "1": "a planner failed or broke a rule, the disk is full, or labseq itself failed",
    "2": "a mistake in a file, an option or a setting, or a request that exceeds a limit",
    "3": "a device failed, did not answer, or could not be made safe",
    "129, 130, 143": "stopped because the terminal was closed, by Ctrl-C, or by SIGTERM or `labseq stop`",
}
"""Exit codes of the commands -> meaning."""
MAX_REPORTED: Final = 50
"""Maximum number of problems of a file that are printed. A file with more is probably not for labseq."""


def report(error: BaseException, *, debug: bool = False) -> int:
    """Print an error on stderr, with the traceback if ``debug``.

    Returns:
        The exit code.
    """
    lines = format_config_error(error) if isinstance(error, ConfigError) else lines_of(error)
    if debug:
        lines = [*_traceback(error), *lines]
    with suppress(OSError, RecordingError):  # the exit code reports it, too
        say(*lines, stream=sys.stderr)
    return exit_code_of(error)


def _traceback(error: BaseException) -> list[str]:
    """The traceback of an error. Its text may be very long, or contain control characters."""
    parts = traceback.format_exception(error)
    return [visible(line) for part in parts for line in part[:MAX_ERROR].splitlines()]


def format_config_error(error: ConfigError) -> list[str]:
    """Every problem with its line and its notes, or only the first of very many problems."""
    lines: list[str] = []
    for problem, text in zip(error.problems[:MAX_REPORTED], lines_of(error), strict=False):
        lines += [text, *excerpt(problem), *(f"      = {note}" for note in problem.notes)]
    n_more = len(error.problems) - MAX_REPORTED
    return [*lines, f"and {plural(n_more, 'more problem')}"] if n_more > 0 else lines


def warning_lines(warning: Problem) -> list[str]:
    """A warning about a place in a file, with its line."""
    return [f"warning: {warning}", *excerpt(warning), *(f"      = {note}" for note in warning.notes)]


def json_errors(error: BaseException) -> dict[str, Any]:
    """The errors of a refused file in the form of a report."""
    problems = error.problems if isinstance(error, ConfigError) else [Problem(t) for t in lines_of(error)]
    return {"problems": problems, "warnings": []}


def lines_of(error: BaseException) -> list[str]:
    """The message for the user. A problem in a file starts with its place, as compilers print it.

    Example:
        >>> lines_of(ConfigError("a session runs once"))
        ['error: a session runs once']
    """
    match error:
        case ConfigError():
            return [str(p) if p.source else f"error: {p}" for p in error.problems]
        case StopRequested():
            return [str(error)]
        case LabseqError():
            return [f"error: {error_text(error)}"]
        case KeyboardInterrupt():
            return ["stopped by Ctrl-C"]
        case OSError(errno=errno.ENOSPC):
            return [f"error: {error.filename or 'output'} cannot be written: {error.strerror}"]
        case _:
            advice = "please report it with the traceback that --debug prints"
            return [f"internal error: {format_error(error)}; {advice}"]


def exit_code_of(error: BaseException) -> int:
    """The exit code of a command that ended with an error.

    Example:
        >>> exit_code_of(StopRequested(15))
        143
    """
    if isinstance(error, StopRequested):
        return EXIT_SIGNALLED + error.signal_number
    if isinstance(error, LabseqError):
        return error.exit_code
    return EXIT_INTERRUPTED if isinstance(error, KeyboardInterrupt) else EXIT_INTERNAL
