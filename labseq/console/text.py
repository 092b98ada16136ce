"""Numbers, counts, times and tables as text."""

from __future__ import annotations

import math
import re
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, cast


def columns(rows: Sequence[Sequence[str]], right: Sequence[int] = (), most: int = 0) -> list[str]:
    """Lay out rows in columns two spaces apart.

    Where stdout is a terminal that is too narrow for the table, texts are wrapped between words; columns
    that still do not fit follow in a second table. A word that is wider than the terminal, such as a path,
    stays whole. In a pipe or a file every row stays one line.

    Args:
        rows: The cells; all rows have the same number of them.
        right: Indices of the columns that are aligned on the right; below the header they are not wrapped.
        most: Maximum number of rows below the header, 0 for all; the middle ones are left out.

    Example:
        >>> columns([["image", "45 ms"], ["load", "500 ms"]], right=[1])
        ['image   45 ms', 'load   500 ms']
    """
    if 0 < most < len(rows) - 1:
        gap = ["...", *[""] * (len(rows[0]) - 1)]
        rows = [*rows[: most // 2 + 1], gap, *rows[-(most // 2) :]]
    table = [list(column) for column in zip(*rows, strict=True)]
    widths = [max(map(len, column)) for column in table]
    room = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    if not room or _total(widths) <= room:
        return _lines(table, right, widths)
    least = [_least(column, i in right) for i, column in enumerate(table)]
    n_fit = len(least)
    while n_fit > 2 and _total(least[:n_fit]) > room:
        n_fit -= 1
    least[n_fit - 1] = min(least[n_fit - 1], max(_MIN_WIDTH, room - _total([*least[: n_fit - 1], 0])))
    widths = widths[:n_fit]
    while _total(widths) > room and widths != least[:n_fit]:
        widest = max(range(n_fit), key=lambda i: (widths[i] > least[i], widths[i]))
        widths[widest] -= 1
    lines = _lines(table[:n_fit], right, widths)
    if n_fit == len(table):
        return lines
    rest = [0, *range(n_fit, len(table))]
    others = columns([[row[i] for i in rest] for row in rows], [k for k, i in enumerate(rest) if i in right])
    return [*lines, "", *others]


_MIN_WIDTH: Final = 10
_UNIT: Final = re.compile(r"(?<=[\d)]) (?=(?:%|[munk]?s|[munk]?m|[kMG]?Hz|[munk]?[VW]|[kMGT]B|px|degC)\b|%)")


def _words(cell: str) -> str:
    """A cell in which a number and its unit are one word."""
    return _UNIT.sub("\xa0", cell)


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def _least(column: Sequence[str], is_number: bool) -> int:
    """The width of a column below which a word or a number would be broken; a drawing is one word."""
    whole = [cell for cell in column[1:] if is_number or cell.startswith(" ")]
    words = [word for cell in column for word in _words(cell).split(" ")]
    return max(map(len, [*whole, *words]))


def _lines(table: Sequence[Sequence[str]], right: Sequence[int], widths: Sequence[int]) -> list[str]:
    lines: list[str] = []
    for row in zip(*table, strict=True):
        cells = [
            [cell]
            if len(cell) <= width
            else textwrap.wrap(_words(cell), width, break_long_words=False, break_on_hyphens=False)
            for cell, width in zip(row, widths, strict=True)
        ]
        for parts in zip_longest(*cells, fillvalue=""):
            padded = (
                part.rjust(width) if i in right else part.ljust(width)
                for i, (part, width) in enumerate(zip(parts, widths, strict=True))
            )
            lines.append("  ".join(padded).replace("\xa0", " ").rstrip())
    return lines


def plural(n: int, noun: str) -> str:
    """Write a count with its noun.

    Example:
        >>> plural(1, "defect"), plural(2, "defect")
        ('1 defect', '2 defects')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def percent(fraction: float | None, digits: int = 1) -> str:
    """Write a fraction in per cent; "-" if it is None or nan.

    Example:
        >>> percent(0.9955, 2), percent(None)
        ('99.55 %', '-')
    """
    if fraction is None or math.isnan(fraction):
        return "-"
    return f"{100 * fraction:.{digits}f} %"


def count_of(n: int, total: int) -> str:
    """Write a count, the total, and the fraction.

    Example:
        >>> count_of(7, 20), count_of(0, 0)
        ('7 of 20 (35.0 %)', '0 of 0')
    """
    return f"{n} of {total} ({percent(n / total)})" if total else "0 of 0"


def clock_time(duration_s: float) -> str:
    """Write a duration as hours, minutes and seconds.

    Example:
        >>> clock_time(83.4), clock_time(3723)
        ('1:23', '1:02:03')
    """
    minutes, seconds = divmod(round(duration_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def age_text(duration_s: float | None, suffix: str = "") -> str:
    """Write an age in its largest unit; None for one that the clock does not know.

    Example:
        >>> age_text(90), age_text(3 * 3600, " old"), age_text(None, " old")
        ('1 minute', '3 hours old', "ahead of this computer's clock")
    """
    if duration_s is None:
        return "ahead of this computer's clock"
    for unit, unit_s in (("day", 86_400), ("hour", 3600), ("minute", 60)):
        if duration_s >= unit_s:
            return plural(int(duration_s // unit_s), unit) + suffix
    return plural(int(duration_s), "second") + suffix


def size_text(n_bytes: int) -> str:
    """Write a size on disk.

    Example:
        >>> size_text(6_351_456), size_text(900)
        ('6.4 MB', '0.9 kB')
    """
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes / 1e3:.1f} kB"


def settings_text(settings: Mapping[str, Any]) -> str:
    """Write the settings that have a value on one line.

    Example:
        >>> settings_text({"degree_of_parallelism": 7, "max_tones": {"row": 16, "col": None}, "file": None})
        'degree_of_parallelism 7, max_tones (row 16)'
    """
    words: list[str] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            within = settings_text(cast("Mapping[str, Any]", value))
            words += [f"{key} ({within})"] if within else []
        elif value is not None:
            words.append(f"{key} {value}")
    return ", ".join(words)


def quoted(path: Path) -> str:
    """A path as part of a command."""
    return f'"{path}"' if " " in str(path) else str(path)


def encodes(encoding: str | None, characters: str) -> bool:
    """Whether an encoding has all of these characters.

    Example:
        >>> encodes("cp1252", "●"), encodes("utf-8", "●")
        (False, True)
    """
    try:
        characters.encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
