"""What somebody else's code raised, in words."""

from __future__ import annotations

from typing import Final

MAX_WORDS: Final = 500
"""Characters of a plugin's own error that are told."""


def format_error(error: BaseException) -> str:
    """Kind and text of an error that somebody else's code raised, in one line that is not too long.

    Example:
        >>> in_words(KeyError("typo"))
        "KeyError: 'typo'"
    """
    try:
        text = str(error)
    except (Exception, SystemExit) as another:  # noqa: BLE001 - it may raise anything
        text = f"(its text cannot be had: {type(another).__name__})"
    text = " ".join(f"{type(error).__name__}: {text[: 2 * MAX_WORDS]}".split()).rstrip(":")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= MAX_WORDS else f"{text[:MAX_WORDS]} ..."
