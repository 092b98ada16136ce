"""`labseq serve-devices`: serves the devices of a profile, each on a port of its own.

The first port is for control: connections and heartbeats, and requests to abort a call that blocks. Its
thread makes no calls into drivers, so it always answers.
"""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import labseq
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
from labseq.remote.drivers import DeviceEntry
from labseq.remote.served import POLL_S, ServedDevice, why_ended
from labseq.remote.sessions import CLOSED, Session
from labseq.safety.devices import check_each_device
from labseq.safety.locks import lock_devices
from labseq.safety.safe import construct_hardware
from labseq.sequencer.clock import RealClock
from labseq.wire import (
    LOST_S,
    PROTOCOL,
    Connections,
    MessageError,
    find_keys,
    is_loopback,
    keys_root,
    known_keys,
    pack,
    parse_address,
    report_error,
    require_packages,
    server_socket,
    unpack,
)

MAX_SESSIONS: Final = 64
"""Maximum number of connections at a time; a client that makes more is faulty."""
END_S: Final = 10.0
"""Longest time for the devices to become safe when the server ends, in seconds."""


@dataclass(frozen=True, slots=True)
class Serving:
    """What is served, and where.

    Attributes:
        address: ``tcp://HOST:PORT``: the port of the control, and the first of those of the devices.
        devices: Roles and names of devices; none for all real ones of the profile, or all if none is real.
        plain: Whether to serve without keys, on this computer only.
    """

    address: str
    devices: tuple[str, ...] = ()
    plain: bool = False


def serve_devices(
    profile: str, overrides: Sequence[str], options: Serving, report: Callable[[str], object]
) -> None:
    """Serve devices until Ctrl-C or SIGTERM; then they are made safe.

    Each device is opened, tested, made safe and closed first: that shows that it works, and makes it safe
    after a server that died.

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
    """Context manager: serves the devices as :func:`serve_devices` does, until the end of the block."""
    try:
        host, port = parse_address(options.address)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if options.plain and not is_loopback(host):
        hint = "'labseq keys new' makes keys; --plain is for addresses such as tcp://127.0.0.1:5760"
        raise ConfigError(
            Problem(f"{options.address} can be reached from other computers, and needs keys", hint=hint)
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
    """The devices that are served: those named, else the real ones, else all."""
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

    Args:
        entries: The devices that are served.
        host: Address to listen on.
        port: The control's port; the devices have the next ones.
        keys: Keys of this computer; None without keys.
        report: Receives what happens, for the operator.
    """

    def __init__(
        self,
        entries: Sequence[DeviceEntry],
        host: str,
        port: int,
        keys: Any,
        report: Callable[[str], object],
    ) -> None:
        import zmq

        self._report_to = report
        self._keys = keys
        self._known: Mapping[bytes, str] = known_keys(keys_root()) if keys is not None else {}
        self._zmq = zmq.Context()
        self._auth: Any = None
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        self._key_failure = ""
        # closed at the end: files can then be opened to make devices safe, even if connections used up all
        self._spare = [os.open(os.devnull, os.O_RDONLY) for _ in range(32)]
        self.devices: dict[str, ServedDevice] = {}
        try:
            self._control = server_socket(self._zmq, host, port, keys)
            for number, entry in enumerate(entries, 1):
                socket = server_socket(self._zmq, host, port + number, keys)
                self.devices[entry.name] = ServedDevice(entry, socket, self.is_known, self._report)
        except ConfigError:
            self._zmq.destroy(linger=0)
            raise
        self._ports = {name: port + number for number, name in enumerate(self.devices, 1)}
        self._thread = threading.Thread(target=self._serve, name="labseq control", daemon=True)
        self._host, self._port = host, port

    def start(self) -> None:
        """Begin to serve."""
        if self._keys is not None:
            from zmq.auth.thread import ThreadAuthenticator

            self._auth = ThreadAuthenticator(self._zmq)
            self._auth.start()
            self._auth.configure_curve_callback("labseq", credentials_provider=_Credentials(self.is_known))
        for device in self.devices.values():
            device.start()
        self._thread.start()
        places = ", ".join(f"{name} at {port}" for name, port in self._ports.items())
        self._report(f"serves {places}; control at tcp://{self._host}:{self._port}; Ctrl-C stops it")
        if self._keys is not None:
            names = (
                ", ".join(sorted(self._known.values())) or f"none: put public keys into {keys_root()}/known"
            )
            self._report(f"known keys: {names}")

    def end(self) -> None:
        """Make all devices safe, at the same time, and end all threads."""
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
        self._ended.set()
        self._thread.join(1.0)
        if self._auth is not None:
            self._auth.stop()
        for name in late:
            self._report(f"{name}: NOT SAFE: a call does not return")
        if not late:
            self._zmq.destroy(linger=0)

    def check(self) -> None:
        """Raise what ended the thread of the control, or of a device.

        Raises:
            DeviceError: It has ended.
        """
        for failure in (self._failure, *(device.failure for device in self.devices.values())):
            if failure is not None:
                raise DeviceError("serve-devices", format_error(failure)) from failure

    def is_known(self, peer: str) -> bool:
        """Whether a client's key is known, or none is needed."""
        return self._keys is None or peer.encode() in self._known

    def _report(self, text: str) -> None:
        self._report_to(f"{now().astimezone():%H:%M:%S} {text}")

    def _serve(self) -> None:
        import zmq

        self._control.set(zmq.RCVTIMEO, int(1e3 * POLL_S))
        self._connections = Connections(self._control)
        checked_s = keys_s = time.monotonic()
        try:
            while not self._ended.is_set():
                try:
                    frames = self._control.recv_multipart(copy=False)
                except zmq.Again:
                    frames = []
                if frames:
                    with suppress(zmq.ZMQError):  # the client is gone
                        self._control.send_multipart([frames[0], *self._answer(frames)])
                if (now_s := time.monotonic()) - keys_s > 0.2 and self._keys is not None:
                    keys_s = now_s
                    self._read_keys()
                if now_s - checked_s > POLL_S:
                    self._connections.limit()
                    self._end_lost_sessions(now_s, now_s - checked_s, self._connections.ended())
                    checked_s = time.monotonic()
        except BaseException as error:  # noqa: BLE001 - the main thread ends the server
            self._failure = error
        finally:
            self._connections.close()
            self._control.close()

    def _read_keys(self) -> None:
        """Read the known keys again; if that fails, report it once and keep the previous ones."""
        failure = ""
        try:
            self._known = known_keys(keys_root())
        except Exception as error:  # noqa: BLE001 - whatever is wrong with them must not end the server
            failure = (
                f"the known keys cannot be read, and the previous ones stay valid: {format_error(error)}"
            )
        if failure and failure != self._key_failure:
            self._report(failure)
        self._key_failure = failure

    def _end_lost_sessions(self, now_s: float, passed_s: float, ended: set[tuple[int, int]]) -> None:
        """End the sessions of clients that have disappeared, or whose key was withdrawn."""
        # after a long pause this computer stood still, and could not receive heartbeats
        stood_still_s = passed_s if passed_s > LOST_S / 2 else 0.0
        for device in self.devices.values():
            for session in list(device.sessions.values()):
                session.beat_s += stood_still_s
                if session.connection in ended:
                    device.end_session(session, "its process has ended")
                elif now_s - session.beat_s > LOST_S:
                    device.end_session(session, f"no heartbeat for {LOST_S:g} s")
                elif not self.is_known(session.peer):
                    device.end_session(session, "its key was withdrawn")
            device.rescue_stuck()

    def _answer(self, frames: list[Any]) -> list[Any]:
        number = 0
        try:
            message = unpack([frame.buffer for frame in frames[1:]])
            if type(message["n"]) is not int:
                raise MessageError("it has no number")
            number = message["n"]
            return pack({"n": number, "value": self._value(message, frames[-1])})
        except DeviceError as error:
            return pack({"n": number, "error": report_error(error)})
        except (MessageError, KeyError, TypeError, AttributeError) as error:
            failure = DeviceError("server", f"the server cannot read a message: {format_error(error)}")
            return pack({"n": number, "error": report_error(failure)})

    def _value(self, message: Mapping[str, Any], frame: Any) -> Any:
        """Do what a message asks for; its frame names the client's key and connection."""
        import zmq

        peer = str(frame.get("User-Id")) if self._keys is not None else ""
        if not self.is_known(peer):
            raise DeviceError("server", "the key was withdrawn")
        if message["op"] == "hello":
            return self._hello(message, peer, self._connections.named(frame.get(zmq.SRCFD)))
        if message["op"] == "status":
            return self._status()
        handler = {"beat": self._beat, "bye": self._bye, "abort": self._abort}.get(message["op"])
        if handler is None:
            raise MessageError("its request is unknown")
        return handler(message, *self._of(message, peer))

    def _hello(self, message: Mapping[str, Any], peer: str, connection: tuple[int, int]) -> dict[str, Any]:
        if message["protocol"] != PROTOCOL:
            theirs = f"{clean(str(message['labseq']))} speaks protocol {clean(str(message['protocol']))}"
            ours = f"labseq {labseq.__version__} of the server speaks {PROTOCOL}"
            raise DeviceError("server", f"labseq {theirs}, and {ours}; update one of them")
        device = self.devices.get(str(message["device"]))
        if device is None:
            text = f"there is no device '{clean(str(message['device']))}'; expected {one_of([*self.devices])}"
            raise DeviceError("server", text)
        if message["kind"] != device.kind:
            used = clean(str(message["kind"]))
            text = f"'{device.name}' is of the kind {device.kind}, and the profile uses it as {used}"
            raise DeviceError("server", text)
        if sum(len(other.sessions) for other in self.devices.values()) >= MAX_SESSIONS:
            raise DeviceError("server", f"it already has {MAX_SESSIONS} connections")
        name = self._known.get(peer.encode(), "this computer")
        session = Session(peer, f"{name} ({clean(str(message['who']))})", connection)
        device.sessions[session.token] = session
        return {
            "protocol": PROTOCOL,
            "labseq": labseq.__version__,
            "host": platform.node(),
            "session": session.token,
            "port": self._ports[device.name],
        }

    def _of(self, message: Mapping[str, Any], peer: str) -> tuple[ServedDevice, Session]:
        """The device and the session that a message names.

        Raises:
            DeviceError: The session has ended.
        """
        token = message["session"]
        for device in self.devices.values():
            session = device.sessions.get(token)
            if session is not None and session.peer == peer:
                if session.ended:
                    raise DeviceError(device.name, session.ended)
                return device, session
        ended = {key: why for device in self.devices.values() for key, why in device.ended.items()}
        raise DeviceError("server", why_ended(ended, token))

    def _beat(self, _message: Mapping[str, Any], device: ServedDevice, session: Session) -> dict[str, Any]:
        session.beat_s = time.monotonic()
        running = session.began_s is not None or device.is_busy
        return {"number": session.number, "running": running, "rescue": session.rescue}

    def _bye(self, _message: Mapping[str, Any], device: ServedDevice, session: Session) -> None:
        device.end_session(session, CLOSED)

    def _abort(self, message: Mapping[str, Any], _device: ServedDevice, session: Session) -> None:
        if session.number == message["number"]:
            session.abort_call()

    def _status(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for device in self.devices.values():
            owner = device.owner
            row = {"device": device.name, "owner": "", "call": "", "for_s": 0.0}
            if owner is not None:
                row["owner"] = owner.who
                if (began_s := owner.began_s) is not None:
                    row |= {"call": owner.call, "for_s": time.monotonic() - began_s}
            rows.append(row)
        return rows


class _Credentials:
    """The keys that the authenticator asks for."""

    def __init__(self, is_known: Callable[[str], bool]) -> None:
        self._is_known = is_known

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client with this key may connect."""
        del domain
        return self._is_known(key.decode("ascii"))
