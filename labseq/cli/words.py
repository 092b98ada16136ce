"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast


def percent(fraction: float | None, digits: int = 1) -> str:
    """Write a fraction in per cent; "-" for none.

    Example:
        >>> percent(0.9955, 2), percent(None)
        ('99.55 %', '-')
    """
    if fraction is None or math.isnan(fraction):
        return "-"
    return f"{100 * fraction:.{digits}f} %"


def count_of(n: int, total: int) -> str:
    """Write a count, what it is of, and its fraction.

    Example:
        >>> count_of(7, 20), count_of(0, 0)
        ('7 of 20 (35.0 %)', '0 of 0')
    """
    return f"{n} of {total} ({percent(n / total)})" if total else "0 of 0"


def clock_time(duration_s: float) -> str:
    """Write a time as clocks do.

    Example:
        >>> clock_time(83.4), clock_time(3723)
        ('1:23', '1:02:03')
    """
    minutes, seconds = divmod(round(duration_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def age_text(duration_s: float) -> str:
    """Write an age by its largest unit.

    Example:
        >>> age_text(90), age_text(3 * 3600), age_text(40 * 86_400)
        ('1 minute', '3 hours', '40 days')
    """
    for unit, unit_s in (("day", 86_400), ("hour", 3600), ("minute", 60)):
        if duration_s >= unit_s:
            return plural(int(duration_s // unit_s), unit)
    return plural(max(0, int(duration_s)), "second")


def plural(n: int, noun: str) -> str:
    """Write a count with its noun.

    Example:
        >>> plural(1, "defect"), plural(2, "defect")
        ('1 defect', '2 defects')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def settings_text(settings: Mapping[str, Any]) -> str:
    """Settings that are given, in one line.

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
