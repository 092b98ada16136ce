"""`labseq devices`, which opens, identifies, tests, makes safe and closes each device of a profile."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Final

from labseq import realtime
from labseq.assembly.lab import WARM_S
from labseq.assembly.options import DryRun, check_dry_run
from labseq.assembly.profile import resolve_profile
from labseq.config.addresses import profile_overrides
from labseq.errors import DeviceError, LabseqError, StopRequested
from labseq.guard import Guard, StopFlag, stop_on_signals
from labseq.kernels.kernel import load_kernels
from labseq.model.policies import Timeouts
from labseq.recording import find_dead_run
from labseq.recording.run_file import describe_end
from labseq.roles import Hardware, Simulation, in_opening_order, overrides
from labseq.safety.locks import lock_devices
from labseq.safety.safe import construct_hardware
from labseq.sequencer.clock import RealClock, VirtualClock
from labseq.sequencer.lab import attempt, open_device
from labseq.watchdog import Watchdog

N_READINGS: Final = 5
"""Number of ``describe()`` calls for the latency of a device, which is the median of their times."""


@dataclass(frozen=True, slots=True)
class CheckedDevice:
    """The result of checking one device.

    Attributes:
        name: Its role, or its name in the profile.
        described: The device's own description. Empty if the check failed earlier.
        versions: See ``Hardware.versions``.
        unversioned: Why they could not be read, or None.
        tested: Whether it passed its self test. False also if it has none.
        latency_s: Time of a ``describe()``, from the call to the answer. None if the check failed earlier.
        constructed: Whether its plugin could construct it. If not, ``failure`` says why.
        failure: The error or interruption while opening, identifying or testing it, or None.
        unsafe: Why it is not in its safe state, or None.
        unclosed: Why it could not be closed, or None.
    """

    name: str
    described: Mapping[str, Any] = field(default_factory=dict[str, Any])
    versions: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    unversioned: LabseqError | None = None
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

    If a device fails or hangs, the others are checked anyway. After Ctrl-C the current device is made safe
    and closed, and no other is opened.

    Raises:
        ConfigError: The profile has an error. No device was touched.
        DeviceError: Another process uses the same real devices. No device was touched.
    """
    check_dry_run(dry_run)
    hardware = resolve_profile(profile, overrides=profile_overrides(overrides), dry_run=dry_run)
    stop = StopFlag()
    clock = VirtualClock(stop) if hardware.virtual_time else RealClock(stop)
    warnings = [*hardware.warnings]
    with ExitStack() as stack:
        stack.enter_context(lock_devices(hardware, "labseq devices", warnings.append))
        if (dead := find_dead_run(hardware.key, hardware.identities)) is not None and dry_run == "off":
            text = (
                f"the last run on these devices ({dead}) {describe_end(dead)}; "
                f"'labseq safe {profile}' makes all of them safe"
            )
            warnings.append(text)
        stack.enter_context(stop_on_signals(stop))
        constructed, refused = construct_hardware(hardware, clock)
        simulation = constructed.pop("simulation", None)
        devices = check_each_device(
            in_opening_order(constructed), hardware.profile.timeouts, stop, simulation, warnings.append
        )
    if not hardware.virtual_time and (text := realtime.missing_privileges()):
        warnings.append(text)
    warnings += [f"{device.name}: {note}" for device in devices for note in device.described.get("notes", ())]
    devices += [CheckedDevice(name, constructed=False, failure=error) for name, error in refused.items()]
    plugins = {name: plugin_choice.entry.name for name, plugin_choice in hardware.chosen.items()}
    stopped = StopRequested(stop.signal_number) if stop.is_set else None
    return DevicesReport(devices, plugins, [*warnings, *hardware.host.notes], stopped)


def check_each_device(
    devices: Iterable[tuple[str, Hardware]],
    timeouts: Timeouts,
    stop: StopFlag,
    simulation: Simulation | None = None,
    warn: Callable[[str], object] = str,
) -> list[CheckedDevice]:
    """Open, identify, test, make safe and close one device after the other.

    The watchdog switches a device off if this process dies or hangs, or if the safe state fails.

    Args:
        devices: Name and device, in the order of opening.
        stop: The request to stop, after which the current device is made safe and closed, and no other
            opened.
        simulation: The simulation that virtual devices act on. It is opened before and closed after them.
        warn: Receives warnings about the watchdog.

    Returns:
        The checked devices, the simulation first.
    """
    guard, watchdog = Guard(stop), Watchdog("labseq devices", pulse=stop.pulse)
    tried: list[CheckedDevice] = []
    if simulation is not None and not stop.is_set:
        tried.append(_examine_simulation(guard, simulation, timeouts))
    try:
        for name, device in devices:
            if stop.is_set:
                break
            try:
                checked = _examine(guard, name, device, timeouts, watchdog)
            finally:
                with stop.held():  # a second Ctrl-C must not leave it on
                    unsafe = attempt(guard, name, timeouts.safe_state_s, device.safe_state)
                    unclosed = attempt(guard, name, timeouts.safe_state_s, device.close)
                    if unsafe is None:
                        watchdog.forget([name])
            tried.append(replace(checked, unsafe=unsafe, unclosed=unclosed))
    finally:
        watchdog.end()
        for note in watchdog.notes():
            warn(note)
        if simulation is not None and tried:
            with stop.held():
                unclosed = attempt(guard, "simulation", timeouts.safe_state_s, simulation.close)
            tried[0] = replace(tried[0], unclosed=unclosed)
        guard.end()
    return tried


def _examine_simulation(guard: Guard, simulation: Simulation, timeouts: Timeouts) -> CheckedDevice:
    """Open and identify the simulation."""
    name = "simulation"
    try:
        guard.call_despite_stop(name, timeouts.call_s, simulation.open)
        described = guard.call(name, timeouts.call_s, simulation.describe)
        readings_s = [_reading_s(guard, name, simulation, timeouts.call_s) for _ in range(N_READINGS)]
        return CheckedDevice(name, described, latency_s=statistics.median(readings_s))
    except LabseqError as failure:
        return CheckedDevice(name, failure=failure)


def _examine(
    guard: Guard, name: str, device: Hardware, timeouts: Timeouts, watchdog: Watchdog
) -> CheckedDevice:
    """Open, identify and test a device. Stops at the first failure."""
    checked = CheckedDevice(name)
    try:
        guard.call(name, WARM_S, device.warm)
        load_kernels()  # else a self test might have to compile within its timeout
        open_device(guard, name, device, timeouts.call_s, watchdog, 0)
        described: Any = guard.call(name, timeouts.call_s, device.describe)
        if not isinstance(described, Mapping):
            text = f"describe() gave a {type(described).__name__}; expected a mapping"
            raise DeviceError(name, text)
        checked = replace(checked, described=described)
        checked = _read_versions(guard, checked, device, timeouts.call_s)
        guard.call(name, timeouts.call_s, device.self_test)
        checked = replace(checked, tested=overrides(device, Hardware.self_test))
        # the median, as the first call may be slow
        readings_s = [_reading_s(guard, name, device, timeouts.call_s) for _ in range(N_READINGS)]
        return replace(checked, latency_s=statistics.median(readings_s))
    except LabseqError as failure:
        return replace(checked, failure=failure)


def _read_versions(guard: Guard, checked: CheckedDevice, device: Hardware, timeout_s: float) -> CheckedDevice:
    """Read the versions of a device. A failure is noted, but does not mean that the device is faulty."""

    def versions() -> dict[str, tuple[str, str]]:
        return {
            name: (str(installed), str(tested)) for name, (installed, tested) in device.versions().items()
        }

    try:
        return replace(checked, versions=guard.call(checked.name, timeout_s, versions))
    except StopRequested:
        raise
    except LabseqError as failure:
        return replace(checked, unversioned=failure)


def _reading_s(guard: Guard, name: str, device: Hardware | Simulation, timeout_s: float) -> float:
    start_s = time.perf_counter()
    guard.call(name, timeout_s, device.describe)
    return time.perf_counter() - start_s
