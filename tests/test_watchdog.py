"""The watchdog: outputs off after any death or hang of their process, and never without one."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from labseq import watchdog_process
from labseq.watchdog import Watchdog

EMERGENCY = """
import pathlib

def prepare(name, then=""):
    if then == "missing":
        raise OSError("no such library")
    with pathlib.Path(name).with_name("ready").open("a") as ready:
        ready.write(pathlib.Path(name).name + " ")

def off(name, then=""):
    if then == "fails":
        class Broken(BaseException):
            def __str__(self):
                raise ValueError
        raise Broken
    if then == "hangs":
        import time
        time.sleep(60)
    pathlib.Path(name).unlink(missing_ok=True)
    return "shutter closed"
"""

RUN = """
import ctypes, os, signal, sys, threading, time
from pathlib import Path
from labseq import watchdog
from labseq.guard import Pulse
from labseq.watchdog import Watchdog

folder = Path(sys.argv[1])
dog = Watchdog("the run", folder / "watchdog.jsonl", Pulse())
for order, name in (2, "second"), (1, "first"):
    (folder / name).touch()
    dog.add(name, order, folder / "emergency.py", {"name": str(folder / name)})
print("on", *dog.notes(), flush=True)

def lose_terminal():
    import fcntl, termios
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored if the tests run under nohup
    terminal, mine = os.openpty()
    os.setsid()
    fcntl.ioctl(mine, termios.TIOCSCTTY, 0)
    os.close(terminal)
    time.sleep(30)

"""
SAFE = "dog.forget(['first', 'second']); dog.end()"

ENDS = {  # what the process does -> the cause that the watchdog names
    "kill -9": ("os.kill(os.getpid(), getattr(signal, 'SIGKILL', signal.SIGTERM))", "died"),
    "_exit": ("os._exit(0)", "died"),
    "crash in C": ("ctypes.string_at(0)", "died"),
    "an error": ("raise ValueError", "died"),
    "a closed terminal": ("lose_terminal()", "died"),
    "fork": ("if os.fork(): os.kill(os.getpid(), signal.SIGKILL)\ntime.sleep(1)", "died"),
    "stopped": ("os.kill(os.getpid(), signal.SIGSTOP)", "hung"),
    "no progress": ("watchdog.STUCK_S = 0.3; time.sleep(30)", "made no progress for 0 s"),
    "a C call": (
        "ctypes.PyDLL('kernel32').Sleep(30_000) if os.name == 'nt' else ctypes.PyDLL(None).sleep(30)",
        "hung",
    ),
    "unsafe": ("dog.forget(['other']); dog.end()", "could not make its devices safe"),
}
POSIX_ENDS = {"a closed terminal", "fork", "stopped"}


def start(folder, then):
    (folder / "emergency.py").write_text(EMERGENCY, encoding="utf-8")
    return subprocess.Popen(
        [sys.executable, "-c", RUN + then, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def rows(folder):
    file = folder / "watchdog.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def await_rows(folder, n):
    deadline = time.monotonic() + 20.0
    while len(rows(folder)) < n and time.monotonic() < deadline:
        time.sleep(0.005)
    return rows(folder)


@pytest.mark.parametrize("end", ENDS if os.name != "nt" else sorted(ENDS.keys() - POSIX_ENDS))
def test_outputs_go_off_in_order_whatever_ends_the_process(tmp_path, end):
    then, cause = ENDS[end]
    process = start(tmp_path, then)
    assert process.stdout is not None
    assert process.stdout.readline() == "on\n"
    found = await_rows(tmp_path, 2)
    assert [(row["device"], row["cause"], row["ok"]) for row in found] == [
        ("first", cause, True),
        ("second", cause, True),
    ]
    assert {row["text"] for row in found} == {"shutter closed"}
    assert not (tmp_path / "first").exists()
    _, err = process.communicate(timeout=20.0)
    assert f"labseq-watchdog: the run {cause}; second is off after" in err


def test_nothing_is_switched_off_without_need(tmp_path):
    busy = "[sum(range(1000)) for _ in range(30000)]; import gc; gc.collect(); time.sleep(0.8)\n"
    process = start(tmp_path, busy + SAFE)
    process.communicate(timeout=60.0)  # until the watchdog, too, has closed its end
    assert rows(tmp_path) == []
    assert (tmp_path / "first").exists()


def test_a_device_that_cannot_be_switched_off_does_not_delay_the_others(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(watchdog_process, "TRY_AGAIN_S", 0.2)
    monkeypatch.setattr(watchdog_process, "HANGS_S", 0.1)
    script = tmp_path / "emergency.py"
    script.write_text(EMERGENCY, encoding="utf-8")
    process = watchdog_process._Process(os.getpid())
    process._obey({"run": "the run", "log": str(tmp_path / "watchdog.jsonl"), "path": [], "may_end": False})
    for order, (name, then) in enumerate(
        {"fails": "fails", "hangs": "hangs", "third": "", "lost": "missing"}.items()
    ):
        arguments = {"name": str(tmp_path / name), "then": then}
        process._obey({"device": name, "order": order, "script": str(script), "arguments": arguments})
    process._obey({"device": "typo", "order": 9, "script": str(tmp_path / "typo.py"), "arguments": {}})
    failures = [json.loads(line)["failure"] for line in capfd.readouterr().out.splitlines()]
    assert failures[:5] == ["", "", "", "", "OSError: no such library"]
    assert failures[5].startswith("FileNotFoundError")
    process._switch_off("died", time.monotonic())
    first, *failed = rows(tmp_path)
    assert (first["device"], first["ok"]) == ("third", True)
    assert {row["device"]: row["text"] for row in failed} == {
        "fails": "Broken",
        "hangs": "switching it off hangs",
    }
    assert "fails is NOT off: Broken" in capfd.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="stops processes the POSIX way")
def test_a_watchdog_that_dies_or_stands_still_is_replaced_as_often_as_needed(tmp_path):
    again = """
for number in [signal.SIGKILL, signal.SIGSTOP] * 2:
    ready = folder / "ready"
    ready.unlink()
    os.kill(dog._process.pid, number)
    while not ready.exists() or sorted(ready.read_text().split()) != ["first", "second"]:
        time.sleep(0.01)
print(*dog.notes(), flush=True)
os._exit(0)
"""
    process = start(tmp_path, again)
    out, _ = process.communicate(timeout=60.0)
    assert "has ended, and is started again" in out
    assert "does not answer, and is started again" in out
    assert [row["device"] for row in await_rows(tmp_path, 2)] == ["first", "second"]


@pytest.mark.parametrize(
    ("states", "waited_s", "silent_s", "hangs"),
    [
        ("SS", 0.0, 0.5, False),
        ("SS", 0.0, 0.7, True),
        ("TT", 0.0, 0.7, True),
        ("RS", 0.05, 0.7, True),  # a C call that computes
        ("RS", 0.2, 0.7, False),  # the same, on a busy computer: it had the processor for half a second
        ("SS", 0.2, 0.9, True),
        ("RS", 2.0, 2.5, False),
        ("RS", 10.5, 11.0, True),
        ("DS", 0.0, 5.0, False),  # it waits for a disk
        ("DS", 0.0, 11.0, True),
        ("DT", 0.0, 0.7, True),
        ("", 0.0, 0.7, True),  # not on this system
    ],
)
def test_a_process_that_waits_for_the_computer_does_not_hang(monkeypatch, states, waited_s, silent_s, hangs):
    is_hanging, all_s = watchdog_process.Hanging(0), [7.0]
    monkeypatch.setattr(
        watchdog_process, "_threads", lambda _: (states, {"1": 7.0, "2": all_s[0]} if states else {})
    )
    assert not is_hanging(0.1)
    all_s[0] += 1.0  # while it worked
    assert not is_hanging(0.2)
    all_s[0] += waited_s
    assert is_hanging(silent_s) is hangs


def test_without_a_watchdog_there_is_a_warning(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    dog = Watchdog()
    dog.add("lines", 0, Path("emergency.py"), {})
    assert any("cannot be started: " in note for note in dog.notes())
    dog.end()


@pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux reports it")
def test_the_watchdog_is_small(tmp_path):
    (tmp_path / "emergency.py").write_text(EMERGENCY, encoding="utf-8")
    dog = Watchdog()
    dog.add("lines", 0, tmp_path / "emergency.py", {"name": str(tmp_path / "lines")})
    assert dog._process is not None
    text = Path(f"/proc/{dog._process.pid}/status").read_text()
    resident = next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS"))
    dog.forget(["lines"])
    dog.end()
    assert resident < 20_000  # kB
