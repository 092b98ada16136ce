"""Priority, locked memory and awake processors between a frame and the moves, where the system grants them.

A thread with the policy SCHED_FIFO is not interrupted by other programs, locked memory is never moved to the
disk, and a processor kept out of deep sleep during an exposure keeps its caches and answers at once. Linux
grants the first two to root, and to users by ``/etc/security/limits.d``. The third needs write access to
``/dev/cpu_dma_latency``. On other systems nothing is changed.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

SWITCH_S: Final = 0.2e-3
"""How long a thread may keep Python to itself while another waits. Python's own default is 5 ms."""
LIMITS: Final = "'@GROUP - rtprio 22' and '@GROUP - memlock unlimited' in a file in /etc/security/limits.d"
LATENCY: Final = Path("/dev/cpu_dma_latency")
"""While this file is open, processors only sleep so deeply that they wake within the written time, in us."""
UDEV: Final = """KERNEL=="cpu_dma_latency", GROUP="GROUP", MODE="0660" in a file in /etc/udev/rules.d"""
IDLE_DRIVER: Final = Path("/sys/devices/system/cpu/cpuidle/current_driver")


def raise_priority(above: int = 0) -> bool:
    """Give this thread priority over all ordinary programs. Returns whether the system allows it.

    Args:
        above: How far above the thread of a shot's steps, which must not keep others from feeding a device.
    """
    # 20 is above all ordinary programs, and below the kernel's own threads, which have 50
    return any(_set_scheduler("SCHED_FIFO", 20 + more) for more in dict.fromkeys((above, 0)))


def restore_priority() -> None:
    """Give this thread normal priority again."""
    _set_scheduler("SCHED_OTHER", 0)


def _set_scheduler(policy: str, priority: int) -> bool:
    if sys.platform != "linux":
        return False
    try:
        # threads and processes that it starts are ordinary ones
        os.sched_setscheduler(0, getattr(os, policy) | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        return False
    return True


@contextmanager
def real_time() -> Generator[None]:
    """Lock the memory, switch threads quickly and keep the processors awake within the block."""
    with ExitStack() as stack:
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(SWITCH_S)
        if lock_memory():
            stack.callback(ctypes.CDLL(None).munlockall)
        with suppress(OSError):
            stack.enter_context(LATENCY.open("wb", buffering=0)).write(bytes(4))  # 0 us
        yield


def lock_memory() -> bool:
    """Keep the memory of this process out of the swap space. Returns whether the system allows it."""
    if sys.platform != "linux":
        return False
    import resource

    if os.geteuid() != 0 and resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return False  # with a limit, memory that is needed later would be refused
    with suppress(OSError, AttributeError):
        # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: memory that is only reserved takes none
        return ctypes.CDLL(None, use_errno=True).mlockall(1 | 2 | 4) == 0
    return False


def may_stay_awake() -> bool:
    """Whether this process may keep the processors awake, or the system has no sleep states at all."""
    with suppress(OSError):
        return IDLE_DRIVER.read_text("ascii").strip() == "none" or os.access(LATENCY, os.W_OK)
    return True


def missing_privileges() -> str:
    """Warning about privileges that this computer does not grant, with the remedy. "" if none are missing."""
    if sys.platform != "linux":
        return ""
    missing = {
        "priority": "" if raise_priority() else LIMITS,
        "locked memory": "" if lock_memory() else LIMITS,
        "awake processors": "" if may_stay_awake() else UDEV,
    }
    restore_priority()
    names = " and ".join(name for name, remedy in missing.items() if remedy)
    remedies = " and ".join(dict.fromkeys(filter(None, missing.values())))
    return f"without {names}, the moves after a frame may be delayed; write {remedies}" if names else ""
