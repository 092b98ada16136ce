"""One at a time on the same real devices."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.assembly.profile import resolve_profile
from labseq.errors import DeviceError
from labseq.guard import StopFlag
from labseq.plugin.serial import port_identities
from labseq.processes import HANG_S, Lock, Process
from labseq.recording import find_dead_run, lock_file, mark_active
from labseq.safety.devices import check_devices
from labseq.safety.locks import lock_devices
from labseq.safety.safe import make_profile_safe, make_safe_after_crash
from labseq.testing.fakes import RecordingObserver
from tests.plugins.labseq_soapy_rig import until

from .small_runs import OWN_DEVICE, PROFILE

SEQUENCE = """
labseq: 1
name: look
profile: ./p.yaml
shots: 2
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - load: {duration: 1 ms}
  - image: {}
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/mine.py").write_text(OWN_DEVICE, encoding="utf-8")
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")
    write("mine")


def write(shutter: str, profile: str = "p.yaml") -> None:
    own = f"plugin_folders: [{Path('plugins').absolute()}]\ndevices: {{shutter: {{use: {shutter}}}}}\n"
    Path(profile).write_text(PROFILE + own, encoding="utf-8")


@pytest.fixture
def held() -> Generator[None]:
    with lock_devices(resolve_profile("./p.yaml"), "the run x", pytest.fail):
        yield


def run(observer: RecordingObserver | None = None, **options: Any) -> labseq.Run:
    with labseq.Session.open("s.yaml", observer=observer, **options) as session:
        return session.run()


def test_a_second_run_is_refused_with_the_name_of_the_first(held: None) -> None:
    with pytest.raises(
        DeviceError, match=r"bench: shutter is in use by the run x \(process \d+ on .*\)"
    ) as e:
        run(output="elsewhere")
    assert "labseq stop" in str(e.value)
    assert not Path("elsewhere").exists()


def test_the_devices_are_free_after_a_run_and_after_one_that_failed() -> None:
    run()
    with lock_devices(resolve_profile("./p.yaml"), "me", pytest.fail):
        pass
    Path("plugins/mine.py").write_text(
        OWN_DEVICE.replace("open(self): pass", "open(self): 1 / 0"), encoding="utf-8"
    )
    with pytest.raises(DeviceError):
        run()
    with lock_devices(resolve_profile("./p.yaml"), "me", pytest.fail):
        pass


def test_a_run_locks_its_devices_with_its_name() -> None:
    class Looking(RecordingObserver):
        reported = ""

        def event(self, name: str, values: object) -> None:
            if name == "run_started":
                with pytest.raises(DeviceError) as caught:
                    check_devices("./p.yaml")
                self.reported = str(caught.value)

    looking = Looking()
    done = run(looking)
    assert f"in use by the run {done.path} (process {os.getpid()} on " in looking.reported


def test_devices_are_not_tested_while_they_are_in_use(held: None) -> None:
    with pytest.raises(DeviceError, match="bench: shutter is in use by the run x"):
        check_devices("./p.yaml")
    assert check_devices("./p.yaml", dry_run="fast").devices  # it touches none
    assert not Path("data").exists()


def test_devices_are_made_safe_even_while_they_are_in_use(held: None) -> None:
    seen = RecordingObserver()
    assert not make_profile_safe("./p.yaml", observer=seen).failures
    (warning,) = (v["text"] for v in seen.of("warning"))
    assert warning.startswith(f"shutter is in use by the run x (process {os.getpid()} on ")
    assert "; making it safe anyway" in warning


HOLD = """
import signal, sys
from pathlib import Path
from labseq.processes import Lock
signal.signal(signal.SIGTERM, signal.SIG_IGN)
lock = Lock(Path(sys.argv[1]), "the run x")
assert lock.take() is None
print("held", flush=True)
input()
lock.release()
"""


@pytest.mark.parametrize("end", [False, True])
def test_a_process_that_hangs_or_is_to_end_is_ended_before_its_devices_are_made_safe(
    end: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("END_S", "HUNG_END_S"):
        monkeypatch.setattr(f"labseq.safety.safe.{name}", 0.1)
    seen, file = RecordingObserver(), lock_file(*resolve_profile("./p.yaml").identities)
    command = [sys.executable, "-c", HOLD, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        silent_ns = time.monotonic_ns() - int(1e9 * (HANG_S + 10))
        if not end:
            os.utime(file.with_name(f"{file.name}.holder"), ns=(silent_ns, silent_ns))
        assert not make_profile_safe("./p.yaml", observer=seen, may_end=lambda _: end).failures
        assert child.wait(120.0) != 0
    (warning,) = (v["text"] for v in seen.of("warning"))
    assert warning.startswith(f"shutter is in use by the run x (process {child.pid} on ")
    assert ("which has not answered for " in warning) is not end
    assert warning.endswith("; that process is ended first")


@pytest.mark.skipif(sys.platform == "win32", reason="ends in the POSIX way")
def test_standing_by_makes_safe_what_a_process_that_dies_or_hangs_leaves_on() -> None:
    """And nothing else: not while a process works, and not after one that released its lock."""
    text = OWN_DEVICE.replace("safe_state(self): pass", "safe_state(self): open('log', 'a').write('safe ')")
    Path("plugins/mine.py").write_text(text, encoding="utf-8")
    file = lock_file(*resolve_profile("./p.yaml").identities)
    about = file.with_name(f"{file.name}.holder")
    with ExitStack() as stack:
        watching = child_of(stack, "-m", "labseq", "safe", "./p.yaml", "--stand-by")
        assert watching.stdout.readline() == "standing by for shutter; Ctrl-C ends this\n"
        ends = child_of(stack, "-c", HOLD, str(file))
        assert ends.stdout.readline() == "held\n"
        ends.communicate("\n", timeout=120.0)
        child = child_of(stack, "-c", HOLD, str(file))
        assert child.stdout.readline() == "held\n"
        silent_ns = time.monotonic_ns() - 10 * 10**9
        os.utime(about, ns=(silent_ns, silent_ns))
        told = watching.stdout.readline()
        assert re.search(rf"the run x \(process {child.pid} on .*\) has not answered for \d+ s$", told)
        assert "that process is ended first" in watching.stdout.readline()
        assert watching.stdout.readline().split() == ["shutter", "safe"]
        run = child_of(stack, "-m", "labseq", "run", "s.yaml", "--shots", "100000")  # without a watchdog
        until(lambda: run.poll() is not None or list(Path("data").glob("*/*/shots/*")) != [], 120.0)
        assert run.poll() is None
        run.kill()
        assert re.search(
            rf" the run /.*0001_look \(process {run.pid} on .* died$", watching.stdout.readline()
        )
        assert watching.stdout.readline().split() == ["shutter", "safe"]
        assert find_dead_run(str(Path("p.yaml").resolve()), resolve_profile("./p.yaml").identities) is None
        watching.send_signal(signal.SIGINT)
        assert watching.communicate(timeout=120.0)[0] == ""
        assert watching.returncode == 0
    assert Path("log").read_text() == "safe safe "


def test_what_the_last_run_may_have_left_on_is_told_in_whole_sentences(tmp_path: Path) -> None:
    error = "DeviceTimeoutError: shutter: no reply to 'PING' within 1 s; is it switched on? check 'baud_rate'"
    hardware, observer = resolve_profile("./p.yaml"), RecordingObserver()
    (tmp_path / "STATE").write_text(json.dumps({"state": "failed", "error": error}), "utf-8")
    row = {"cause": "could not make its devices safe", "device": "shutter", "ok": False, "text": error}
    (tmp_path / "watchdog.jsonl").write_text(json.dumps(row | {"after_s": 5.2}) + "\n", "utf-8")
    mark_active(hardware.key, hardware.identities, tmp_path)
    make_safe_after_crash(tmp_path, hardware, StopFlag(), observer)
    end, watchdog = (warning["text"] for warning in observer.of("warning"))
    assert end == (
        f"the last run on these devices ({tmp_path}) did not leave all of them safe ({error}); "
        "they are made safe first"
    )
    because = "because the run could not make its devices safe"
    assert watchdog == f"its watchdog: shutter NOT switched off, {because}: {error}"


def child_of(stack: ExitStack, *arguments: str) -> Any:
    pipe, command = subprocess.PIPE, [sys.executable, *arguments]
    child = stack.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
    stack.callback(child.kill)
    return child


def test_a_process_that_uses_devices_gives_signs_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq.safety.locks.BEAT_S", 0.001)
    other = Lock(lock_file(*resolve_profile("./p.yaml").identities), "other")
    with lock_devices(resolve_profile("./p.yaml"), "the run x", pytest.fail):
        long_ago = time.monotonic_ns() - 3600 * 10**9
        os.utime(f"{other.path}.holder", ns=(long_ago, long_ago))
        deadline_s = time.monotonic() + 10.0
        while (holder := other.take()) is None or holder.hangs:
            assert time.monotonic() < deadline_s


IDENTIFIED = """
class Settings(labseq.plugin.Settings):
    card: str = "A"

    def identities(self):
        return [f"card {self.card}"]


class Mine(labseq.plugin.Device):"""


def test_locks_and_markers_follow_the_hardware_not_the_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = OWN_DEVICE.replace("class Mine(labseq.plugin.Device):", IDENTIFIED).replace(
        '("mine", Mine)', '("mine", Mine, Settings)'
    )
    Path("plugins/mine.py").write_text(text, encoding="utf-8")
    Path("copies").mkdir()
    write("mine", "copies/copy.yaml")
    write("mine, card: B", "copies/other.yaml")
    with lock_devices(resolve_profile("./p.yaml"), "the run x", pytest.fail):
        monkeypatch.setenv("LABSEQ_STATE", str(tmp_path / "elsewhere"))
        monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "other data"))
        with pytest.raises(DeviceError, match=r"bench: shutter \(card A\) is in use by the run x \(process"):
            check_devices("copies/copy.yaml")
        assert all(device.ok for device in check_devices("copies/other.yaml").devices)
    run_dir = tmp_path / "run"
    mark_active(str(Path("p.yaml").resolve()), ["card A"], run_dir)
    monkeypatch.setattr(Process, "is_running", False)
    report = check_devices("copies/copy.yaml")
    (warning,) = report.warnings
    assert warning.startswith(
        f"the last run on these devices ({run_dir}) died; 'labseq safe copies/copy.yaml'"
    )
    assert not make_profile_safe("copies/other.yaml").failures
    assert find_dead_run("copies/copy.yaml", ["card A"]) == run_dir
    assert not make_profile_safe("copies/copy.yaml").failures
    assert find_dead_run("copies/copy.yaml", ["card A"]) is None


@pytest.mark.skipif(sys.platform == "win32", reason="there are no links to ports")
def test_a_link_to_a_port_is_the_port(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    link, port = (port_identities(str(tmp_path / name)) for name in ("by-id", "ttyUSB0"))
    assert set(link) & set(port) == {str(tmp_path / "ttyUSB0")}


def test_simulated_devices_and_dry_runs_are_not_locked(held: None) -> None:
    assert run(dry_run="full").status == "complete"
    write("virtual")
    assert run().status == "complete"
    assert check_devices("./p.yaml").devices


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
def test_a_folder_without_locks_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    seen = RecordingObserver()
    assert run(seen).status == "complete"
    (warning,) = (v["text"] for v in seen.of("warning") if "lock" in v["text"])
    file = lock_file(*resolve_profile("./p.yaml").identities)
    reason = "No locks available"
    assert warning == f"{file} cannot be locked: {reason}; another process could use shutter at the same time"
