"""The line of a file that a problem is in, with a caret under the place."""

from __future__ import annotations

import codecs
import re
import shutil
import unicodedata
from pathlib import Path
from typing import Final

from labseq.errors import Problem

_WIDEST: Final = 100
_MARGIN: Final = 8  # "   12 | "
_PLAIN: Final = r"(?:[^\s,:\[\]{}]|:(?=[^\s,\[\]{}]))+"
_WORD: Final = re.compile(rf"\"[^\"]*\"?|'[^']*'?|{_PLAIN}(?: (?!#){_PLAIN})*")


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
    widest = max(20, min(_WIDEST, shutil.get_terminal_size((_WIDEST + _MARGIN, 24)).columns - _MARGIN))
    start = min(problem.column - 1, len(line))
    word = _WORD.match(line, start)
    end = max(start + 1, word.end() if word else 0)
    shift = min(start, max(0, end + _MARGIN - widest)) if len(line) > widest else 0
    while _width(line[shift:start]) >= widest:
        shift += 1
    shown = line[shift : shift + widest].rstrip()
    while _width(shown) > widest:
        shown = shown[:-1]
    # A tab takes as much room above as below.
    pad = "".join("\t" if char == "\t" else " " * _width(char) for char in line[shift:start])
    carets = "^" * max(1, min(_width(line[start:end]), widest - _width(line[shift:start])))
    return [f"{problem.line:>5} | {shown}", " " * 5 + " | " + pad + carets]


def _width(text: str) -> int:
    """Columns of a terminal that a text takes."""
    narrow = len(text) - sum(unicodedata.combining(char) != 0 for char in text)
    return narrow + sum(unicodedata.east_asian_width(char) in "WF" for char in text)


def _line_of(problem: Problem) -> str | None:
    if not problem.line or not problem.column:
        return None
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
