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


def rate_interval(n_successes: int, n_trials: int) -> tuple[float, float]:
    """The 68 % interval of a rate, after Wilson (J. Am. Stat. Assoc. 22, 209, 1927).

    Returns:
        Its lower and upper end, fractions.

    Example:
        >>> [round(end, 3) for end in rate_interval(5, 10)]
        [0.349, 0.651]
    """
    k, n = n_successes, n_trials
    centre = (k + 0.5) / (n + 1)
    half = math.sqrt(k * (n - k) / n + 0.25) / (n + 1)
    return max(0.0, centre - half), min(1.0, centre + half)


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
