"""Priority and locked memory, where this system grants them."""

import os
import subprocess
import sys

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
    text = realtime.refused()
    assert "no priority;" in text
    assert "limits.d" in text
    monkeypatch.setattr(realtime, "raise_priority", lambda: True)
    assert not realtime.refused()


def test_memory_is_not_locked_under_a_limit(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, 65536))
    assert not realtime.lock_memory()
