"""Arguments that typer refuses: told as it tells them, and as JSON where that was asked for."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, cast

import typer

from labseq.cli.output import say
from labseq.errors import ConfigError, RecordingError

USAGE_ERROR: Final[type[Exception]] = typer.BadParameter.__mro__[1]
"""typer's base of all that can be wrong with arguments; it has no public name of its own."""


def refuse(error: Exception, arguments: Sequence[str]) -> int:
    """Say what is wrong on stderr; and as the command's JSON, if ``--json`` stands among the arguments.

    Args:
        error: A :data:`USAGE_ERROR`.
        arguments: Those that were refused.

    Returns:
        The exit code.
    """
    usage = cast("Any", error)
    with suppress(OSError, RecordingError):  # the exit code says it, too
        usage.show()
        options = arguments[: arguments.index("--")] if "--" in arguments else arguments
        line = _as_json(usage) if "--json" in options else ""
        if line:
            say(line)
    return int(usage.exit_code)


def _as_json(usage: Any) -> str:
    """What the command prints of a failure; "" for one whose ``--json`` names a file."""
    error = ConfigError(" ".join(str(usage.format_message()).split()))
    command = usage.ctx.info_name if usage.ctx is not None else ""
    if command == "check":
        from labseq.cli.check import refusal

        return refusal(error)
    if command in ("run", "show"):
        from labseq.cli.run import outcome

        return outcome(None, None, error)
    return ""
