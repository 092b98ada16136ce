"""The process that keeps the radio supplied (``python -m labseq_soapy_stream.streamer``).

With ``--off DEVICE CHANNEL ...`` it only sets the lowest gains of a radio.

It is a separate process so that nothing that labseq does can make the stream run dry, and so that the light
is ramped down when labseq is killed or hangs. :mod:`labseq_soapy_stream.messages` describes the messages.
"""

from __future__ import annotations

import contextlib
import gc
import os
import queue
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from labseq_soapy_stream.messages import Setup, received, send
from labseq_soapy_stream.output import BLOCK, Output, Samples
from labseq_soapy_stream.radio import Device, OpenDevice, Stream, lower_gains, open_radio, read_back, set_up
from labseq_soapy_stream.soapysdr import SoapyDevice, SoapyError

STALL_S: Final = 2.0
"""A stream that takes no samples for this long counts as dead."""
STATUS_S: Final = 0.2
WRITE_S: Final = 0.1
MARKER_S: Final = 0.1
PRIORITY: Final = 10
"""Real-time priority, of 1 to 99, above all ordinary processes, below the threads of a radio's module."""

Message = Mapping[str, Any]


class CommandReader:
    """Reads labseq's commands, and the files of the loops that they name, in a thread."""

    def __init__(self, pipe: int) -> None:
        self.inbox: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.last_s = time.monotonic()
        self.closed = False
        self._messages = received(pipe)
        self.setup = Setup(**next(self._messages))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for message in self._messages:
            self.last_s = time.monotonic()
            if message["do"] == "loop":
                try:
                    message["loop"] = repeated(np.load(message["file"]))
                except (OSError, ValueError) as error:
                    message = {"do": "fail", "why": f"a loop cannot be read: {error}"}
            self.inbox.put(message)
        self.closed = True


class StatusWriter:
    """Sends messages to labseq in a thread, so that a hung labseq does not block the stream."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._outbox: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def post(self, message: Message) -> None:
        """Send a message soon."""
        self._outbox.put(message)

    def finish(self) -> None:
        """Wait until all messages were sent, but not long, in case labseq hangs, and not if it is gone."""
        self._outbox.put(None)
        self._thread.join(1.0)

    def _write(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                if (message := self._outbox.get()) is None:
                    return
                send(self._pipe, message)


class Streamer:
    """Keeps an active stream supplied until labseq ends it or is gone."""

    def __init__(
        self, stream: Stream, rate_hz: float, commands: CommandReader, post: Callable[[Message], None]
    ) -> None:
        self._stream, self._setup, self._rate_hz = stream, commands.setup, rate_hz
        self._commands, self._post = commands, post
        self._output = Output()
        self._written = self._buffered = self._due = 0
        self._task: int | None = None
        self._settling = False
        self._errors: Mapping[str, Counter[str]] = {"all": Counter(), "lit": Counter()}
        self._status_s = self._marker_s = 0.0
        self._parent = os.getppid()
        self._alone = self._leaving = False
        self._terminated = False

    def fill(self) -> int:
        """Fill the radio's buffer with silence, and return how many samples it holds."""
        silence, first = self._output.block(), 0
        while self._written < self._rate_hz:
            taken = self._stream.write(silence, 0, 0.0)
            self._written += taken
            first = first or taken
            if 2 * taken <= first:  # full, except for samples played meanwhile
                break
        self._buffered = self._written
        self._stream.check_start()
        return self._buffered

    def run(self) -> None:
        """Stream until the end, when the light is off."""
        while not (self._leaving and self._task is None):
            while not self._commands.inbox.empty():
                self._execute(self._commands.inbox.get())
            self._write(self._output.block())
            self._report_errors()
            if not self._leaving:
                self._watch_labseq()

    def terminate(self, *_: object) -> None:
        """Ramp down and end, as handler of a signal."""
        self._terminated = True

    def _execute(self, message: dict[str, Any]) -> None:
        if self._leaving:  # it comes too late
            return
        match message["do"]:
            case "loop":
                self._output.load(message["loop"], round(message["fade_s"] * self._rate_hz))
                self._begin(message["id"])
            case "ramp":
                self._output.ramp(message["depth"], round(message["duration_s"] * self._rate_hz))
                self._begin(message["id"])
            case "release":
                self._output.release(message["n_samples"])
                self._begin(message["id"])
            case "leave":
                self._go_alone()
                self._post({"done": message["id"]})
            case "end":
                self._leave("")
            case "fail":
                self._leave(message["why"])
            case _:
                pass  # a beat

    def _begin(self, task: int) -> None:
        self._task, self._settling = task, True

    def _write(self, samples: Samples) -> None:
        n, done, waited_s = samples.shape[1] // 2, 0, 0.0
        while done < n:
            taken = self._stream.write(samples, done, WRITE_S)
            done += taken
            waited_s = 0.0 if taken else waited_s + WRITE_S
            if waited_s > STALL_S:
                raise SoapyError(f"the radio took no samples for {STALL_S:g} s")
        self._written += n
        if self._settling and self._output.steady:
            self._settling, self._due = False, self._written + self._buffered
        if self._task is not None and not self._settling and self._written >= self._due:
            self._post({"done": self._task})
            self._task = None

    def _report_errors(self) -> None:
        """Count the radio's errors, and tell labseq at once, or now and then that there are none."""
        found = self._stream.errors()
        self._errors["all"].update(found)
        if self._output.depth > 0.0:
            self._errors["lit"].update(found)
        now_s = time.monotonic()
        if not self._alone and (found or now_s - self._status_s > STATUS_S):
            self._status_s = now_s
            self._post({"status": {when: dict(counts) for when, counts in self._errors.items()}})

    def _watch_labseq(self) -> None:
        """Leave if labseq is gone or hangs, or, without it, if the next labseq has deleted the marker."""
        now_s = time.monotonic()
        if self._terminated:
            self._leave("it was asked to end by a signal")
        elif self._alone:
            if now_s - self._marker_s > MARKER_S:
                self._marker_s = now_s
                if not Path(self._setup.marker).exists():
                    self._leave("")
        elif self._commands.closed or os.getppid() != self._parent:  # a copy of labseq may keep the pipe open
            self._go_alone()
            self._leave("labseq is gone")
        elif now_s - self._commands.last_s > self._setup.max_wait_s:
            self._go_alone()
            self._leave(f"labseq sent nothing for {self._setup.max_wait_s:g} s")

    def _go_alone(self) -> None:
        """Leave the number of this process to the next labseq, which ends it, or waits until it has ended."""
        self._alone = True
        marker = Path(self._setup.marker)
        with contextlib.suppress(OSError):
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.write_text(str(os.getpid()), "ascii")

    def _leave(self, why: str) -> None:
        self._leaving = True
        if why:
            self._post({"ended": why})
        self._output.ramp(0.0, round(self._setup.ramp_s * self._rate_hz))
        self._begin(0)


def repeated(loop: Samples) -> Samples:
    """A loop repeated to fill a block or more, float32 (2, 2 n)."""
    n = loop.shape[1] // 2
    return np.tile(loop, (1, -(-BLOCK // n)))


def raise_priority() -> str:
    """Give this thread, and threads that it starts, real-time priority. Returns why not, or ""."""
    if sys.platform != "linux":
        return "set under Linux only"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return (error.strerror or str(error)).lower()
    return ""


def stream(
    open_device: OpenDevice, commands: CommandReader, messages: StatusWriter, no_real_time: str
) -> None:
    """Open the radio, stream, close it."""
    setup = commands.setup
    radio = open_radio(open_device, setup)
    opened = Path(setup.marker).with_suffix(".opened")  # it stays if this process is killed
    with contextlib.suppress(OSError):
        opened.write_text(str(os.getpid()), "ascii")
    is_off = True
    try:
        samples = set_up(radio, setup)
        try:
            facts = read_back(radio, setup)
            samples.activate()
            streamer = Streamer(samples, facts.rate_hz, commands, messages.post)
            signal.signal(signal.SIGTERM, streamer.terminate)
            facts = replace(facts, buffered=streamer.fill(), no_real_time=no_real_time)
            messages.post({"facts": asdict(replace(facts, starts_together=samples.starts_together))})
            streamer.run()
        finally:
            is_off = closed(samples)
    finally:
        if closed(radio) and is_off:
            remove_own(opened)
        remove_own(Path(setup.marker))


def closed(part: Device | Stream) -> bool:
    """Close a radio or its stream, and return whether it obeyed. An earlier error is reported."""
    with contextlib.suppress(SoapyError):
        part.close()
        return True
    return False


def remove_own(file: Path) -> None:
    """Remove a file if it has the number of this process."""
    with contextlib.suppress(OSError):
        if file.read_text("ascii") == str(os.getpid()):
            file.unlink()


def main(open_device: OpenDevice) -> int:
    """Run the process, and return its exit code."""
    if sys.argv[1:2] == ["--off"]:
        try:
            lower_gains(open_device, sys.argv[2], [int(channel) for channel in sys.argv[3:]])
        except SoapyError as error:
            sys.stderr.write(f"{error}\n")
            return 3
        return 0
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to labseq, which ramps down
    pipe = os.dup(1)
    os.dup2(2, 1)  # the output of the radio's module goes to the log
    no_real_time = raise_priority() if "--real-time" in sys.argv else ""
    commands, messages = CommandReader(0), StatusWriter(pipe)
    gc.disable()  # nothing here creates reference cycles
    try:
        stream(open_device, commands, messages, no_real_time)
    except SoapyError as error:
        messages.post({"failed": str(error)})
        messages.finish()
        return 3
    messages.finish()
    return 0


def run(open_device: OpenDevice) -> NoReturn:
    """Run the process, and end it.

    Args:
        open_device: Opens a radio by its arguments.
    """
    code = main(open_device)
    sys.stderr.flush()
    os._exit(code)  # the threads wait for labseq


if __name__ == "__main__":
    run(SoapyDevice)
