"""``labseq devices``: open each device of a profile, let it identify and test itself, and close it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Final

from labseq.config import profile_overrides
from labseq.errors import DeviceError, LabseqError, StopRequested
from labseq.recording import data_root, marker_roots
from labseq.roles import Hardware, ReceivesOutput, HasSelfTest, Simulation, NeedsWarmUp
from labseq.sequencer import Guard, RealClock, StopFlag, VirtualClock
from labseq.sequencer.lab import Timeouts
from labseq.session.choosing import DryRun, check_dry_run
from labseq.session.holding import lock_devices
from labseq.session.labs import timeouts_of
from labseq.session.safe import attempt, construct_hardware
from labseq.session.setting_up import resolve_profile
from labseq.session.signals import stop_on_signals
from labseq.session.warming import WARM_S

N_READINGS: Final = 5
"""How often a device is read for its latency, which is their median."""

_OPENING: Final = {"static_tweezers": 0, "camera": 1, "mobile_tweezers": 3}
"""Place in the order of opening; further devices have 2."""


@dataclass(frozen=True, slots=True)
class CheckedDevice:
    """What was found out about one device.

    Attributes:
        name: Its role, or its name in the profile.
        described: What it says of itself; empty if it did not get so far.
        tested: Whether it passed its self test; False also if it has none.
        latency_s: Time of a ``describe()``, from the call to the answer; None if it did not get so far.
        constructed: Whether its plugin made it at all; if not, ``failure`` says why.
        failure: Why it could not be opened, identified or tested, or what broke that off; or None.
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
        """Whether nothing went wrong."""
        return self.failure is None and self.unsafe is None and self.unclosed is None


@dataclass(frozen=True, slots=True)
class DevicesReport:
    """What was found out about the devices of a profile.

    Attributes:
        devices: Each that was tried, in order, then those that could not be constructed.
        plugins: Name of a device -> what plays it, as after ``use:`` in the profile.
        warnings: What the user should know although it is no error.
        stopped: The request to stop that broke it off, or None.
    """

    devices: Sequence[CheckedDevice]
    plugins: Mapping[str, str]
    warnings: Sequence[str] = ()
    stopped: StopRequested | None = None


def check_devices(profile: str, overrides: Sequence[str] = (), dry_run: DryRun = "off") -> DevicesReport:
    """Open each device of a profile in turn, identify and test it, make it safe and close it.

    One that fails or hangs never keeps the others from being tried. After Ctrl-C the
    device at hand is made safe and closed, and no other is opened.

    Args:
        profile: Name or path of the profile.
        overrides: ``"profile.address=value"`` strings, as given to ``--set``.
        dry_run: "off", "full" or "fast".

    Raises:
        ConfigError: The profile is wrong; no device was touched.
        DeviceError: Somebody else uses the same devices, real ones; none was touched.
    """
    check_dry_run(dry_run)
    roots = marker_roots(data_root())
    bench = resolve_profile(profile, overrides=profile_overrides(overrides), dry_run=dry_run)
    stop = StopFlag()
    is_virtual = dry_run != "off" or bench.virtual_time
    clock = VirtualClock(stop) if is_virtual else RealClock(stop)
    warnings = [*bench.warnings]
    with ExitStack() as stack:
        if not is_virtual:
            stack.enter_context(lock_devices(bench, roots, "labseq devices", warnings.append))
        stack.enter_context(stop_on_signals(stop))
        made, refused = construct_hardware(bench, clock)
        simulation = made.pop("simulation", None)
        in_order = sorted(made.items(), key=lambda item: _OPENING.get(item[0], 2))
        devices = check_each_device(in_order, timeouts_of(bench.profile), stop, simulation)
    devices += [CheckedDevice(name, constructed=False, failure=error) for name, error in refused.items()]
    plugins = {name: chosen.entry.name for name, chosen in bench.chosen.items()}
    stopped = StopRequested(stop.signal_number) if stop.is_set else None
    return DevicesReport(devices, plugins, [*warnings, *bench.host.notes], stopped)


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
        stop: The request to stop: the device at hand is made safe and closed, the rest left alone.
        simulation: The world that virtual devices act on: opened before them, closed after them.

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
                    unsafe = attempt(guard, name, timeouts.safe_state_s, device.safe_state)
                    unclosed = attempt(guard, name, timeouts.safe_state_s, device.close)
            tried.append(replace(found, unsafe=unsafe, unclosed=unclosed))
    finally:
        if simulation is not None and tried:
            with stop.held():
                unclosed = attempt(guard, "simulation", timeouts.safe_state_s, simulation.close)
            tried[0] = replace(tried[0], unclosed=unclosed)
        guard.end()
    return tried


def _examined(guard: Guard, name: str, device: Hardware | Simulation, timeouts: Timeouts) -> CheckedDevice:
    """Open, identify and test a device, as far as it goes."""
    found = CheckedDevice(name)
    try:
        if isinstance(device, NeedsWarmUp) and not isinstance(device, ReceivesOutput):
            guard.call(name, WARM_S, device.warm)  # else a self test might have to compile within its timeout
        guard.call_to_the_end(name, timeouts.call_s, device.open)
        described: Any = guard.call(name, timeouts.call_s, device.describe)
        if not isinstance(described, Mapping):
            text = f"describe() gave a {type(described).__name__}; expected a mapping"
            raise DeviceError(name, text)
        found = replace(found, described=described)
        if isinstance(device, HasSelfTest):
            guard.call(name, timeouts.call_s, device.self_test)
            found = replace(found, tested=True)
        readings_s = [_reading_s(guard, name, device, timeouts.call_s) for _ in range(N_READINGS)]
        return replace(found, latency_s=statistics.median(readings_s))
    except LabseqError as failure:
        return replace(found, failure=failure)


def _reading_s(guard: Guard, name: str, device: Hardware | Simulation, timeout_s: float) -> float:
    start_s = time.perf_counter()
    guard.call(name, timeout_s, device.describe)
    return time.perf_counter() - start_s
