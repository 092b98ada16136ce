"""Numbers, counts and times as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

from labseq.units import format_quantity

MAX_REPORTED: Final = 5
"""Maximum number of failures that are printed one by one."""


def plural(n: int, noun: str) -> str:
    """Write a count with its noun.

    Example:
        >>> plural(1, "defect"), plural(2, "defect")
        ('1 defect', '2 defects')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def percent(fraction: float | None, digits: int = 1) -> str:
    """Write a fraction in per cent. "-" if it is None or nan.

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


def time_text(duration_s: float | None) -> str:
    """Write a duration with its unit. "-" if it is None or nan.

    Example:
        >>> time_text(0.0012), time_text(None)
        ('1.2 ms', '-')
    """
    if duration_s is None or math.isnan(duration_s):
        return "-"
    return format_quantity(duration_s, "time")


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
    """Write an age in its largest unit. None is for an age that the clock does not know.

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


def settings_text(settings: Mapping[str, Any]) -> str:
    """Write the settings that have a value on one line.

    Example:
        >>> settings_text({"degree_of_parallelism": 7, "max_tones": {"row": 16, "col": None}, "file": None})
        'degree_of_parallelism 7, max_tones (row 16)'
    """
    parts: list[str] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            within = settings_text(cast("Mapping[str, Any]", value))
            parts += [f"{key} ({within})"] if within else []
        elif value is not None:
            parts.append(f"{key} {value}")
    return ", ".join(parts)


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


def first_of(failures: Sequence[str], rest: str) -> list[str]:
    """The first failures, and how many more there are.

    Example:
        >>> first_of(["no light", "no frame"], "more"), first_of(list("abcdefg"), "more")[-1]
        (['no light', 'no frame'], 'and 2 more')
    """
    n_more = len(failures) - MAX_REPORTED
    return [*failures[:MAX_REPORTED], *([f"and {n_more} {rest}"] if n_more > 0 else [])]
