"""`labseq serve-devices`: serves the devices of a profile, each on its own port."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Final

from labseq.assembly.plugin_choice import ChosenPlugin
from labseq.assembly.profile import ResolvedProfile, resolve_profile
from labseq.config.addresses import profile_overrides
from labseq.errors import (
    ConfigError,
    DeviceError,
    LabseqError,
    Problem,
    RecordingError,
    StopRequested,
    one_of,
)
from labseq.guard import StopFlag, stop_on_signals
from labseq.messages import clean, format_error
from labseq.plain import now
from labseq.recording import clear_active
from labseq.remote.control import Control
from labseq.remote.drivers import DeviceEntry
from labseq.remote.gate import Gate
from labseq.remote.known import KnownKeys
from labseq.remote.served import POLL_S, ServedDevice
from labseq.safety.devices import check_each_device
from labseq.safety.locks import lock_devices
from labseq.safety.safe import construct_hardware
from labseq.sequencer.clock import RealClock
from labseq.wire import (
    find_keys,
    is_loopback,
    keys_root,
    parse_address,
    require_packages,
    server_socket,
)
from labseq.wire.keys import Keys

END_S: Final = 10.0
"""Longest time for the devices to become safe when the server ends, in seconds."""


@dataclass(frozen=True, slots=True)
class Serving:
    """The served devices and their address.

    Attributes:
        address: ``tcp://HOST:PORT`` with the control's port. The devices have the next ports.
        devices: Roles and names of devices. Empty for all real ones of the profile, or all if none is real.
        plain: Whether to serve without keys, on this computer only.
    """

    address: str
    devices: tuple[str, ...] = ()
    plain: bool = False


def serve_devices(
    profile: str, overrides: Sequence[str], options: Serving, report: Callable[[str], object]
) -> None:
    """Serve devices until Ctrl-C or SIGTERM, and then make them safe.

    First each device is opened, tested, made safe and closed. This shows that it works, and makes it safe
    if an earlier server died.

    Raises:
        ConfigError: The profile, the address or the keys are wrong, or a device could not be constructed.
        DeviceError: A device fails, or another process uses it.
    """
    require_packages()
    stop = StopFlag()
    with stop_on_signals(stop), serving(profile, overrides, options, report) as server:
        try:
            while True:
                stop.wait(POLL_S)
                server.check()
        except StopRequested:
            report("stopping; devices in use are made safe")


@contextmanager
def serving(
    profile: str, overrides: Sequence[str], options: Serving, report: Callable[[str], object]
) -> Generator[Server]:
    """Context manager that serves devices like :func:`serve_devices` until the end of the block."""
    try:
        host, port = parse_address(options.address)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if options.plain and not is_loopback(host):
        hint = "make keys with 'labseq keys new' (--plain is for addresses such as tcp://127.0.0.1:5760)"
        raise ConfigError(
            Problem(f"{options.address} can be reached from other computers, so it needs keys", hint=hint)
        )
    keys = None if options.plain else find_keys(keys_root())
    whole = resolve_profile(profile, overrides=profile_overrides(overrides))
    hardware = replace(whole, chosen=_served(whole, options.devices))
    simulation = None
    if any(plugin.virtual_time for plugin in hardware.chosen.values()):
        simulation = whole.chosen.get("simulation")
    with ExitStack() as stack:
        stack.enter_context(lock_devices(hardware, "labseq serve-devices", report))
        report(f"testing {', '.join(hardware.chosen)}")
        _test(hardware, simulation, report)
        with suppress(RecordingError):  # all are safe now
            clear_active(hardware.key, hardware.identities)
        server = Server(_entries(hardware, simulation), host, port, keys, report)
        stack.callback(server.end)
        server.start()
        yield server


def _served(hardware: ResolvedProfile, names: tuple[str, ...]) -> dict[str, ChosenPlugin]:
    """The devices to serve, which are the named ones, else the real ones, else all."""
    devices = {name: plugin for name, plugin in hardware.chosen.items() if plugin.entry.role.is_hardware}
    for name in names:
        if name not in devices:
            expected = one_of([*devices])
            raise ConfigError(Problem(f"the profile has no device '{clean(name)}'", expected=expected))
        if devices[name].entry.name == "remote":
            raise ConfigError(f"'{name}' is itself on another computer; serve it there")
    local = {name: plugin for name, plugin in devices.items() if plugin.entry.name != "remote"}
    real = [name for name, plugin in local.items() if not plugin.virtual_time]
    return {name: local[name] for name in names or real or local}


def _entries(hardware: ResolvedProfile, simulation: ChosenPlugin | None) -> list[DeviceEntry]:
    entries: list[DeviceEntry] = []
    for name, plugin in hardware.chosen.items():
        identities = tuple(identity for identity, role in hardware.identities.items() if role == name)
        entries.append(DeviceEntry(name, plugin, simulation if plugin.virtual_time else None, identities))
    return entries


def _test(
    hardware: ResolvedProfile, simulation: ChosenPlugin | None, report: Callable[[str], object]
) -> None:
    """Test all devices, then raise the first failure."""
    if simulation is not None:
        hardware = replace(hardware, chosen={**hardware.chosen, "simulation": simulation})
    stop = StopFlag()
    devices, errors = construct_hardware(hardware, RealClock(stop))
    device_simulation = devices.pop("simulation", None)
    failures: list[LabseqError] = [*errors.values()]
    for device in check_each_device(
        devices.items(), hardware.profile.timeouts, stop, device_simulation, report
    ):
        failures += filter(None, (device.failure, device.unsafe, device.unclosed))
    for failure in failures[1:]:
        report(f"error: {failure}")
    if failures:
        raise failures[0]


class Server:
    """The devices and their control.

    Attributes:
        devices: The served devices, by name.

    Args:
        entries: The devices.
        host: Address to listen on.
        port: The control's port. The devices have the next ports.
        own: Keys of this computer. None without keys.
        report: Receives lines of text for the operator.
    """

    def __init__(
        self,
        entries: Sequence[DeviceEntry],
        host: str,
        port: int,
        own: Keys | None,
        report: Callable[[str], object],
    ) -> None:
        import zmq

        self._report_to = report
        self._zmq = zmq.Context()
        # closed at the end, so that files can be opened to make devices safe even if connections used up all
        self._spare = [os.open(os.devnull, os.O_RDONLY) for _ in range(32)]
        self._keys = KnownKeys(own, self._report)
        self.devices: dict[str, ServedDevice] = {}
        try:
            self._gate = Gate(host, port, 1 + len(entries), own is not None, self._report)
            sockets = [server_socket(self._zmq, address, own) for address in self._gate.addresses]
            self._addresses = [socket.get_string(zmq.LAST_ENDPOINT) for socket in sockets]
            socket, *at_devices = sockets
            for entry, at_device in zip(entries, at_devices, strict=True):
                self.devices[entry.name] = ServedDevice(entry, at_device, port, self._keys, self._report)
        except ConfigError:
            self._zmq.destroy(linger=0)
            raise
        self._control = Control(self.devices, port, self._keys, socket)
        self._control_address = f"tcp://{host}:{port}"

    def start(self) -> None:
        """Begin to serve."""
        self._keys.start(self._zmq)
        self._gate.start(self._addresses)
        for device in self.devices.values():
            device.start()
        self._control.start()
        places = ", ".join(f"{name} at {port}" for name, port in self._control.ports.items())
        self._report(f"serves {places}, with control at {self._control_address} (Ctrl-C stops it)")
        if self._keys.own is not None:
            self._report(f"known keys: {self._keys.names}")

    def end(self) -> None:
        """Make all devices safe, at the same time, and end all threads."""
        self._gate.accept_no_more()
        for device in self.devices.values():
            device.begin_end()
        while self._spare:
            os.close(self._spare.pop())
        until_s = time.monotonic() + END_S
        while (alive := [d for d in self.devices.values() if d.is_alive]) and time.monotonic() < until_s:
            for device in alive:
                device.rescue_stuck()
            time.sleep(POLL_S)
        late = [device.name for device in alive]
        self._control.end()
        self._gate.end()
        self._keys.end()
        for name in late:
            self._report(f"{name}: NOT SAFE, because a call does not return")
        if not late:
            self._zmq.destroy(linger=0)

    def check(self) -> None:
        """Raise the error that ended the thread of the gate, the control or a device.

        Raises:
            DeviceError: A thread has ended.
        """
        for failure in (
            self._gate.failure,
            self._control.failure,
            *(device.failure for device in self.devices.values()),
        ):
            if failure is not None:
                raise DeviceError("serve-devices", format_error(failure)) from failure

    def _report(self, text: str) -> None:
        self._report_to(f"{now().astimezone():%H:%M:%S} {text}")
