"""Priority, locked memory and awake processors, where this system grants them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from labseq import realtime

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems are left as they are")


def test_a_thread_has_priority_until_it_is_restored_and_its_children_have_none():
    if not realtime.raise_priority():
        pytest.skip("not granted to this user")
    child = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
    try:
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        inherited = int(subprocess.run(child, capture_output=True, check=True).stdout)
    finally:
        realtime.restore_priority()
    assert inherited == os.SCHED_OTHER
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER


def test_what_is_refused_is_named_with_the_way_to_allow_it(monkeypatch):
    monkeypatch.setattr(realtime, "raise_priority", lambda: False)
    monkeypatch.setattr(realtime, "lock_memory", lambda: True)
    monkeypatch.setattr(realtime, "may_stay_awake", lambda: True)
    text = realtime.missing_privileges()
    assert text.startswith("without priority, ")
    assert "limits.d" in text
    assert "udev" not in text
    monkeypatch.setattr(realtime, "raise_priority", lambda: True)
    assert not realtime.missing_privileges()


@pytest.mark.parametrize("is_granted", [True, False])
def test_processors_stay_awake_for_a_run_in_real_time(monkeypatch, tmp_path, is_granted):
    latency, driver = tmp_path / "cpu_dma_latency", tmp_path / "current_driver"
    driver.write_text("intel_idle\n")
    if is_granted:
        latency.touch()
    else:
        latency.mkdir()  # nobody may write there, not even root
    monkeypatch.setattr(realtime, "LATENCY", latency)
    monkeypatch.setattr(realtime, "IDLE_DRIVER", driver)
    monkeypatch.setattr(os, "access", lambda *_: is_granted)
    monkeypatch.setattr(realtime, "lock_memory", lambda: True)
    with realtime.real_time():
        opened = {os.path.realpath(fd) for fd in Path("/proc/self/fd").iterdir()}
        assert (str(latency) in opened) == is_granted
    assert not is_granted or latency.read_bytes() == bytes(4)
    assert ("awake processors" in realtime.missing_privileges()) != is_granted
    driver.write_text("none\n")
    assert "awake" not in realtime.missing_privileges()


def test_what_a_run_in_real_time_changes_is_given_back():
    before = sys.getswitchinterval()
    with realtime.real_time():
        assert sys.getswitchinterval() == pytest.approx(realtime.SWITCH_S)
        is_locked = _locked_kb() > 0
    assert is_locked == realtime.lock_memory()  # root alone may
    with realtime.real_time():
        pass
    assert sys.getswitchinterval() == before
    assert _locked_kb() == 0


def _locked_kb() -> int:
    lines = Path("/proc/self/status").read_text("ascii").splitlines()
    return int(next(line for line in lines if line.startswith("VmLck")).split()[1])


def test_memory_is_not_locked_under_a_limit(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, 65536))
    assert not realtime.lock_memory()
