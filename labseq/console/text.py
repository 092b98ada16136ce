"""Numbers, counts, times and tables as text."""

from __future__ import annotations

import io
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from typing import Any, cast


def columns(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> list[str]:
    """Lay out rows in columns two spaces apart.

    Where stdout is a terminal that is too narrow for the table, long cells are wrapped within
    their column. In a pipe or a file every row stays one line.

    Args:
        rows: The cells; all rows have the same number of them.
        right: Indices of the columns that are aligned on the right.

    Example:
        >>> columns([["image", "45 ms"], ["load", "500 ms"]], right=[1])
        ['image   45 ms', 'load   500 ms']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    room = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    if room and sum(widths) + 2 * (len(widths) - 1) > room:
        return _wrapped(rows, right, room)
    lines: list[str] = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        padded = (c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(cells))
        lines.append("  ".join(padded).rstrip())
    return lines


def _wrapped(rows: Sequence[Sequence[str]], right: Sequence[int], width: int) -> list[str]:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0), pad_edge=False)
    for i in range(len(rows[0])):
        table.add_column(justify="right" if i in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    console = Console(file=io.StringIO(), width=width, color_system=None)
    return ["".join(part.text for part in line).rstrip() for line in console.render_lines(table)]


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


def age_text(duration_s: float) -> str:
    """Write an age in its largest unit.

    Example:
        >>> age_text(90), age_text(3 * 3600), age_text(40 * 86_400)
        ('1 minute', '3 hours', '40 days')
    """
    for unit, unit_s in (("day", 86_400), ("hour", 3600), ("minute", 60)):
        if duration_s >= unit_s:
            return plural(int(duration_s // unit_s), unit)
    return plural(max(0, int(duration_s)), "second")


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
