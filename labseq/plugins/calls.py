"""Calls of plugin code outside of a run, which load it, validate settings or construct objects."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from labseq.errors import LabseqError
from labseq.guard import Guard
from labseq.messages import format_error, one_line

if TYPE_CHECKING:
    from labseq.registry import Owner

T = TypeVar("T")

MAX_PRINTED: Final = 60
"""Maximum number of characters of a plugin's printed text in a message."""


_guard = Guard()
"""Its threads, one for each plugin, are kept, because starting a thread takes longer than most calls."""


def _renew_guard() -> None:
    """Replace the guard in a forked process, which has none of its threads."""
    global _guard  # noqa: PLW0603 - a guard is not a constant, but a process has only one
    _guard = Guard()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_guard)


def call_plugin(owner: Owner, code_name: str, work: Callable[[], T]) -> T:
    """Run code of a plugin, and name the plugin in any error.

    The code runs in another thread. If it hangs it is abandoned after ``owner.max_wait_s``, and a
    ``SystemExit`` or ``KeyboardInterrupt`` that it raises ends nothing else. Printed text goes to stderr,
    because a program may read JSON from stdout, and is recorded with the owner.

    Args:
        code_name: Name of the code for messages. "" for the loading of the plugin.

    Returns:
        The result of the code.

    Raises:
        PluginLoadError: The code raised another error, or did not return in time.
        LabseqError: The code raised one of labseq's own errors.
    """
    printed = _PrintsToStderr(sys.stdout)
    try:
        with redirect_stdout(cast("Any", printed)):
            call = _guard.run(f"plugin {owner.name}", owner.max_wait_s, partial(work))
    finally:
        if text := printed.end():
            when = f"in {code_name}" if code_name else "while it was loaded"
            advice = "use 'logging.getLogger(__name__)' instead"
            owner.note(f"{when} it printed '{text[:MAX_PRINTED]}' to stderr; {advice}")
    if call is None:
        _guard.end()  # so that its thread also ends if the call ever returns
        fault = f"{code_name} did not return" if code_name else "it did not finish loading"
        remedy = "if it is only slow, raise 'timeouts: {load: ...}' in the profile"
        raise owner.fault(f"{fault} within {owner.max_wait_s:.3g} s and was abandoned; {remedy}")
    if call.error is not None:
        raise _plugin_error(owner, code_name, call.error) from call.error
    return call.result


class _PrintsToStderr:
    """Replaces ``sys.stdout`` while a plugin's code runs.

    A plugin may keep it, for example in a logging handler. Later it writes to the real stdout.
    """

    def __init__(self, real: Any) -> None:
        self._real = real
        self._is_over = False
        self._text = ""

    def write(self, text: str) -> int:
        if not self._is_over:
            self._text = (self._text + text)[: 4 * MAX_PRINTED]
        return len(text) if self._stream is None else self._stream.write(text)

    def end(self) -> str:
        """Restore the real stdout, and return the beginning of the printed text on one line."""
        self._is_over = True
        return " ".join(self._text.split())

    @property
    def _stream(self) -> Any:
        return self._real if self._is_over else sys.stderr

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _plugin_error(owner: Owner, code_name: str, error: BaseException) -> LabseqError:
    if isinstance(error, LabseqError) and (code_name or getattr(error, "plugin", None) == owner.name):
        return error
    text = format_error(error)
    if isinstance(error, SyntaxError):
        text = f"{type(error).__name__}: {one_line(error.msg)}"
    if place := error_location(error, owner.home):
        text = f"{text} ({place})"
    return owner.fault(f"{code_name} raised {text}" if code_name else text)


def error_location(error: BaseException, home: Path | None) -> str:
    """File and line of an error, in the plugin's own code if possible. "" if unknown."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno or 1}"
    chain = [error]
    while (cause := chain[0].__cause__ or chain[0].__context__) is not None and cause not in chain:
        chain.insert(0, cause)
    frames = [frame for linked in chain for frame in traceback.extract_tb(linked.__traceback__)]
    plugin_frames = [
        f for f in frames if home is not None and home in (Path(f.filename), *Path(f.filename).parents)
    ]
    # if a factory's signature is wrong, the only lines are labseq's own, which do not concern the plugin
    package = Path(__file__).parents[1]
    callers = {package / "assembly", package / "plugins", package / "guard.py"}
    other_frames = [f for f in frames if not {Path(f.filename), Path(f.filename).parent} & callers]
    frame = (plugin_frames or other_frames or [None])[-1]
    return "" if frame is None else f"{frame.filename}:{frame.lineno}"
