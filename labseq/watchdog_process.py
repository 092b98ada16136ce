"""The watchdog, a small process that switches the outputs off when the run that uses them dies or hangs.

It needs only the standard library (and psutil on Windows), because it must start fast, stay small, and work
when nothing else does. The run's side, :mod:`labseq.watchdog`, passes on how each device is switched off
(``Emergency``), and sends a heartbeat. Messages are lines of JSON on standard input. An empty line is a
heartbeat. The end of the input without ``end`` means that the run has died. The watchdog answers in the same
way on standard output, so that the run notices when it dies or hangs, and starts another one.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

LOOK_S: Final = 0.05
"""Interval between two looks at the run, and between two signs of life of the watchdog itself."""
WAITS_S: Final = 10.0
"""How long the heartbeat may be missing while a thread waits for a disk, swapped memory or a processor."""
TERM_S: Final = 0.1
"""How long a run that hangs may take to end after SIGTERM, before SIGKILL."""
NEXT_S: Final = 0.05
"""How long switching off one device may delay the next."""
TRY_AGAIN_S: Final = 5.0
"""How long switching off is retried if it fails, as a dying process may still hold the device."""
HANGS_S: Final = 1.0
"""Further time after which switching off counts as hanging."""
MAX_TEXT: Final = 500
"""Maximum length of the text of an error, in characters."""


def main() -> None:
    """Run the watchdog, with messages on standard input and an answer for each device on standard output."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK", "SIGPIPE"):
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    _take_precedence()
    _Process(int(sys.argv[1])).watch()
    os._exit(0)  # its threads may still wait for a device or for the run


def _take_precedence() -> None:
    """Ask for real-time priority, locked memory, and to be killed last when memory runs out."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("-1000", encoding="ascii")
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            libc = ctypes.CDLL(None)
            libc.mlockall(1 | 2 | 4)  # current, future, on fault
            libc.prctl(15, b"labseq-watchdog", 0, 0, 0)  # the name in `ps` and `top`


class _Device:
    """A device, and how it is switched off."""

    def __init__(self, order: int, script: str, arguments: dict[str, Any]) -> None:
        self.order = order
        self._arguments = arguments
        name = f"labseq_emergency_{order}"
        spec = importlib.util.spec_from_file_location(name, script)
        if spec is None or spec.loader is None:
            raise ImportError(f"{script} is not a Python file")
        self._module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self._module)
        self._off = self._module.off
        if prepare := getattr(self._module, "prepare", None):
            prepare(**arguments)

    def off(self, report: Callable[[str, str], None]) -> None:
        """Switch the device off, and try again for a while if that fails."""
        deadline = time.monotonic() + TRY_AGAIN_S
        while True:
            try:
                done = self._off(**self._arguments)
                return report(str(done), "")
            except BaseException as error:  # noqa: BLE001 - after any error it is tried again
                if time.monotonic() > deadline:
                    return report("", _format_error(error))
            time.sleep(NEXT_S)


class _Process:
    """The watchdog's own process.

    Args:
        run_pid: Process id of the run. On Windows the run need not be the parent: the ``python.exe`` of a
            virtual environment only starts another one.
    """

    def __init__(self, run_pid: int) -> None:
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._devices: dict[str, _Device] = {}
        self._log: Path | None = None
        self._run_name = "the run"
        self._may_end = False
        self._run_pid = run_pid
        self._run_process: Any = None  # of psutil, on Windows
        self._hangs = Hanging(run_pid)
        self._beat_s = time.monotonic()

    def watch(self) -> None:
        """Watch until the run ends, dies or hangs."""
        threading.Thread(target=self._read, daemon=True).start()
        looked_s = told_s = time.monotonic()
        while True:
            try:
                line = self._lines.get(timeout=LOOK_S)
            except queue.Empty:
                line = b""
            else:
                self._beat_s = time.monotonic()
            if time.monotonic() - told_s > 1.5 * LOOK_S:
                told_s = time.monotonic()
                self._tell(b"\n")
            if line is None or self._is_orphan():
                return self._switch_off("died", time.monotonic())
            if line.strip() and not self._obey(json.loads(line)):
                return None
            now_s = time.monotonic()
            if now_s - looked_s > 2 * LOOK_S:  # the whole computer stopped, including the run
                self._beat_s += now_s - looked_s - LOOK_S
            looked_s = now_s
            if self._hangs(now_s - self._beat_s):
                self._end_run()
                return self._switch_off("hung", self._beat_s)

    def _read(self) -> None:
        with suppress(OSError):
            for line in sys.stdin.buffer:
                self._lines.put(line)
        self._lines.put(None)

    def _is_orphan(self) -> bool:
        """Whether the run is gone, even if another process still holds its end of the pipe."""
        if os.name == "nt":  # where the id of the parent stays, and may be given to another process
            return self._run_process is not None and not self._run_process.is_running()
        return os.getppid() != self._run_pid

    def _obey(self, order: dict[str, Any]) -> bool:
        """Carry out a message. Returns whether to go on."""
        if "run" in order:
            self._run_name, self._log = order["run"], Path(order["log"]) if order["log"] else None
            self._may_end = order["may_end"]
            sys.path += [path for path in order["path"] if path not in sys.path]
            if os.name == "nt":
                import psutil

                with suppress(psutil.NoSuchProcess):  # it has died already, so the input ends
                    self._run_process = psutil.Process(self._run_pid)
            self._answer("")
        elif "device" in order:
            try:
                device = _Device(order["order"], order["script"], order["arguments"])
            except BaseException as error:  # noqa: BLE001 - the scripts of drivers may raise anything
                self._answer(_format_error(error))
            else:
                self._devices[order["device"]] = device
                self._answer("")
        elif "forget" in order:
            self._devices.pop(order["forget"], None)
        elif "stuck" in order:
            self._end_run()
            self._switch_off(f"made no progress for {order['stuck']:.0f} s", time.monotonic())
            return False
        else:  # the end, and the remaining devices could not be made safe
            self._switch_off("could not make its devices safe", time.monotonic())
            return False
        return True

    def _answer(self, failure: str) -> None:
        self._tell(json.dumps({"failure": failure}).encode() + b"\n")

    def _tell(self, line: bytes) -> None:
        with suppress(OSError):
            os.write(1, line)

    def _end_run(self) -> None:
        """End a run that hangs, so that its ports and cards are free."""
        for name, wait_s in (("SIGTERM", TERM_S), ("SIGKILL", 2 * TERM_S)):
            if self._is_orphan():
                return
            with suppress(OSError):
                os.kill(self._run_pid, getattr(signal, name, signal.SIGTERM))
            deadline = time.monotonic() + wait_s
            while time.monotonic() < deadline and not self._is_orphan():
                time.sleep(0.002)

    def _switch_off(self, cause: str, since_s: float) -> None:
        """Switch every device off. If that fails, end the run, which may hold the ports, and try again."""
        failed = self._try_all(self._devices, cause, since_s)
        if failed and self._may_end and not self._is_orphan():
            self._end_run()
            self._try_all(failed, cause, since_s)

    def _try_all(self, devices: dict[str, _Device], cause: str, since_s: float) -> dict[str, _Device]:
        """Switch devices off in the order of the safe state, without long waits for each other.

        Returns the devices that are not off.
        """
        failed, threads = dict(devices), dict[str, threading.Thread]()
        for name, device in sorted(devices.items(), key=lambda item: item[1].order):

            def report(done: str, failure: str, name: str = name) -> None:
                self._report(cause, name, done, failure, time.monotonic() - since_s)
                if not failure:
                    failed.pop(name)

            threads[name] = threading.Thread(target=device.off, args=[report], daemon=True)
            threads[name].start()
            threads[name].join(NEXT_S)
        deadline = time.monotonic() + TRY_AGAIN_S + HANGS_S
        for name, thread in threads.items():
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                self._report(cause, name, "", "switching it off hangs", time.monotonic() - since_s)
        return failed

    def _report(self, cause: str, name: str, done: str, failure: str, after_s: float) -> None:
        """Write the outcome first to the log, then to the terminal."""
        row = {
            "t_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),  # noqa: TID251 - no other module here
            "cause": cause,
            "device": name,
            "ok": not failure,
            "text": "".join(c if c.isprintable() else " " for c in (failure or done)[:MAX_TEXT]),
            "after_s": round(after_s, 4),
        }
        if self._log is not None:
            with suppress(OSError), self._log.open("ab", buffering=0) as file:
                file.write(json.dumps(row).encode() + b"\n")
        outcome = (
            f"is NOT off: {row['text']}" if failure else f"is off after {1e3 * after_s:.0f} ms: {row['text']}"
        )
        with suppress(OSError):
            os.write(
                2, f"labseq-watchdog: {self._run_name} {cause}; {name} {outcome}\n".encode("utf-8", "replace")
            )


class Hanging:
    """Tells whether a process without a heartbeat hangs, or just waits for a disk or for the processor.

    Args:
        pid: The process.
        hung_s: How long the heartbeat of a working process may be missing. No call of a run holds the
            interpreter nearly as long as the default.
    """

    def __init__(self, pid: int, hung_s: float = 0.6) -> None:
        self._pid = pid
        self._hung_s = hung_s
        self._since: dict[str, float] | None = None

    def __call__(self, silent_s: float) -> bool:
        """Whether it hangs. Must be called regularly, also while it does not hang."""
        if silent_s < self._hung_s / 4:
            self._since = None
            return False
        states, waited_s = _threads(self._pid)
        if self._since is None:
            self._since = waited_s
        before_s = self._since
        # time in which it could not run does not count, whatever its threads are doing
        starved_s = max(
            (total_s - before_s.get(thread, total_s) for thread, total_s in waited_s.items()), default=0.0
        )
        may_be_silent_s = min(self._hung_s + starved_s, WAITS_S)
        if "D" in states and "T" not in states:
            may_be_silent_s = WAITS_S
        return silent_s > may_be_silent_s

    @property
    def is_stopped(self) -> bool:
        """Whether a signal or a debugger has stopped the process."""
        return "T" in _threads(self._pid)[0]


def _threads(pid: int) -> tuple[str, dict[str, float]]:
    """States of a process's threads, one letter each, and how long each has waited for a processor.

    Linux only, else nothing.
    """
    states, waited_s = "", {}
    with suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError, ValueError, IndexError):  # it has ended
                text = (thread / "stat").read_text(encoding="utf-8", errors="replace")
                states += text.rpartition(")")[2].split()[0].upper()
                waited_s[thread.name] = int((thread / "schedstat").read_text("ascii").split()[1]) / 1e9
    return states, waited_s


def _format_error(error: BaseException) -> str:
    """An exception as one short line, even if it has no readable text."""
    try:
        text = " ".join(str(error)[: 2 * MAX_TEXT].split())
    except BaseException:  # noqa: BLE001 - a broken __str__
        text = ""
    return f"{type(error).__name__}: {text}"[:MAX_TEXT] if text else type(error).__name__


if __name__ == "__main__":
    main()
