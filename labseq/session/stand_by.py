"""`labseq safe --stand-by`: make devices safe when a process that uses them dies or hangs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final

from labseq.errors import ConfigError, DeviceError, ProblemCollector, RecordingError, StopRequested
from labseq.guard import StopFlag, stop_on_signals
from labseq.plain import now
from labseq.processes import HANG_S, Holder, Lock, Process
from labseq.recording import clear_active, lock_file
from labseq.roles import RunObserver
from labseq.sequencer.lab import in_safe_order
from labseq.session.locks import end_holders, lock_devices, named
from labseq.session.profile import ResolvedProfile
from labseq.session.safe import make_profile_devices_safe, read_devices, report_outcome, warn
from labseq.watchdog import TRY_AGAIN_S, Hanging

LOOK_S: Final = 0.1
"""How often :func:`stand_by` looks."""
FIRST_S: Final = 0.5
"""Head start of the watchdog of a run, which is faster and may still be there."""


def stand_by(
    profile: str,
    overrides: Sequence[str] = (),
    observer: RunObserver | None = None,
    tell: Callable[[str], object] = str,
) -> None:
    """Make devices safe when a process that uses them dies without having done so, or hangs; until Ctrl-C.

    The locks of the devices say which process that is; devices that other processes use are left alone.

    Args:
        tell: Receives the devices at the beginning, then each process that died or hangs.

    Raises:
        ConfigError: The profile has an error, or names no device that is locked while it is in use.
    """
    found, stop = ProblemCollector(), StopFlag()
    hardware = read_devices(profile, overrides, found)
    if found.problems:
        raise ConfigError(found.problems)
    identities = hardware.identities
    if not identities:
        text = "all of its devices are simulated, and those are not locked; there is nothing to stand by for"
        raise ConfigError(f"{hardware.document.path}: {text}")
    devices = ", ".join(named(role, identity) for identity, role in identities.items())
    look = _Look(identities)
    with stop_on_signals(stop), suppress(StopRequested):
        tell(f"standing by for {devices}; Ctrl-C ends this")
        while True:
            stop.wait(LOOK_S)
            for holder, roles in look.new_troubles():
                why = f"has not answered for {holder.silent_s:.0f} s" if holder.is_running else "died"
                tell(f"{now().astimezone():%Y-%m-%d %H:%M:%S} {holder} {why}")
                stop.wait(FIRST_S)
                for role in roles:
                    _secure(hardware, role, stop, look, observer)


def _secure(
    profile: ResolvedProfile, role: str, stop: StopFlag, look: _Look, observer: RunObserver | None
) -> None:
    """Make one device safe, and try again for a while, unless a process that works has begun to use it."""
    hardware = replace(profile, chosen={role: profile.chosen[role]})
    to_user, deadline_s = partial(warn, observer), time.monotonic() + TRY_AGAIN_S
    ends = end_holders(to_user, end=False)

    def blocked(device: str, holder: Holder) -> bool:
        if not look.is_in_trouble(holder):
            raise DeviceError(role, f"in use by {holder}, and left alone")
        return ends(device, holder)

    try:
        with lock_devices(hardware, "labseq safe --stand-by", to_user, blocked=blocked):
            while failures := make_profile_devices_safe(hardware, stop).failures:
                if time.monotonic() > deadline_s:
                    break
                stop.wait(FIRST_S)
            report_outcome(observer, "safe_state", role, next(iter(failures), None))
            if not failures:
                clear_active(hardware.key, hardware.identities)
    except (DeviceError, RecordingError) as error:
        to_user(str(error))


class _Look:
    """Looks for processes that died or hang while they use devices.

    Args:
        identities: What identifies each device -> its role.
    """

    def __init__(self, identities: Mapping[str, str]) -> None:
        self._identities = identities
        self._hanging: dict[Process, Hanging] = {}
        self._seen: set[Process | None] = set()

    def new_troubles(self) -> list[tuple[Holder, list[str]]]:
        """Each such process, once, and its devices in the order of the safe state."""
        found: dict[Holder, dict[str, None]] = {}
        for identity, role in self._identities.items():
            holder = Lock(lock_file(identity), "").holder()
            if holder is not None and holder.process not in self._seen and self.is_in_trouble(holder):
                known = next((one for one in found if one.process == holder.process), holder)
                found.setdefault(known, {})[role] = None
        self._seen |= {holder.process for holder in found}
        return [(holder, [role for role, _ in in_safe_order(roles)]) for holder, roles in found.items()]

    def is_in_trouble(self, holder: Holder) -> bool:
        """Whether the process died, or hangs."""
        process = holder.process
        if process is None or not process.is_here or process.pid == os.getpid():
            return False
        hangs = self._hanging.setdefault(process, Hanging(process.pid, HANG_S))
        return not holder.is_running or hangs(holder.silent_s)
