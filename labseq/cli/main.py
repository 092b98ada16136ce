"""The entry point: arguments, usage errors, and leaving with the right exit code."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, NoReturn, cast

import typer

from labseq.console.output import discard_unwritten, say
from labseq.errors import ConfigError, RecordingError

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


MAX_WAIT_S: Final = 1.0
"""How long threads may take to end by themselves."""


def end_process(code: Any) -> NoReturn:
    """Leave with an exit code, also where a thread is left that Python would wait for.

    All data is on disk by now, and every device is safe: nothing is lost with such a thread.

    Args:
        code: As for ``sys.exit``.
    """
    with suppress(KeyboardInterrupt):  # Ctrl-C: no more patience
        _wait()
    names = sorted(thread.name for thread in _left_over())
    if not names:
        sys.exit(code)
    with suppress(RecordingError):
        threads = "a thread" if len(names) == 1 else f"{len(names)} threads"
        text = f"warning: {threads} of a plugin would not end: {', '.join(names)}; ended with the process"
        say(text, stream=sys.stderr)
    discard_unwritten()
    os._exit(code if isinstance(code, int) else int(code is not None))


def _wait() -> None:
    deadline = time.monotonic() + MAX_WAIT_S
    for thread in _left_over():
        thread.join(max(0.0, deadline - time.monotonic()))


def _left_over() -> list[threading.Thread]:
    """Threads that keep the process from ending."""
    here = threading.current_thread()
    return [t for t in threading.enumerate() if t is not here and not t.daemon]


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
