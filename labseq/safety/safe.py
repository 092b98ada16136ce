"""Makes each device safe, for `labseq safe`, its `--stand-by`, and a run after a run that died."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from labseq.assembly.lab import construct
from labseq.assembly.plugin_choice import load_plugins
from labseq.assembly.profile import ResolvedProfile, choose_plugins
from labseq.config.addresses import profile_overrides
from labseq.config.document import plugin_paths
from labseq.config.profile import load_profile
from labseq.errors import (
    ConfigError,
    DeviceError,
    LabseqError,
    ProblemCollector,
    RecordingError,
    StopRequested,
)
from labseq.guard import Guard, StopFlag, stop_on_signals
from labseq.messages import one_line
from labseq.model.policies import Timeouts
from labseq.plain import now
from labseq.processes import HANG_S, Holder, Lock, Process
from labseq.recording import clear_active, lock_file
from labseq.recording.run_file import describe_end
from labseq.roles import Clock, Hardware, RunObserver, Simulation, in_safe_order
from labseq.safety.locks import device_text, lock_devices
from labseq.sequencer.clock import RealClock, VirtualClock
from labseq.sequencer.lab import attempt, failure_of, open_device
from labseq.watchdog import Watchdog, watchdog_lines
from labseq.watchdog_process import TRY_AGAIN_S, Hanging

END_S: Final = 10.0
"""Time that a process has after SIGTERM to make its devices safe before it is killed, in seconds."""
HUNG_END_S: Final = 0.5
"""Time before a process that hangs is killed, as it cannot obey SIGTERM, in seconds."""


@dataclass(frozen=True, slots=True)
class SafeStateReport:
    """The outcome of making the devices of a profile safe.

    Attributes:
        attempted: Name of each device that could be constructed -> why it is not safe, or None.
        refused: Name of each other device -> why it was not constructed, with its place in the profile.
        problems: Other errors in the profile, or None.
    """

    attempted: Mapping[str, LabseqError | None]
    refused: Mapping[str, LabseqError]
    problems: ConfigError | None = None

    @property
    def failures(self) -> list[LabseqError]:
        """Why devices are not safe, tried devices before refused ones. Empty if all are safe."""
        return [error for error in [*self.attempted.values(), *self.refused.values()] if error is not None]


def make_each_safe(
    devices: Iterable[tuple[str, Hardware]],
    timeouts: Timeouts,
    simulation: Simulation | None = None,
    observer: RunObserver | None = None,
) -> dict[str, LabseqError | None]:
    """Open, make safe and close each device, even if others fail.

    The watchdog switches a device off if this process dies or hangs, or if the safe state fails.

    Args:
        devices: Name and device, in the order of the safe state.

    Returns:
        Device name -> why it is not safe, or None. A device that is safe but
        cannot be closed is only reported to the observer, as at the end of a run.
    """
    stop = StopFlag()
    guard, watchdog = Guard(stop), Watchdog("labseq safe", pulse=stop.pulse)
    outcome: dict[str, LabseqError | None] = {}
    if simulation is not None and (failure := attempt(guard, "simulation", timeouts.call_s, simulation.open)):
        outcome["simulation"] = failure
    for order, (name, device) in enumerate(devices):
        opening = partial(open_device, guard, name, device, timeouts.call_s, watchdog, order)
        opened = failure_of(name, "open()", opening)
        # it may be possible to make it safe even if it did not open
        safe = attempt(guard, name, timeouts.safe_state_s, device.safe_state)
        closed = attempt(guard, name, timeouts.safe_state_s, device.close)
        if safe is None:
            watchdog.forget([name])
        outcome[name] = opened or safe
        for event, failure in (("safe_state", outcome[name]), ("closed", closed)):
            report_outcome(observer, event, name, failure)
    watchdog.end()
    for text in watchdog.notes():
        warn(observer, text)
    if simulation is not None:
        attempt(guard, "simulation", timeouts.call_s, simulation.close)
    guard.end()
    return outcome


def warn(observer: RunObserver | None, text: str) -> None:
    """Report a warning."""
    if observer is not None:
        with suppress(BaseException):
            observer.event("warning", {"text": text})


def report_outcome(observer: RunObserver | None, event: str, name: str, failure: LabseqError | None) -> None:
    """Report the outcome of a device. Errors are ignored, so that the next device is made safe anyway."""
    if observer is not None:
        with suppress(BaseException):
            observer.event(event, {"device": name, "ok": failure is None, "error": str(failure or "")})


def construct_hardware(
    hardware: ResolvedProfile, clock: Clock
) -> tuple[dict[str, Any], dict[str, LabseqError]]:
    """Construct the devices of a profile, and the simulation if there is one, without opening them.

    Returns:
        Role or device name -> object, and name -> why it could not be constructed, with its place.
    """
    plugin_choices = {role: choice for role, choice in hardware.chosen.items() if choice.entry.role.has_twin}
    failures: dict[str, LabseqError] = {}
    truth = hardware.profile.grid_model(), hardware.profile.motion
    devices, _ = construct(plugin_choices, hardware.context(clock), 0, truth=truth, refused=failures)
    return devices, {role: plugin_choices[role].placed(error) for role, error in failures.items()}


def make_profile_devices_safe(
    hardware: ResolvedProfile, stop: StopFlag, observer: RunObserver | None = None
) -> SafeStateReport:
    """Construct each device of a profile, open it, make it safe and close it.

    A device that cannot be constructed does not affect the others. It is reported at the end.

    Args:
        stop: The request to stop, which is not obeyed here.
    """
    clock = VirtualClock(stop) if hardware.virtual_time else RealClock(stop)
    devices, failures = construct_hardware(hardware, clock)
    simulation = devices.pop("simulation", None)
    with stop.held():
        attempted = make_each_safe(in_safe_order(devices), hardware.profile.timeouts, simulation, observer)
    # a detector is not a device, so nothing stays on if it cannot be constructed
    refused: dict[str, LabseqError] = {
        role: error for role, error in hardware.refused.items() if role != "detector"
    }
    refused |= failures
    for role, error in refused.items():
        report_outcome(observer, "safe_state", role, error)
    return SafeStateReport(attempted, refused)


def make_safe_after_crash(
    dead: Path, hardware: ResolvedProfile, stop: StopFlag, observer: RunObserver
) -> None:
    """Make the devices of a profile safe after their last run died, because they may still be on.

    Args:
        dead: The folder of that run.
        hardware: The profile.
        stop: The request to stop, obeyed once every device has been tried.
        observer: Receives warnings.

    Raises:
        LabseqError: The first device that is not safe.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    text = f"the last run on these devices ({dead}) {describe_end(dead)}; they are made safe first"
    observer.event("warning", {"text": text})
    for line in watchdog_lines(dead):
        observer.event("warning", {"text": f"its watchdog: {one_line(line)}"})
    failures = make_profile_devices_safe(hardware, stop, observer).failures
    if failures:
        raise failures[0]
    try:
        clear_active(hardware.key, hardware.identities)
    except RecordingError as failure:
        observer.event("warning", {"text": str(failure)})
    stop.check()


def make_profile_safe(
    profile: str,
    overrides: Sequence[str] = (),
    observer: RunObserver | None = None,
    *,
    may_end: Callable[[str], bool] = lambda _: True,
) -> SafeStateReport:
    """Bring every device of a profile to its safe state.

    Another process that uses them is ended first, because most devices cannot be opened twice, and a run
    would switch them on again. Ctrl-C is obeyed once every device has been tried. If all devices are safe,
    the next run need not make them safe, however the last run ended.

    Args:
        may_end: Called with the device in use, returns whether to end a process that does not hang. If it
            must not be ended, the devices are made safe anyway, as far as that is possible.

    Raises:
        ConfigError: The profile cannot be read, or does not exist. No device was touched.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    problems, stop, to_user = ProblemCollector(), StopFlag(), partial(warn, observer)
    hardware = read_devices(profile, overrides, problems)
    with ExitStack() as stack:
        blocked = end_holders(profile, to_user, may_end)
        stack.enter_context(lock_devices(hardware, "labseq safe", to_user, blocked=blocked))
        stack.enter_context(stop_on_signals(stop))
        secured = make_profile_devices_safe(hardware, stop, observer)
    refused = [problem for error in hardware.refused.values() for problem in error.problems]
    other_problems = [problem for problem in problems.problems if problem not in refused]
    # a problem or an override may have left out or replaced a device
    if not (secured.failures or other_problems or overrides):
        try:
            clear_active(hardware.key, hardware.identities)
        except RecordingError as failure:
            to_user(str(failure))
    if stop.is_set:
        raise StopRequested(stop.signal_number)
    return replace(secured, problems=ConfigError(other_problems) if other_problems else None)


def read_devices(profile: str, overrides: Sequence[str], problems: ProblemCollector) -> ResolvedProfile:
    """Read a profile and choose its devices. Errors are tolerated as long as some devices are usable."""
    for_profile = profile_overrides(overrides)
    document, spec = load_profile(profile, overrides=for_profile, problems=problems)
    with problems:
        plugin_paths(document, spec.plugin_folders)
    folders: list[Path] = []
    for folder in spec.plugin_folders:
        with suppress(ConfigError):  # reported already, and other folders may have the devices' plugins
            folders += plugin_paths(document, [folder])
    return choose_plugins(document, spec, load_plugins(folders, spec.timeouts.load_s), "off", problems)


FIRST_S: Final = 0.5
"""Head start for the watchdog of a run, which is faster and may still be running."""


def stand_by(
    profile: str,
    overrides: Sequence[str] = (),
    observer: RunObserver | None = None,
    announce: Callable[[str], object] = str,
) -> None:
    """Until Ctrl-C, make devices safe when a process that uses them hangs, or dies and leaves them on.

    The locks of the devices name that process. Devices that other processes use are left alone.

    Args:
        announce: Receives the devices at the beginning, then each process that died or hangs.

    Raises:
        ConfigError: The profile has an error, or names no device that is locked while it is in use.
    """
    problems, stop = ProblemCollector(), StopFlag()
    hardware = read_devices(profile, overrides, problems)
    if problems.problems:
        raise ConfigError(problems.problems)
    identities = hardware.identities
    if not identities:
        text = "all its devices are simulated and thus not locked, so there is nothing to stand by for"
        raise ConfigError(f"{hardware.document.path}: {text}")
    devices = ", ".join(device_text(role, identity) for identity, role in identities.items())
    watch = _DeviceWatch(identities)
    with stop_on_signals(stop), suppress(StopRequested):
        announce(f"standing by for {devices}; Ctrl-C ends this")
        while True:
            stop.wait(0.1)  # a process that dies is noticed within this
            for holder, roles in watch.new_troubles():
                trouble = f"has not answered for {holder.silent_s:.0f} s" if holder.is_running else "died"
                announce(f"{now().astimezone():%Y-%m-%d %H:%M:%S} {holder} {trouble}")
                stop.wait(FIRST_S)
                for role in roles:  # one by one, as another process may use some of them again
                    _secure(hardware, role, stop, watch, observer)


def _secure(
    profile: ResolvedProfile, role: str, stop: StopFlag, watch: _DeviceWatch, observer: RunObserver | None
) -> None:
    """Make one device safe, with retries for a while, unless a working process has begun to use it."""
    hardware = replace(profile, chosen={role: profile.chosen[role]})
    to_user, deadline_s = partial(warn, observer), time.monotonic() + TRY_AGAIN_S
    # a working process is never ended
    ends = end_holders(str(profile.document.path), to_user, lambda _: False)

    def blocked(device: str, holder: Holder) -> bool:
        if not watch.is_in_trouble(holder):
            raise DeviceError(role, f"left alone, because it is in use by {holder}")
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


class _DeviceWatch:
    """Finds processes that died or hang while they use devices.

    Args:
        identities: Identity of each device -> its role.
    """

    def __init__(self, identities: Mapping[str, str]) -> None:
        self._identities = identities
        self._hanging: dict[Process, Hanging] = {}
        self._seen: set[Process | None] = set()

    def new_troubles(self) -> list[tuple[Holder, list[str]]]:
        """Each such process, reported once, with its devices in the order of the safe state."""
        troubles: dict[Holder, dict[str, None]] = {}
        for identity, role in self._identities.items():
            holder = Lock(lock_file(identity), "").holder()
            if holder is not None and holder.process not in self._seen and self.is_in_trouble(holder):
                entry = next(
                    (known_holder for known_holder in troubles if known_holder.process == holder.process),
                    holder,
                )
                troubles.setdefault(entry, {})[role] = None
        self._seen |= {holder.process for holder in troubles}
        return [(holder, [role for role, _ in in_safe_order(roles)]) for holder, roles in troubles.items()]

    def is_in_trouble(self, holder: Holder) -> bool:
        """Whether the process died, or hangs."""
        process = holder.process
        if process is None or not process.is_here or process.pid == os.getpid():
            return False
        hangs = self._hanging.setdefault(process, Hanging(process.pid, HANG_S))
        return not holder.is_running or hangs(holder.silent_s)


def end_holders(
    profile: str, warn: Callable[[str], object], may_end: Callable[[str], bool]
) -> Callable[[str, Holder], bool]:
    """A function for ``blocked`` of :func:`lock_devices` that ends each process that uses devices, once.

    Args:
        profile: The profile, as it is named in commands.
        warn: Receives a line for each action.
        may_end: Called with the device in use, returns whether to end a process that does not hang.
    """
    tried = set[Process | None]()

    def has_ended(device: str, holder: Holder) -> bool:
        process, text = holder.process, f"{device} is in use by {holder}"
        if process in tried:
            return False
        tried.add(process)  # only once, even if it still holds the next device
        is_other = process is not None and process.is_here and process.pid != os.getpid()
        if process is None or not is_other or not (holder.hangs or may_end(text)):
            hint = f"; 'labseq safe {profile} --end' ends that process first" if is_other else ""
            warn(f"{text}; making it safe anyway, as far as that is possible{hint}")
            return False
        silent = f", which has not answered for {holder.silent_s:.0f} s" if holder.hangs else ""
        warn(f"{text}{silent}; that process is ended first")
        try:
            ended = process.end(HUNG_END_S if holder.hangs else END_S)
        except OSError as error:
            warn(f"process {process.pid} cannot be ended: {error.strerror}")
            return False
        if not ended:
            warn(f"process {process.pid} did not end")
        return ended

    return has_ended
