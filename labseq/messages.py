"""Parts of error messages, such as values as the user wrote them, lists of names and the nearest name."""

from __future__ import annotations

import difflib
import sys
import traceback
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from itertools import accumulate, islice
from typing import Any, Final

_MAX_LENGTH: Final = 60
_MAX_LISTED: Final = 50
MAX_ERROR: Final = 2000
"""Maximum number of characters of an error's text that labseq shows, logs and records."""


def install_hint(extra: str, package: str = "labseq") -> str:
    """The command that installs a package here, which is ``uv pip`` in environments that have no pip.

    Args:
        extra: The extra of the package, for example "plot". "" for the package alone.
        package: Its name.
    """
    requirement = f"'{package}[{extra}]'" if extra else package
    return f"{'pip' if find_spec('pip') else 'uv pip'} install {requirement}"


def missing_package(package: str, extra: str = "") -> str:
    """Message that a simulated device needs a Python package, or "" if the package is installed.

    Args:
        package: Its import name.
        extra: The extra of labseq that installs it. "" if it is installed by its own name.
    """
    if find_spec(package) is not None:
        return ""
    install = install_hint(extra) if extra else install_hint("", package)
    return f"the simulated device needs the Python package '{package}', which is not installed ({install})"


def visible(text: str) -> str:
    """A text with unprintable characters as escapes."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def clean(text: str) -> str:
    """A text on one line, shortened to 60 characters, with unprintable characters as escapes."""
    return visible(text if len(text) <= _MAX_LENGTH else text[: _MAX_LENGTH - 3] + "...")


def error_text(error: BaseException) -> str:
    r"""The text of an error, on one line of limited length, or "" if it has none.

    Example:
        >>> print(error_text(ValueError("no\nanswer\x1b[2J")))
        no answer\x1b[2J
    """
    return one_line(str(error))


def format_error(error: BaseException) -> str:
    """Kind and text of an error. For a group, its first error is appended.

    Example:
        >>> format_error(KeyError("typo"))
        "KeyError: 'typo'"
    """
    kind, text = type(error).__name__, error_text(error)
    text = f"{kind}: {text}" if text else kind
    if isinstance(error, BaseExceptionGroup):
        return one_line(f"{text}; the first: {format_error(error.exceptions[0])}")
    return text


def format_plugin_error(error: BaseException) -> str:
    """Kind and text of an error in a plugin, with the file and line, as in "KeyError: 'typo' (mine.py:7)"."""
    return format_error(error) + _plugin_line(error)


def _plugin_line(error: BaseException) -> str:
    """The last line of plugin code in the traceback, as " (FILE:LINE)", or "" if there is none."""
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__)]):
        names = accumulate(str(frame.f_globals.get("__name__", "")).split("."), "{}.{}".format)
        # every plugin's module has this attribute, and no other module does
        if any(hasattr(sys.modules.get(name), "LABSEQ_API") for name in names):
            return f" ({visible(frame.f_code.co_filename)}:{line})"
    return ""


def one_line(text: str) -> str:
    """A text on one line of limited length, with unprintable characters as escapes."""
    line = visible(" ".join(text[: MAX_ERROR + 1].split()))
    return line if max(len(text), len(line)) <= MAX_ERROR else f"{line[:MAX_ERROR]} ..."


def shown(value: Any, raw: str = "") -> str:
    """A value as a message quotes it.

    Args:
        value: The value.
        raw: The value as it is written in the file. Only used for numbers.

    Example:
        >>> shown("45 ms"), shown(True), shown([1, 2]), shown(None)
        ("'45 ms'", 'true', 'a list', 'empty')
    """
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{clean(value)}'"
    if isinstance(value, Mapping):
        return "a mapping"
    return "a list" if isinstance(value, list) else clean(raw or str(value))


def listing(names: Iterable[str]) -> str:
    """The known names as "one of rows, cols". A very long list is cut off."""
    all_names = list(names)
    more = [f"and {len(all_names) - _MAX_LISTED} more"] if len(all_names) > _MAX_LISTED + 1 else []
    return ("one of " if len(all_names) > 1 else "") + ", ".join(
        all_names[:_MAX_LISTED] + more if more else all_names
    )


def closest(name: str, names: Iterable[str], most: int | None = 300) -> str:
    """The known name with the most similar spelling, ignoring case and dashes, or "" if none is similar.

    Comparing takes 10 us for each name, so at most ``most`` names are compared. None compares all.
    """
    folded = {candidate.lower().replace("-", "_"): candidate for candidate in islice(names, most)}
    matches = difflib.get_close_matches(name.lower().replace("-", "_")[:_MAX_LENGTH], folded, n=1)
    return folded[matches[0]] if matches else ""


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """The question whether the most similar known name was meant, or "" if none is similar.

    Example:
        >>> did_you_mean("winow", ["cycles", "window"])
        "did you mean 'window'?"
    """
    close = closest(name, names)
    return f"did you mean '{close}'?" if close else ""
