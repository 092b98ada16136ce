"""Arguments brought into the form that typer can parse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_PLAIN: Final = frozenset({"doctor"})
"""Commands whose ``--dry-run`` has no value."""


def arrange(arguments: Sequence[str]) -> list[str]:
    """Give ``--dry-run`` its value and move ``--debug`` to the front.

    typer knows no options whose value may be left out, and global options only
    before the command. What follows ``--`` is left alone.

    Example:
        >>> arrange(["run", "--dry-run", "a.yaml", "--debug"])
        ['--debug', 'run', '--dry-run=full', 'a.yaml']
    """
    end = arguments.index("--") if "--" in arguments else len(arguments)
    options, rest = arguments[:end], arguments[end:]
    debug = ["--debug"] if "--debug" in options else []
    command = next((option for option in options if not option.startswith("-")), "")
    given = {} if command in _PLAIN else {"--dry-run": "--dry-run=full"}
    return [*debug, *(given.get(option, option) for option in options if option != "--debug"), *rest]
