"""A fake of the other control system, which leads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from labseq.errors import DeviceTimeoutError
from labseq.roles import Context
from labseq.testing.fakes.calls import Calls
from labseq.testing.fakes.devices import RecordingDevice


class RecordingLeader(RecordingDevice):
    """Says `go` by itself, some time after it is waited for, and notes the answers.

    Attributes:
        goes_after_s: That time, in seconds.
        answers: State and what was told with it, for each `go`.
        noted: What it tells as news, once.
    """

    role: ClassVar[str] = "leader"
    deadline_s = 10.0

    def __init__(self, context: Context | None = None, calls: Calls | None = None, **faults: Any) -> None:
        super().__init__(context, calls, **faults)
        self.goes_after_s = 0.5
        self.answers: list[tuple[str, dict[str, Any]]] = []
        self.noted: list[str] = []
        self._n_gos = 0
        self._is_owed = False

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait, then count the signals: "1", "2", ..."""
        self.use("wait_for", signal, timeout_s)
        self.clock.sleep(min(self.goes_after_s, timeout_s))
        if self.goes_after_s > timeout_s:
            raise DeviceTimeoutError(self.name, f"no '{signal}' within {timeout_s} s", timeout_s)
        self._is_owed = True
        self._n_gos += 1
        return str(self._n_gos)

    def report(self, state: Literal["ready", "failed"], about: Mapping[str, bool | int | float | str]) -> str:
        """Note the answer, if one is owed."""
        self.use("report", state)
        if not self._is_owed:
            return ""
        self._is_owed = False
        self.answers.append((state, dict(about)))
        return state

    def new_events(self) -> Sequence[str]:
        """What was noted."""
        noted, self.noted = self.noted, []
        return noted
