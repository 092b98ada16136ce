"""Priority and locked memory for the time between a frame and the moves, where the system grants them.

A thread with the policy SCHED_FIFO is not interrupted by other programs, and locked memory is never moved
to the disk. Linux grants both to root, and to users by ``/etc/security/limits.d``. On other systems nothing
is changed.
"""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from typing import Final

PRIORITY: Final = 20
"""Above all ordinary programs; below the kernel's own threads, which have 50."""
SWITCH_S: Final = 0.2e-3
"""How long a thread may keep Python to itself while another waits; Python's own default is 5 ms."""
LOCK_FLAGS: Final = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT: what is used stays in memory, what is only reserved takes none."""
LIMITS: Final = "'@GROUP - rtprio 22' and '@GROUP - memlock unlimited' in a file in /etc/security/limits.d"


def raise_priority(above: int = 0) -> bool:
    """Give this thread priority over all ordinary programs; returns whether the system allows it.

    Args:
        above: How far above the thread of a shot's steps; it must not keep others from feeding a device.
    """
    return any(_set_scheduler("SCHED_FIFO", PRIORITY + more) for more in dict.fromkeys((above, 0)))


def restore_priority() -> None:
    """Make this thread an ordinary one again."""
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


def prepare_process() -> None:
    """Lock the memory, and let threads that wait for Python have it soon."""
    sys.setswitchinterval(SWITCH_S)
    lock_memory()


def lock_memory() -> bool:
    """Keep the memory of this process out of the swap space; returns whether the system allows it."""
    if sys.platform != "linux":
        return False
    import resource

    if os.geteuid() != 0 and resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return False  # with a limit, memory that is needed later would be refused
    with suppress(OSError, AttributeError):
        return ctypes.CDLL(None, use_errno=True).mlockall(LOCK_FLAGS) == 0
    return False


def refused() -> str:
    """What this computer does not grant, and how to allow it; "" if nothing is missing or can be done."""
    if sys.platform != "linux":
        return ""
    granted = {"priority": raise_priority(), "locked memory": lock_memory()}
    restore_priority()
    missing = " and ".join(name for name, is_granted in granted.items() if not is_granted)
    if not missing:
        return ""
    return f"other programs may delay the moves after a frame: no {missing}; {LIMITS} grants both"
