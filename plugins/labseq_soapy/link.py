"""The connection to the streaming process, with its start, commands, supervision and end."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from labseq_soapy_stream.messages import Facts, Setup, received, send
from labseq_soapy_stream.output import Samples

from labseq.plugin import Clock, DeviceError, wait_for
from labseq_soapy import emergency

OPEN_S: Final = 60.0
"""How long a radio may take to open. Some load their firmware."""
SILENT_S: Final = 6.0
"""A streaming process that sends nothing for this long with its radio open counts as hung. labseq waits
longer for any call, so that the error names the process.
"""
END_S: Final = 3.0
"""How long the process may take to end in addition to its ramp."""


class Link:
    """One streaming process.

    Args:
        name: Name of the device, for messages.
        clock: The session's clock.
        setup: The first message to the process.
        log: File for the output of the radio's module.
        program: Module that streams, which gets the ``options``.

    Attributes:
        pid: Number of the process.
        facts: Facts that the radio reported, None until it is open.
        status: How often the radio reported each error, in "all" and while the array was "lit".
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        setup: Setup,
        log: Path,
        program: str,
        options: Sequence[str] = (),
    ) -> None:
        self._name, self._clock, self._setup, self._log = name, clock, setup, log
        self._program = program
        self._news = threading.Condition()
        self._sending = threading.Lock()
        self._ended = ""
        self._n_done = self._n_tasks = 0
        self.status: Mapping[str, Mapping[str, int]] = {"all": {}, "lit": {}}
        self._received_s = time.monotonic()
        self._closing = threading.Event()
        self.facts: Facts | None = None
        with log.open("wb") as file:
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-P", "-m", program, *options],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                bufsize=0,
                start_new_session=True,  # so that Ctrl-C in a terminal does not end it before labseq
            )
        self.pid = self._process.pid
        self._started = emergency.start_of(self.pid)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in, self._out = self._process.stdin, self._process.stdout
        self._threads = [
            threading.Thread(target=work, name=f"{name} {work.__name__}", daemon=True)
            for work in (self._listen, self._beat)
        ]
        with contextlib.suppress(OSError):  # it has ended already, and wait_open() reports why
            self._send(asdict(setup))
        for thread in self._threads:
            thread.start()

    @property
    def hangs(self) -> bool:
        """Whether the process runs but is silent, as it always is while the radio is being opened."""
        is_open = self.facts is not None and not self._ended
        return is_open and time.monotonic() - self._received_s > SILENT_S

    def emergency_arguments(self) -> dict[str, Any]:
        """The arguments with which the emergency script ends this process and switches off its radio."""
        facts = self.facts
        buffered_s = facts.buffered / facts.rate_hz if facts else 0.0
        return {
            "pid": self.pid,
            "started": self._started,
            "opened": str(Path(self._setup.marker).with_suffix(".opened")),
            "ramp_s": self._setup.ramp_s + buffered_s,
            "device": self._setup.device,
            "channels": list(self._setup.channels),
            "program": self._program,
        }

    def wait_open(self) -> Facts:
        """Wait until the radio is open and streams silence, and return its facts.

        Raises:
            DeviceError: It cannot be opened or set up.
        """
        self._wait(lambda: self.facts is not None, OPEN_S, "open the radio")
        assert self.facts is not None
        return self.facts

    def load(self, loop: Samples, fade_s: float) -> None:
        """Play another loop, float32 (2, 2 n), channels in order, and wait until it is at the connectors."""
        with tempfile.TemporaryDirectory(prefix="labseq-") as folder:
            file = Path(folder) / "loop.npy"
            np.save(file, loop)
            self._do("loop", file=str(file), fade_s=fade_s)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth, and wait until the end of the ramp is at the connectors."""
        self._do("ramp", depth=depth, duration_s=duration_s)

    def release(self, n_samples: int) -> None:
        """Play silence for some samples, then the loop again, and wait until that is at the connectors."""
        self._do("release", n_samples=n_samples)

    def leave(self) -> None:
        """Let the process run alone until its marker file is deleted or a signal ends it."""
        self._do("leave")
        self._closing.set()
        with contextlib.suppress(OSError):
            self._in.close()

    def check(self) -> None:
        """Check that the stream is alive.

        Raises:
            DeviceError: It is dead, with the known reason.
        """
        if self._ended:
            dark = "" if self.facts is None else "; the array is dark"
            raise DeviceError(self._name, f"{self._ended}{dark}")
        if self.hangs:
            text = f"its streaming process (number {self.pid}) hangs, as it sent nothing for {SILENT_S:g} s"
            raise DeviceError(self._name, text)

    def close(self) -> None:
        """Let the process ramp down and end, or kill it. Legal in any state.

        Raises:
            DeviceError: The transmitters may still be on.
        """
        self._closing.set()
        with contextlib.suppress(OSError):
            self._send({"do": "end"})
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S + self._setup.ramp_s)
        try:
            self.switch_off()
        finally:
            self._process.kill()
            self._process.wait()
            for thread in self._threads:
                thread.join()
            for pipe in (self._in, self._out):
                with contextlib.suppress(OSError):
                    pipe.close()

    def switch_off(self) -> None:
        """End the process, if it has not ended, and the transmission if it did not do so itself.

        Raises:
            DeviceError: The transmitters may still be on.
        """
        try:
            emergency.off(**self.emergency_arguments())
        except emergency.EmergencyError as error:
            raise DeviceError(self._name, str(error)) from error

    def _do(self, what: str, **values: Any) -> None:
        self.check()
        self._n_tasks += 1
        task = self._n_tasks
        try:
            self._send({"do": what, "id": task, **values})
        except OSError:
            self._wait(lambda: False, END_S, "report why it has ended")
        self._wait(lambda: self._n_done >= task, float("inf"), what)

    def _wait(self, is_done: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for a condition. Raises DeviceError if the process ends or hangs, or it takes too long."""

        def poll(longest_s: float) -> bool | None:
            with self._news:
                if self._news.wait_for(lambda: is_done() or self._ended, longest_s) and is_done():
                    return True
            self.check()
            return None

        if not wait_for(poll, timeout_s, self._clock):
            raise DeviceError(self._name, f"the streaming process did not {what} within {timeout_s:g} s")

    def _listen(self) -> None:
        why = ""
        for message in received(self._out.fileno()):
            with self._news:
                self._received_s = time.monotonic()
                if facts := message.get("facts"):
                    self.facts = Facts(**facts)
                self.status = message.get("status", self.status)
                self._n_done = max(self._n_done, message.get("done", 0))
                why = message.get("failed") or message.get("ended") or why
                self._news.notify_all()
        code = self._process.wait()
        if self._closing.is_set():
            with contextlib.suppress(OSError):
                self._out.close()
        with self._news:
            self._ended = why or f"its streaming process ended with code {code}{self._last_line()}"
            self._news.notify_all()

    def _last_line(self) -> str:
        try:
            lines = self._log.read_text("utf-8", "replace").strip().splitlines()
        except OSError:
            return ""
        return f", its last message: {lines[-1].strip()[:200]}" if lines else ""

    def _beat(self) -> None:
        while not self._closing.wait(self._setup.max_wait_s / 8):
            try:
                self._send({"do": "beat"})
            except OSError:
                return

    def _send(self, message: Mapping[str, Any]) -> None:
        with self._sending:
            send(self._in.fileno(), message)
