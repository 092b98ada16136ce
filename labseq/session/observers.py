"""Passes the events of a run to its log, plugins' observer hooks and the live view."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from labseq.errors import DeviceTimeoutError, LabseqError
from labseq.guard import Guard
from labseq.messages import format_error
from labseq.model import ShotRecord, StageTiming
from labseq.plugins.host import PluginHost
from labseq.recording.folders import UNLOGGED_EVENTS, UNLOGGED_VALUES
from labseq.roles import RunObserver

_HOOKS: Final = {  # event -> observer hook of plugins, and the event's values that are its arguments
    "run_started": ("labseq_run_started", {"run": "record"}),
    "shot_finished": ("labseq_shot_finished", {"shot": "shot"}),
    "run_finished": ("labseq_run_finished", {"run": "record"}),
}
MAX_WAIT_S: Final = 5.0
"""Maximum time for a plugin's observer hook, in seconds. A slower hook is not called again in the run."""


class Observers:
    """Implements ``RunObserver`` for the sequencer. No failure of a receiver stops the run."""

    def __init__(self, host: PluginHost, observer: RunObserver | None) -> None:
        self._host = host
        self._receivers = [] if observer is None else [observer]
        self._guard = Guard()
        self._hung: set[str] = set()
        self._log: Callable[..., None] | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Pass an event on to every receiver."""
        # the log first, because no plugin or screen may keep an event out of it
        self._write(name, values)
        self._notify(name, values)
        self._show(name, values)

    def add(self, receiver: RunObserver) -> None:
        """Add a receiver of every event."""
        self._receivers.append(receiver)

    @contextmanager
    def logged_by(self, log: Callable[..., None]) -> Generator[None]:
        """Write the events of the block to the log of the run with ``log(name, **values)``."""
        self._log = log
        try:
            yield
        finally:
            self._log = None

    def close(self) -> None:
        """End the plugins' threads."""
        self._guard.end()

    def _notify(self, name: str, values: Mapping[str, Any]) -> None:
        if name not in _HOOKS:
            return
        hook, names = _HOOKS[name]
        arguments = {argument: values[key] for argument, key in names.items()}
        for plugin, call in self._host.listeners(hook, **arguments):
            if plugin in self._hung:
                continue
            try:
                # despite a stop request, because plugins also learn of the end of a stopped run
                self._guard.call_despite_stop(plugin, MAX_WAIT_S, call)
            except LabseqError as error:
                if isinstance(error, DeviceTimeoutError):
                    self._hung.add(plugin)
                warning = {"text": f"plugin '{plugin}' failed in its observer hook: {error}"}
                self._write("warning", warning)
                self._show("warning", warning)

    def _show(self, name: str, values: Mapping[str, Any]) -> None:
        for receiver in [*self._receivers]:
            try:
                receiver.event(name, values)
            except BaseException as error:  # noqa: BLE001 - a broken screen must not stop the run
                self._receivers.remove(receiver)
                which = f"{type(receiver).__name__} failed and was switched off"
                self._write("warning", {"text": f"{which}: {format_error(error)}"})

    def _write(self, name: str, values: Mapping[str, Any]) -> None:
        if self._log is None or name == "run_finished":  # the writer logs it, before the run's state changes
            return
        timing = values.get("timing")
        if isinstance(timing, StageTiming) and timing.over_budget:
            names = ("stage", "step", "cycle", "duration_s", "host_s", "budget_s")
            self._log("over_budget", **{key: getattr(timing, key) for key in names})
        if name not in UNLOGGED_EVENTS:
            kept = {key: value for key, value in values.items() if key not in UNLOGGED_VALUES}
            self._log(name, **{key: _plain(value) for key, value in kept.items()})


def _plain(value: Any) -> Any:
    if isinstance(value, ShotRecord):
        names = ("shot_index", "attempt", "status", "error", "success", "filling_fraction")
        return {name: getattr(value, name) for name in names}
    return value
