"""The run's side of the watchdog, which starts its process, tells it the devices, and sends heartbeats."""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.errors import RecordingError
from labseq.files import read_lines
from labseq.guard import Pulse
from labseq.messages import format_error

if TYPE_CHECKING:
    import subprocess

    from labseq.watchdog_process import Hanging

WATCHDOG_LOG: Final = "watchdog.jsonl"
"""Name of the watchdog's log in the folder of a run."""
BEAT_S: Final = 0.05
"""Interval between two heartbeats."""
STUCK_S: Final = 10.0
"""A run counts as dead if its shot thread has neither waited nor made progress for this long."""
ANSWER_S: Final = 10.0
"""How long a run waits for an answer from the watchdog, which may have to load a vendor's library."""
END_S: Final = 1.0
"""How long a run waits for the end of a watchdog that has nothing left to do."""


def watchdog_lines(run_dir: Path) -> list[str]:
    """The actions of a run's watchdog, one line for each device, without damaged lines of its log."""
    lines: list[str] = []
    with suppress(RecordingError):
        for row in read_lines(run_dir / WATCHDOG_LOG)[0]:
            with suppress(ValueError, TypeError, KeyError):
                outcome = f"off after {1e3 * row['after_s']:.0f} ms" if row["ok"] else "NOT switched off"
                lines.append(f"{row['device']} {outcome}, because the run {row['cause']}: {row['text']}")
    return lines


class Watchdog:
    """Starts the watchdog, reports the devices to it, and sends the heartbeat.

    A watchdog that dies or hangs is replaced, as often as needed. If that is not possible, ``lost`` is
    called. If it cannot be started at all, there is a warning. Nothing here raises.

    Args:
        run_name: Name of the run in the watchdog's messages.
        log: File to which it adds a line for each device that it switches off. None for none.
        pulse: Progress of the thread that adds the first device. Without progress, the run counts as dead.
            None if there is no such thread.
        lost: Called with the reason if no watchdog is left. It ends the run.
        may_end: Whether it may end this process to switch off a device that it cannot switch off otherwise.
    """

    def __init__(
        self,
        run_name: str = "the run",
        log: Path | None = None,
        pulse: Pulse | None = None,
        lost: Callable[[str], object] = str,
        may_end: bool = False,
    ) -> None:
        log_path = None if log is None else str(log.absolute())
        self._about = {"run": run_name, "log": log_path, "path": sys.path, "may_end": may_end}
        self._devices: dict[str, dict[str, Any]] = {}
        self._notes: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None
        self._hanging: Hanging  # from the start of a process on
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._sending = threading.RLock()
        self._ended = threading.Event()
        self._is_started = False
        self._pulse = pulse
        self._lost = lost
        self._heard = Pulse()
        self._wake = threading.Event()
        self._n_awaited = 0

    def add(self, name: str, order: int, script: Path, arguments: object) -> None:
        """Have it switch a device off if this process dies. The first device starts the watchdog.

        Args:
            name: The device.
            order: Its place in the order of the safe state.
            script: See ``Emergency``.
            arguments: See ``Emergency``.
        """
        if not self._is_started:
            self._is_started = True
            if self._pulse is not None:
                self._pulse.begin()
            if self._launch():
                threading.Thread(target=self._beat, name="labseq heartbeat", daemon=True).start()
        device = {"device": name, "order": order, "script": str(script), "arguments": arguments}
        with self._sending:
            self._devices[name] = device
        self._tell(device)  # without the lock, so that heartbeats go on while it loads libraries

    def forget(self, names: Iterable[str]) -> None:
        """Leave devices alone from now on, because they are safe and closed."""
        with self._sending:
            for name in names:
                if self._devices.pop(name, None) is not None:
                    self._send({"forget": name})

    def end(self) -> None:
        """End the watchdog, which first switches off the devices that are left. Legal at any time."""
        self._ended.set()
        self._wake.set()
        with self._sending:
            if self._devices and self._process is not None and not self._send({"end": True}):
                self._launch()  # it died just now, and is needed
                self._send({"end": True})
            process, self._process = self._process, None
            if process is not None and process.stdin is not None:
                with suppress(OSError, ValueError):
                    process.stdin.close()
                if self._devices:  # it is at work, and needs the ports that this process still holds
                    process.returncode = 0  # nothing waits for it
                    return
                try:
                    process.wait(END_S)
                except Exception:  # noqa: BLE001 - it hangs
                    process.kill()
                    process.wait()

    def notes(self) -> list[str]:
        """Messages for the user about failures since the last call."""
        notes: list[str] = []
        with suppress(queue.Empty):
            while True:
                notes.append(self._notes.get_nowait())
        return notes

    def _launch(self) -> bool:
        """Start the process, and send it the open devices. Returns whether it answers."""
        # only a run with real hardware needs these
        import subprocess

        from labseq import watchdog_process

        flags = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(
            subprocess, "CREATE_NEW_PROCESS_GROUP", 0
        )
        self._answers = queue.SimpleQueue()
        self._wake.clear()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our file, no shell
                [sys.executable, "-I", "-S", watchdog_process.__file__, str(os.getpid())],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # so that Ctrl-C and a lost terminal do not end it
                creationflags=flags,
            )
            threading.Thread(target=self._hear, args=[self._process, self._answers], daemon=True).start()
        except (OSError, RuntimeError, MemoryError) as error:
            self._note(f"cannot be started: {getattr(error, 'strerror', None) or error}")
            return False
        # a watchdog without a sign of life for this long is replaced
        self._hanging = watchdog_process.Hanging(self._process.pid, hung_s=0.4)
        answered = [self._tell(message) for message in (self._about, *self._devices.values())]
        return all(answered)

    def _hear(self, process: subprocess.Popen[bytes], into: queue.SimpleQueue[bytes]) -> None:
        """Receive answers, and signs of life, from one process until it ends."""
        assert process.stdout is not None
        self._heard.begin()
        with process.stdout, suppress(OSError, ValueError):
            for line in process.stdout:
                self._heard.beat()
                if line.strip():
                    into.put(line)
        into.put(b"")
        with self._sending:
            if process is self._process:  # else it was replaced
                self._wake.set()

    def _tell(self, message: dict[str, Any]) -> bool:
        """Send a message, wait for the answer and note the failure in it. False without an answer."""
        self._n_awaited += 1
        answer = b""
        try:
            if not self._send(message):
                return False
            answer = self._await_answer()
            failure = json.loads(answer)["failure"] if answer else "it ended"
        except queue.Empty:
            failure = "it does not answer"
        except (TypeError, ValueError) as error:
            failure = format_error(error)
        finally:
            self._n_awaited -= 1
        if failure:
            name = message.get("device")
            self._note(f"cannot switch off '{name}': {failure}" if name else failure)
        return answer != b""

    def _await_answer(self) -> bytes:
        """Wait for an answer, unless the process was stopped."""
        answers, hanging, deadline_s = self._answers, self._hanging, time.monotonic() + ANSWER_S
        while True:
            if self._pulse is not None:
                self._pulse.beat()  # the thread that takes the shots may be waiting here
            try:
                return answers.get(timeout=BEAT_S)
            except queue.Empty:
                if hanging.is_stopped or time.monotonic() > deadline_s:
                    raise

    def _send(self, message: dict[str, Any] | None) -> bool:
        """Send a message or a heartbeat. Returns whether it could be sent."""
        line = b"\n" if message is None else json.dumps(message).encode() + b"\n"
        with self._sending, suppress(OSError, ValueError):
            if self._process is not None and self._process.stdin is not None:
                self._process.stdin.write(line)
                return True
        return False

    def _beat(self) -> None:
        """Send heartbeats, report a run without progress, and replace a watchdog that is gone.

        If this thread does not run either, the whole computer has paused, so little of that time counts.
        """
        n_failed, looked_s = 0, time.monotonic()
        while not self._ended.is_set():
            has_ended = self._wake.wait(BEAT_S)
            now_s = time.monotonic()
            passed_s, looked_s = min(now_s - looked_s, 2 * BEAT_S), now_s
            self._check_progress(passed_s)
            silent_s = self._heard.silent_s(passed_s)
            limit_s = ANSWER_S if self._n_awaited else 0.0
            is_silent = self._hanging(silent_s) and silent_s > limit_s
            if self._send(None) and not has_ended and not is_silent:
                continue
            if self._replace("does not answer" if is_silent else "has ended"):
                n_failed = 0
            elif (n_failed := n_failed + 1) == 3:  # this many in a row have not started
                self._note("cannot be started again, so the run ends")
                with self._sending:
                    self._kill()  # without a heartbeat it would end the run before the devices are safe
                self._lost("no watchdog is left to switch the outputs off")
                return

    def _replace(self, why: str) -> bool:
        """Replace a watchdog that is gone. Returns whether the new one answers."""
        with self._sending:
            if self._ended.is_set():
                return True
            self._note(f"{why}, and is started again")
            self._kill()
            return self._launch()

    def _kill(self) -> None:
        """Kill the process, if there is one."""
        if self._process is not None:
            with suppress(OSError):
                self._process.kill()
            self._process.wait()
            if self._process.stdin is not None:
                self._process.stdin.close()

    def _check_progress(self, passed_s: float) -> None:
        if self._pulse is not None and (silent_s := self._pulse.silent_s(passed_s)) > STUCK_S:
            self._send({"stuck": silent_s})

    def _note(self, message: str) -> None:
        self._notes.put(f"the watchdog that switches the outputs off if labseq dies {message}")
