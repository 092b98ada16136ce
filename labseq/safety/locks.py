"""Locks on the devices of a profile, so that only one process at a time uses them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from labseq.assembly.profile import ResolvedProfile
from labseq.errors import DeviceError
from labseq.files import make_shared
from labseq.processes import Holder, Lock
from labseq.recording import lock_file

BEAT_S: Final = 0.5
"""Time between two signs of life of a process that uses devices, in seconds."""


@contextmanager
def lock_devices(
    hardware: ResolvedProfile,
    purpose: str,
    warn: Callable[[str], object],
    *,
    blocked: Callable[[str, Holder], bool] | None = None,
) -> Generator[Callable[[str], None]]:
    """Lock a profile's devices against other processes within the block.

    A lock ends with its process, even if that is killed. Simulated devices are not locked.

    Args:
        purpose: The use of the devices, shown to other users while they are locked.
        warn: Receives a warning if a device cannot be locked.
        blocked: Called with device and holder if another process has locked it. Returns whether to try again.
            Without it that is an error.

    Yields:
        A function that changes ``purpose``.

    Raises:
        DeviceError: Another process holds a device. The message names both.
    """
    locks: list[Lock] = []
    with ExitStack() as stack:
        for identity, role in hardware.identities.items():
            device = device_text(role, identity)
            lock = Lock(lock_file(identity), purpose)
            while True:  # again once the process that held it has been ended
                try:
                    make_shared(lock.path.parent)
                    holder = lock.take()
                except OSError as error:
                    # a folder without locks must prevent neither work nor `labseq safe`
                    text = f"{lock.path} cannot be locked: {error.strerror or error}"
                    warn(f"{text}; another process could use {device} at the same time")
                    break
                if holder is None:
                    stack.callback(lock.release)
                    locks.append(lock)
                    break
                if blocked is None:
                    text = f"{device} is in use by {holder}"
                    advice = "wait for its end, or end a run with 'labseq stop'"
                    raise DeviceError(hardware.profile.name, f"{text}; {advice}")
                if not blocked(device, holder):
                    break

        def describe(text: str) -> None:
            for lock in locks:
                lock.describe(text)

        stack.enter_context(_beating(locks))
        yield describe


@contextmanager
def _beating(locks: Sequence[Lock]) -> Generator[None]:
    """Give signs of life from a separate thread, which stops only if the whole interpreter does."""
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(BEAT_S):
            for lock in locks:
                lock.beat()

    if locks:
        threading.Thread(target=beat, name="labseq locks", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def device_text(role: str, identity: str) -> str:
    """A device with its identity, for the user."""
    return role if identity.startswith(f"{role} ") else f"{role} ({identity})"
