"""The line of a file that a problem is in, with a caret under the place."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from labseq.errors import Problem

_WIDEST: Final = 100
_WORD: Final = re.compile(r"\"[^\"]*\"?|'[^']*'?|[^\s,:\[\]{}]+(?: (?![#])[^\s,:\[\]{}]+)*")


def excerpt(problem: Problem) -> list[str]:
    """Show the line as compilers do.

    Args:
        problem: A problem; without a line, or if its file cannot be read, nothing is shown.

    Returns:
        The line with its number, and a line with carets below the word that is meant.
    """
    line = _line_of(problem)
    if line is None or not line.strip():
        return []
    start = min(problem.column - 1, len(line))
    word = _WORD.match(line, start)
    length = max(1, (word.end() if word else start + 1) - start)
    shift = max(0, start + length + 8 - _WIDEST) if len(line) > _WIDEST else 0
    shift = min(shift, start)
    shown = line[shift : shift + _WIDEST].rstrip()
    number = f"{problem.line:>5} | "
    # a tab takes as much room above as below
    pad = "".join("\t" if char == "\t" else " " for char in line[shift:start])
    carets = "^" * min(length, max(1, _WIDEST - (start - shift)))
    return [number + shown, " " * 5 + " | " + pad + carets]


def _line_of(problem: Problem) -> str | None:
    if not problem.line or not problem.column:
        return None
    try:
        text = Path(problem.source).read_bytes().decode("utf-8-sig", errors="replace")
    except (OSError, ValueError):
        return None
    lines = re.split(r"\r\n|\r|\n", text)
    if problem.line > len(lines):
        return None
    line = lines[problem.line - 1]
    return "".join(char if char.isprintable() or char == "\t" else "?" for char in line)
