"""The watchdog: a small process that switches the outputs off when the run that uses them dies or hangs.

A run starts it before it opens its devices, passes on how each is switched off (``Emergency``), and sends a
heartbeat. The watchdog needs the standard library alone: it must start fast, stay small, and work when
nothing else does. Messages are lines of JSON on its standard input; an empty line is a heartbeat; the end
of the input without ``end`` is the death of the run. It answers in the same way on its standard output, so
that the run notices when the watchdog dies or stands still, and starts another one.
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
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import subprocess

    from labseq.guard import Pulse

WATCHDOG_LOG: Final = "watchdog.jsonl"
"""Name of its log in the folder of a run."""
BEAT_S: Final = 0.05
"""Interval between two heartbeats, and between two looks of the watchdog."""
WAITS_S: Final = 10.0
"""How long the heartbeat may be missing while a thread waits for a disk, swapped memory or a processor."""
STUCK_S: Final = 10.0
"""A run counts as dead if its thread of shots has neither waited nor made progress for this long."""
TERM_S: Final = 0.1
"""How long a run that hangs may take to end after SIGTERM; then comes SIGKILL."""
NEXT_S: Final = 0.05
"""How long the switching off of a device delays that of the next one."""
TRY_AGAIN_S: Final = 5.0
"""How long switching off is tried again if it fails: a dying process may hold the device a little longer."""
HANGS_S: Final = 1.0
"""How long after that it counts as hanging."""
ANSWER_S: Final = 10.0
"""How long a run waits for an answer of the watchdog, which may have to load a vendor's library."""
END_S: Final = 1.0
"""How long a run waits for the end of a watchdog that has nothing left to do."""
MAX_TEXT: Final = 500
"""Length at which texts of errors are cut."""


def main() -> None:
    """Run the watchdog: lines on standard input, one answer for each device on standard output."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK", "SIGPIPE"):
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    _take_precedence()
    _Process().watch()
    os._exit(0)  # its threads may still wait for a device or for the run


def _take_precedence() -> None:
    """Real-time priority, memory that is not swapped out, and last to be ended for want of it; if allowed."""
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
            except BaseException as error:  # noqa: BLE001 - whatever it raises, it is tried again
                if time.monotonic() > deadline:
                    return report("", _format_error(error))
            time.sleep(NEXT_S)


class _Process:
    """The watchdog's own process."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._devices: dict[str, _Device] = {}
        self._log: Path | None = None
        self._run_name = "the run"
        self._may_end = False
        self._parent = os.getppid()
        self._hangs = Hanging(self._parent)
        self._beat_s = time.monotonic()

    def watch(self) -> None:
        """Watch until the run ends, dies or hangs."""
        threading.Thread(target=self._read, daemon=True).start()
        looked_s = told_s = time.monotonic()
        while True:
            try:
                line = self._lines.get(timeout=BEAT_S)
            except queue.Empty:
                line = b""
            else:
                self._beat_s = time.monotonic()
            if time.monotonic() - told_s > 1.5 * BEAT_S:
                told_s = time.monotonic()
                self._tell(b"\n")
            if line is None or self._is_orphan():
                return self._switch_off("died", time.monotonic())
            if line.strip() and not self._obey(json.loads(line)):
                return None
            now_s = time.monotonic()
            if now_s - looked_s > 2 * BEAT_S:  # the computer stood still, and so did the run
                self._beat_s += now_s - looked_s - BEAT_S
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
        """Whether the run is gone although another process still holds its end of the pipe."""
        return os.name != "nt" and os.getppid() != self._parent

    def _obey(self, order: dict[str, Any]) -> bool:
        """Carry out a message; returns whether to go on."""
        if "run" in order:
            self._run_name, self._log = order["run"], Path(order["log"]) if order["log"] else None
            self._may_end = order["may_end"]
            sys.path += [path for path in order["path"] if path not in sys.path]
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
        else:  # the end; devices that are left could not be made safe
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
                os.kill(self._parent, getattr(signal, name, signal.SIGTERM))
            deadline = time.monotonic() + wait_s
            while time.monotonic() < deadline and not self._is_orphan():
                time.sleep(0.002)

    def _switch_off(self, cause: str, since_s: float) -> None:
        """Switch every device off; for those that it cannot, end the process that may hold their ports."""
        failed = self._try_all(self._devices, cause, since_s)
        if failed and self._may_end and not self._is_orphan():
            self._end_run()
            self._try_all(failed, cause, since_s)

    def _try_all(self, devices: dict[str, _Device], cause: str, since_s: float) -> dict[str, _Device]:
        """Switch devices off in the order of the safe state, none waiting long for another.

        Returns those that are not off.
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
        """Write down what was done, first to the log, then to the terminal."""
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
        hung_s: How long the heartbeat of a working process may be missing; no call of a run holds the
            interpreter nearly as long as the default.
    """

    def __init__(self, pid: int, hung_s: float = 0.6) -> None:
        self._pid = pid
        self._hung_s = hung_s
        self._since: dict[str, float] | None = None

    def __call__(self, silent_s: float) -> bool:
        """Whether it hangs; to be asked again and again, also while it does not."""
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
    """An exception as one short line, even if its own text cannot be had."""
    try:
        text = " ".join(str(error)[: 2 * MAX_TEXT].split())
    except BaseException:  # noqa: BLE001 - a broken __str__
        text = ""
    return f"{type(error).__name__}: {text}"[:MAX_TEXT] if text else type(error).__name__


def watchdog_lines(run_dir: Path) -> list[str]:
    """What the watchdog of a run did, a line for each device; damaged lines of its log are left out."""
    from labseq.errors import RecordingError
    from labseq.files import read_lines  # not in the watchdog itself, which imports little

    lines: list[str] = []
    with suppress(RecordingError):
        for row in read_lines(run_dir / WATCHDOG_LOG)[0]:
            with suppress(ValueError, TypeError, KeyError):
                outcome = f"off after {1e3 * row['after_s']:.0f} ms" if row["ok"] else "NOT switched off"
                lines.append(f"{row['device']} {outcome}, because the run {row['cause']}: {row['text']}")
    return lines


class Watchdog:
    """The run's side: starts the watchdog, reports the devices to it, and sends the heartbeat.

    A watchdog that dies, or stands still, is replaced, as often as needed. If that is not possible, ``lost``
    is called; where it cannot be started at all, there is a warning. Nothing here raises.

    Args:
        what: What the watchdog calls the run in its messages.
        log: File to which it adds a line for each device that it switches off; None for none.
        pulse: Progress of the thread that adds the first device; without any, the run counts as dead to the
            watchdog. None if there is no such thread.
        lost: Called with the reason if no watchdog is left; it ends the run.
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
        from labseq.guard import Pulse  # not in the watchdog itself

        log_path = None if log is None else str(log.absolute())
        self._about = {"run": run_name, "log": log_path, "path": sys.path, "may_end": may_end}
        self._devices: dict[str, dict[str, Any]] = {}
        self._notes: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None
        self._is_silent: Callable[[float], bool] = lambda _: False
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
        """Have it switch a device off after the death of this process; the first one starts it.

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
        self._tell(device)  # without the lock: heartbeats go on while it loads libraries

    def forget(self, names: Iterable[str]) -> None:
        """Leave devices alone from now on: they are safe and closed."""
        with self._sending:
            for name in names:
                if self._devices.pop(name, None) is not None:
                    self._send({"forget": name})

    def end(self) -> None:
        """End it; it then switches off the devices that it was not asked to forget. Legal at any time."""
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
                except Exception:  # noqa: BLE001 - it stands still
                    process.kill()
                    process.wait()

    def notes(self) -> list[str]:
        """What went wrong since the last call, for the user."""
        notes: list[str] = []
        with suppress(queue.Empty):
            while True:
                notes.append(self._notes.get_nowait())
        return notes

    def _launch(self) -> bool:
        """Start the process, and send it the devices that are open; returns whether it answers."""
        import subprocess

        flags = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(
            subprocess, "CREATE_NEW_PROCESS_GROUP", 0
        )
        self._answers = queue.SimpleQueue()
        self._wake.clear()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - this file, no shell
                [sys.executable, "-I", "-S", __file__],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C and a lost terminal are not for it
                creationflags=flags,
            )
            threading.Thread(target=self._hear, args=[self._process, self._answers], daemon=True).start()
        except (OSError, RuntimeError, MemoryError) as error:
            self._note(f"cannot be started: {getattr(error, 'strerror', None) or error}")
            return False
        # a watchdog without a sign of life for this long is replaced
        self._is_silent = Hanging(self._process.pid, hung_s=0.4)
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
        """Send a message that is answered, and note the failure that it names; False without answer."""
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
            failure = _format_error(error)
        finally:
            self._n_awaited -= 1
        if failure:
            name = message.get("device")
            self._note(f"cannot switch off '{name}': {failure}" if name else failure)
        return answer != b""

    def _await_answer(self) -> bytes:
        """Wait for an answer, unless the process was stopped."""
        answers, process, deadline_s = self._answers, self._process, time.monotonic() + ANSWER_S
        while True:
            if self._pulse is not None:
                self._pulse.beat()  # it may be the thread that takes the shots that waits here
            try:
                return answers.get(timeout=BEAT_S)
            except queue.Empty:
                is_stopped = process is not None and "T" in _threads(process.pid)[0]
                if is_stopped or time.monotonic() > deadline_s:
                    raise

    def _send(self, message: dict[str, Any] | None) -> bool:
        """Send a message, or a heartbeat; returns whether it could be sent."""
        line = b"\n" if message is None else json.dumps(message).encode() + b"\n"
        with self._sending, suppress(OSError, ValueError):
            if self._process is not None and self._process.stdin is not None:
                self._process.stdin.write(line)
                return True
        return False

    def _beat(self) -> None:
        """Send heartbeats; have the run ended if it makes no progress; replace a watchdog that is gone.

        While this thread does not run either, the computer stands still: of that time little counts.
        """
        n_failed, looked_s = 0, time.monotonic()
        while not self._ended.is_set():
            has_ended = self._wake.wait(BEAT_S)
            now_s = time.monotonic()
            passed_s, looked_s = min(now_s - looked_s, 2 * BEAT_S), now_s
            self._check_progress(passed_s)
            silent_s = self._heard.silent_s(passed_s)
            limit_s = ANSWER_S if self._n_awaited else 0.0
            is_silent = self._is_silent(silent_s) and silent_s > limit_s
            if self._send(None) and not has_ended and not is_silent:
                continue
            if self._replace("does not answer" if is_silent else "has ended"):
                n_failed = 0
            elif (n_failed := n_failed + 1) == 3:  # this many in a row have not come to life
                self._note("cannot be started again; the run ends")
                with self._sending:
                    self._kill()  # without a heartbeat it would end the run before the devices are safe
                self._lost("no watchdog is left that would switch the outputs off")
                return

    def _replace(self, why: str) -> bool:
        """Start another watchdog in place of one that is gone; returns whether it answers."""
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


if __name__ == "__main__":
    main()
