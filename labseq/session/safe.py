"""`labseq safe` and `labseq devices`: open each device of a profile, test it or make it safe, close it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

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
from labseq.files import make_shared
from labseq.guard import Guard, StopFlag, stop_on_signals
from labseq.kernel import load_kernels
from labseq.messages import clean, format_error
from labseq.processes import Holder, Lock, Process
from labseq.recording import clear_active, find_dead_run, lock_file
from labseq.roles import Clock, Hardware, RunObserver, Simulation, offers
from labseq.sequencer.clock import RealClock, VirtualClock
from labseq.sequencer.lab import Timeouts, attempt, in_safe_order, method_of
from labseq.session.chosen import HARDWARE_KINDS, DryRun, check_dry_run, load_plugins
from labseq.session.lab import WARM_S, construct, timeouts_of
from labseq.session.profile import ResolvedProfile, choose_plugins, resolve_profile
from labseq.watchdog import watchdog_lines


@contextmanager
def lock_devices(
    hardware: ResolvedProfile,
    what: str,
    warn: Callable[[str], object],
    stop: StopFlag | None = None,
    *,
    blocked: Callable[[str, Holder], bool] | None = None,
) -> Generator[Callable[[str], None]]:
    """Lock a profile's devices against other processes within the block.

    A lock ends with its process, also if that is killed. Simulated devices are not locked.

    Args:
        hardware: The profile.
        what: The use of the devices, shown to other users while they are locked.
        warn: Receives a warning if nothing keeps others from a device.
        stop: Looked at again and again by a process that does not hang.
        blocked: Called with device and holder if another process has locked it; returns whether to try
            again. Without it that is an error.

    Yields:
        A function that changes this description of their use.

    Raises:
        DeviceError: Another process holds a device; names both.
    """
    locks: list[Lock] = []
    with ExitStack() as stack:
        for identity, role in hardware.identities.items():
            device = role if identity.startswith(f"{role} ") else f"{role} ({identity})"
            lock = Lock(lock_file(identity), what)
            while True:
                try:
                    make_shared(lock.path.parent)
                    holder = lock.take()
                except OSError as error:
                    text = f"{lock.path} cannot be locked: {error.strerror or error}"
                    warn(f"{text}: nothing keeps another process from {device}")
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

        if stop is not None:
            stack.enter_context(stop.beating(lambda: [lock.beat() for lock in locks]))
        yield describe


class _EndsHolders:
    """Ends processes that use devices if they hang, or if that was asked for.

    Args:
        warn: Receives what is done.
        end: Whether to end processes that do not hang, too.
    """

    def __init__(self, warn: Callable[[str], object], *, end: bool) -> None:
        self._warn = warn
        self._end = end
        self._seen: set[Process | None] = set()

    def __call__(self, device: str, holder: Holder) -> bool:
        """Whether the process has ended; once for each process."""
        if holder.process in self._seen:
            return False
        self._seen.add(holder.process)
        text = f"{device} is in use by {holder}"
        if holder.process is None or not (holder.hangs or self._end):
            self._warn(f"{text}; it is made safe all the same ('labseq safe --end' ends that process first)")
            return False
        silent = f", which has not answered for {holder.silent_s:.0f} s"
        self._warn(f"{text}{silent if holder.hangs else ''}; that process is ended first")
        try:
            has_ended = holder.process.end(END_S)
        except OSError as error:
            self._warn(f"process {holder.process.pid} cannot be ended: {error.strerror}")
            return False
        if not has_ended:
            self._warn(f"process {holder.process.pid} did not end")
        return has_ended


END_S: Final = 10.0
"""How long a process may take to make its devices safe after SIGTERM, before it is killed."""


_NEEDED_KINDS: Final = HARDWARE_KINDS | {"simulation"}


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
        """Why devices are not safe, those that were tried first; empty if all are."""
        return [error for error in [*self.attempted.values(), *self.refused.values()] if error is not None]


def make_each_safe(
    devices: Iterable[tuple[str, Hardware]],
    timeouts: Timeouts,
    simulation: Simulation | None = None,
    observer: RunObserver | None = None,
) -> dict[str, LabseqError | None]:
    """Open, make safe and close each device; one that fails never stops the others.

    Args:
        devices: Name and device, in the order of the safe state.
        timeouts: How long each call may take.
        simulation: The simulation that virtual devices act on.
        observer: Receives each device's outcome.

    Returns:
        Device name -> why it is not safe, or None. A device that is safe but
        cannot be closed is only reported to the observer, as at the end of a run.
    """
    guard = Guard()
    outcome: dict[str, LabseqError | None] = {}
    if simulation is not None and (
        failure := attempt(guard, "simulation", timeouts.call_s, simulation, "open")
    ):
        outcome["simulation"] = failure
    for name, device in devices:
        opened = attempt(guard, name, timeouts.call_s, device, "open")
        # it may be possible to make it safe even if it did not open
        safe = attempt(guard, name, timeouts.safe_state_s, device, "safe_state")
        closed = attempt(guard, name, timeouts.safe_state_s, device, "close")
        outcome[name] = opened or safe
        for event, failure in (("safe_state", outcome[name]), ("closed", closed)):
            _report(observer, event, name, failure)
    if simulation is not None:
        attempt(guard, "simulation", timeouts.call_s, simulation, "close")
    guard.end()
    return outcome


def _report(observer: RunObserver | None, event: str, name: str, failure: LabseqError | None) -> None:
    """Report the outcome of a device; a screen that fails must not keep the next one from being made safe."""
    if observer is not None:
        with suppress(BaseException):
            observer.event(event, {"device": name, "ok": failure is None, "error": str(failure or "")})


def construct_hardware(
    hardware: ResolvedProfile, clock: Clock
) -> tuple[dict[str, Any], dict[str, LabseqError]]:
    """Construct the devices of a profile, and the simulation if there is one; nothing is opened.

    Args:
        hardware: The profile.
        clock: The clock that they use.

    Returns:
        Role or device name -> object; and name -> why it could not be constructed, with its place.
    """
    chosen = {role: c for role, c in hardware.chosen.items() if c.entry.kind in _NEEDED_KINDS}
    failures: dict[str, LabseqError] = {}
    true_grid = hardware.profile.grid_model()
    made, _ = construct(chosen, hardware.context(clock), 0, true_grid=true_grid, refused=failures)
    return made, {role: chosen[role].placed(error) for role, error in failures.items()}


def make_profile_devices_safe(
    hardware: ResolvedProfile, stop: StopFlag, observer: RunObserver | None = None
) -> SafeStateReport:
    """Construct each device of a profile, open it, make it safe and close it.

    A device that cannot be constructed does not affect the others; it is reported at the end.

    Args:
        hardware: The profile.
        stop: The request to stop; not obeyed here.
        observer: Receives each device's outcome.
    """
    clock = VirtualClock(stop) if hardware.virtual_time else RealClock(stop)
    made, failures = construct_hardware(hardware, clock)
    simulation = made.pop("simulation", None)
    with stop.held():
        attempted = make_each_safe(in_safe_order(made), timeouts_of(hardware.profile), simulation, observer)
    refused: dict[str, LabseqError] = {role: e for role, e in hardware.refused.items() if role != "detector"}
    refused |= failures
    for role, error in refused.items():
        _report(observer, "safe_state", role, error)
    return SafeStateReport(attempted, refused)


def make_safe_after_crash(hardware: ResolvedProfile, key: str, stop: StopFlag, observer: RunObserver) -> None:
    """Make the devices of a profile safe if the process of their last run died, because they may still be on.

    This comes first, because constructing and compiling may fail.

    Args:
        hardware: The profile.
        key: The profile's name in the markers of runs.
        stop: The request to stop; obeyed once every device has been tried.
        observer: Receives each device's outcome, and warnings.

    Raises:
        LabseqError: The first device that is not safe.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    dead = find_dead_run(key, hardware.identities)
    if dead is None:
        return
    text = f"the last run on these devices ({dead}) died; they are made safe first"
    observer.event("warning", {"text": text})
    for line in watchdog_lines(dead):
        observer.event("warning", {"text": f"its watchdog: {clean(line)}"})
    failures = make_profile_devices_safe(hardware, stop, observer).failures
    if failures:
        raise failures[0]
    try:
        clear_active(key, hardware.identities)
    except RecordingError as failure:
        observer.event("warning", {"text": str(failure)})
    stop.check()


def make_profile_safe(
    profile: str,
    overrides: Sequence[str] = (),
    observer: RunObserver | None = None,
    *,
    end: bool = False,
) -> SafeStateReport:
    """Bring every device of a profile to its safe state.

    It does so even while another process uses them, with a warning that names it: a run in progress fails,
    or switches its devices on again. A process that hangs is ended first. Ctrl-C is obeyed once every device
    has been tried. If all devices are safe, the next run need not make them safe, however the last one ended.

    Args:
        profile: Name or path of the profile.
        overrides: ``"profile.address=value"`` strings, as given to ``--set``.
        observer: Receives each device's outcome, and warnings.
        end: Whether to end any other process that uses the devices first.

    Raises:
        ConfigError: The profile cannot be read, or does not exist; no device was touched.
        StopRequested: Ctrl-C or SIGTERM came meanwhile.
    """
    found, stop = ProblemCollector(), StopFlag()
    hardware = _read(profile, overrides, found)

    def warn(text: str) -> None:
        if observer is not None:
            observer.event("warning", {"text": text})

    with ExitStack() as stack:
        blocked = _EndsHolders(warn, end=end)
        stack.enter_context(lock_devices(hardware, "labseq safe", warn, stop, blocked=blocked))
        stack.enter_context(stop_on_signals(stop))
        secured = make_profile_devices_safe(hardware, stop, observer)
    refused = [problem for error in hardware.refused.values() for problem in error.problems]
    others = [problem for problem in found.problems if problem not in refused]
    # a problem or an override may have left out or replaced a device
    if not (secured.failures or others or overrides):
        try:
            clear_active(hardware.key, hardware.identities)
        except RecordingError as failure:
            warn(str(failure))
    if stop.is_set:
        raise StopRequested(stop.signal_number)
    return replace(secured, problems=ConfigError(others) if others else None)


def _read(profile: str, overrides: Sequence[str], found: ProblemCollector) -> ResolvedProfile:
    """Read a profile and choose its devices; errors are tolerated as long as some devices are usable."""
    for_profile = profile_overrides(overrides)
    document, spec = load_profile(profile, beside=Path(), overrides=for_profile, found=found)
    with found:
        plugin_paths(document, spec.plugin_folders)
    folders: list[Path] = []
    for folder in spec.plugin_folders:
        with suppress(ConfigError):  # reported already
            folders += plugin_paths(document, [folder])
    return choose_plugins(document, spec, load_plugins(folders, found, spec.timeouts.load), "off", found)


N_READINGS: Final = 5
"""Number of ``describe()`` calls for the latency of a device, which is the median of their times."""

_OPENING: Final = {"static_tweezers": 0, "camera": 1, "mobile_tweezers": 3}
"""Place in the order of opening; devices that are not listed have 2."""


@dataclass(frozen=True, slots=True)
class CheckedDevice:
    """The result of checking one device.

    Attributes:
        name: Its role, or its name in the profile.
        described: The device's own description; empty if the check failed before it.
        tested: Whether it passed its self test; False also if it has none.
        latency_s: Time of a ``describe()``, from the call to the answer; None if the check failed before it.
        constructed: Whether its plugin could construct it; if not, ``failure`` says why.
        failure: Why it could not be opened, identified or tested, or what interrupted that; or None.
        unsafe: Why it is not in its safe state, or None.
        unclosed: Why it could not be closed, or None.
    """

    name: str
    described: Mapping[str, Any] = field(default_factory=dict[str, Any])
    tested: bool = False
    latency_s: float | None = None
    constructed: bool = True
    failure: LabseqError | None = None
    unsafe: LabseqError | None = None
    unclosed: LabseqError | None = None

    @property
    def ok(self) -> bool:
        """Whether everything worked."""
        return self.failure is None and self.unsafe is None and self.unclosed is None


@dataclass(frozen=True, slots=True)
class DevicesReport:
    """The result of checking the devices of a profile.

    Attributes:
        devices: The checked devices in order, then those that could not be constructed.
        plugins: Name of a device -> its plugin, as after ``use:`` in the profile.
        warnings: Notes for the user that are not errors.
        stopped: The request to stop that ended the check, or None.
    """

    devices: Sequence[CheckedDevice]
    plugins: Mapping[str, str]
    warnings: Sequence[str] = ()
    stopped: StopRequested | None = None


def check_devices(profile: str, overrides: Sequence[str] = (), dry_run: DryRun = "off") -> DevicesReport:
    """Open each device of a profile in turn, identify and test it, make it safe and close it.

    One that fails or hangs never keeps the others from being tried. After Ctrl-C the
    current device is made safe and closed, and no other is opened.

    Args:
        profile: Name or path of the profile.
        overrides: ``"profile.address=value"`` strings, as given to ``--set``.
        dry_run: "off", "full" or "fast".

    Raises:
        ConfigError: The profile has an error; no device was touched.
        DeviceError: Another process uses the same real devices; none was touched.
    """
    check_dry_run(dry_run)
    hardware = resolve_profile(profile, overrides=profile_overrides(overrides), dry_run=dry_run)
    stop = StopFlag()
    is_virtual = dry_run != "off" or hardware.virtual_time
    clock = VirtualClock(stop) if is_virtual else RealClock(stop)
    warnings = [*hardware.warnings]
    with ExitStack() as stack:
        stack.enter_context(lock_devices(hardware, "labseq devices", warnings.append, stop))
        if (dead := find_dead_run(hardware.key, hardware.identities)) is not None and dry_run == "off":
            text = (
                f"the last run on these devices ({dead}) died; 'labseq safe {profile}' makes all of them safe"
            )
            warnings.append(text)
        stack.enter_context(stop_on_signals(stop))
        made, refused = construct_hardware(hardware, clock)
        simulation = made.pop("simulation", None)
        in_order = sorted(made.items(), key=lambda item: _OPENING.get(item[0], 2))
        devices = check_each_device(in_order, timeouts_of(hardware.profile), stop, simulation)
    devices += [CheckedDevice(name, constructed=False, failure=error) for name, error in refused.items()]
    plugins = {name: chosen.entry.name for name, chosen in hardware.chosen.items()}
    stopped = StopRequested(stop.signal_number) if stop.is_set else None
    return DevicesReport(devices, plugins, [*warnings, *hardware.host.notes], stopped)


def check_each_device(
    devices: Iterable[tuple[str, Hardware]],
    timeouts: Timeouts,
    stop: StopFlag,
    simulation: Simulation | None = None,
) -> list[CheckedDevice]:
    """Open, identify, test, make safe and close one device after the other.

    Args:
        devices: Name and device, in the order of opening.
        timeouts: How long each call may take.
        stop: The request to stop: the current device is made safe and closed, the others are not opened.
        simulation: The simulation that virtual devices act on: opened before them, closed after them.

    Returns:
        Those that were tried, the simulation first.
    """
    guard = Guard(stop)
    tried: list[CheckedDevice] = []
    if simulation is not None and not stop.is_set:
        tried.append(_examined(guard, "simulation", simulation, timeouts))
    try:
        for name, device in devices:
            if stop.is_set:
                break
            try:
                found = _examined(guard, name, device, timeouts)
            finally:
                with stop.held():
                    unsafe = attempt(guard, name, timeouts.safe_state_s, device, "safe_state")
                    unclosed = attempt(guard, name, timeouts.safe_state_s, device, "close")
            tried.append(replace(found, unsafe=unsafe, unclosed=unclosed))
    finally:
        if simulation is not None and tried:
            with stop.held():
                unclosed = attempt(guard, "simulation", timeouts.safe_state_s, simulation, "close")
            tried[0] = replace(tried[0], unclosed=unclosed)
        guard.end()
    return tried


def _examined(guard: Guard, name: str, device: Any, timeouts: Timeouts) -> CheckedDevice:
    """Open, identify and test a device; stops at the first failure."""
    found = CheckedDevice(name)
    try:
        if name != "simulation" and offers(device, "warm"):
            guard.call(name, WARM_S, device.warm)
            load_kernels()  # else a self test might have to compile within its timeout
        guard.call_despite_stop(name, timeouts.call_s, method_of(device, "open"))
        described: Any = guard.call(name, timeouts.call_s, method_of(device, "describe"))
        if not isinstance(described, Mapping):
            text = f"describe() gave a {type(described).__name__}; expected a mapping"
            raise DeviceError(name, text)
        found = replace(found, described=described)
        if offers(device, "self_test"):
            guard.call(name, timeouts.call_s, device.self_test)
            found = replace(found, tested=True)
        readings_s = [_reading_s(guard, name, device, timeouts.call_s) for _ in range(N_READINGS)]
        return replace(found, latency_s=statistics.median(readings_s))
    except LabseqError as failure:
        return replace(found, failure=failure)
    except Exception as failure:  # noqa: BLE001 - of the driver's class
        return replace(found, failure=DeviceError(name, format_error(failure)))


def _reading_s(guard: Guard, name: str, device: Hardware | Simulation, timeout_s: float) -> float:
    start_s = time.perf_counter()
    guard.call(name, timeout_s, device.describe)
    return time.perf_counter() - start_s
