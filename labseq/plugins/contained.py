"""Calls into plugins' code before a run: in a thread of their own, with a time limit, under observation."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, TypeVar

from labseq.errors import LabseqError, PluginLoadError
from labseq.plugins.importing import error_location
from labseq.plugins.surroundings import ProcessState
from labseq.plugins.told import format_error
from labseq.registry import Owner

T = TypeVar("T")

_LOOK_S: Final = 0.05
"""How often the thread that waits looks up, for Ctrl-C."""


def contained(owner: Owner, what: str, work: Callable[[], T], *, watch: bool = True) -> T:
    """Let a plugin's code run, and name the plugin in whatever goes wrong.

    The code has a thread of its own, so that one that hangs is given up after the owner's patience, and that
    a ``SystemExit`` or ``KeyboardInterrupt`` of its own ends nothing but itself. What it prints goes to
    stderr. What it changes of the process is put back and noted with the owner.

    Args:
        owner: Whose code it is.
        what: What runs, for messages; "" for the loading of the plugin.
        work: The code.
        watch: Whether to look for changes of the process.

    Returns:
        What the code returned.

    Raises:
        PluginLoadError: It raised, or did not return in time.
        LabseqError: It raised this one of labseq's own.
    """
    job = _Job(work, ProcessState() if watch else None)
    thread = threading.Thread(target=job.run, name=f"labseq plugin {owner.name}", daemon=True)
    deadline = time.monotonic() + owner.max_wait_s
    try:  # from here on: Ctrl-C may come while the thread starts
        thread.start()
        while not job.done.wait(min(_LOOK_S, max(0.0, deadline - time.monotonic()))):
            if time.monotonic() >= deadline and not job.done.is_set():
                raise owner.fault(_hung(what, owner.max_wait_s))
    finally:
        job.leave()
        for change in job.changes:
            owner.note(f"{f'in {what}' if what else 'while it was loaded'} {change}")
    if job.error is not None:
        raise _named(owner, what, job.error) from job.error
    return job.result


class _Job:
    def __init__(self, work: Callable[[], Any], surroundings: ProcessState | None) -> None:
        self._work = work
        self._surroundings = surroundings
        self._leaving = threading.Lock()
        self.changes: list[str] = []
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            with self._leaving:
                if self._surroundings is not None:
                    self._surroundings.enter()
            self.result = self._work()
        except BaseException as error:  # noqa: BLE001 - a plugin may raise anything
            self.error = error
        finally:
            self.leave(inside=True)
            self.done.set()

    def leave(self, *, inside: bool = False) -> None:
        """Put back what was changed, once: by the thread itself, or by the one that gives it up."""
        with self._leaving:
            surroundings, self._surroundings = self._surroundings, None
            if surroundings is not None:
                self.changes = surroundings.leave(inside=inside)


def _hung(what: str, max_wait_s: float) -> str:
    did = f"{what} did not return" if what else "it did not finish loading"
    remedy = "if it is only slow, raise 'timeouts: {load: ...}' in the profile"
    return f"{did} within {max_wait_s:.3g} s and was given up; {remedy}"


def _named(owner: Owner, what: str, error: BaseException) -> LabseqError:
    is_own = isinstance(error, PluginLoadError) and error.plugin == owner.name
    if isinstance(error, LabseqError) and (what or is_own):
        return error
    text = f"{type(error).__name__}: {error.msg}" if isinstance(error, SyntaxError) else format_error(error)
    place = error_location(error, owner.home)
    text = f"{text} ({place})" if place else text
    return owner.fault(f"{what} raised {text}" if what else text)
