"""What a network, a stranger or a broken peer can do; a call is carried out once or not at all."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from labseq_remote import control
from labseq_remote.connection import served_context
from labseq_remote.drivers import (
    RemoteCamera,
    RemoteDevice,
    RemoteLines,
    RemoteMobileTweezers,
    RemoteStaticTweezers,
)
from labseq_remote.settings import RemoteSettings
from labseq_virtual.devices import VirtualDevice

import labseq.remote.control
import labseq.remote.sessions
from labseq import wire
from labseq.guard import StopFlag
from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    LimitError,
    LineSpec,
    SiteGrid,
    StopRequested,
    wire as wire_of_plugins,
)
from labseq.remote.server import Serving, serving
from labseq.sequencer.clock import RealClock
from labseq.testing.fakes import FakeClock
from labseq.wire import messages
from tests.remote.conftest import PROFILE, Served, free_port, served
from tests.remote.proxy import PROXY, Proxy

ROLES: dict[str, Any] = {
    "mobile_tweezers": RemoteMobileTweezers,
    "lines": RemoteLines,
    "instrument": RemoteDevice,
    "camera": RemoteCamera,
    "static_tweezers": RemoteStaticTweezers,
}


def until(condition: Callable[[], bool], limit_s: float = 60.0) -> float:
    """Wait for something; returns how long that took."""
    begun_s = time.monotonic()
    while not condition():
        assert time.monotonic() < begun_s + limit_s, "it did not happen in time"
        time.sleep(0.005)
    return time.monotonic() - begun_s


@pytest.fixture(scope="module")
def faulty(server: Served) -> Generator[Proxy]:
    proxy = Proxy(server)
    yield proxy
    proxy.end()


@pytest.fixture(autouse=True)
def _whole(request: pytest.FixtureRequest) -> Generator[None]:
    yield
    if "faulty" in request.fixturenames:
        proxy = request.getfixturevalue("faulty")
        proxy.is_cut, proxy.fault, proxy.reply_fault = False, lambda m: [m], lambda m: [m]


@contextmanager
def instrument(server: Served, host: str = "127.0.0.1", **settings: Any) -> Generator[RemoteDevice]:
    """An open instrument."""
    about: dict[str, Any] = {"device": "instrument", "address": f"tcp://{host}:{server.port}", **settings}
    made = server.settings(**about)
    device = RemoteDevice(made, Context("laser", SiteGrid(6, 7), clock=FakeClock()))
    device.open()
    try:
        yield device
    finally:
        with suppress(DeviceError):
            device.close()


@contextmanager
def camera(server: Served, host: str = "127.0.0.1", stop: StopFlag | None = None) -> Generator[RemoteCamera]:
    """An open camera."""
    settings = server.settings("camera", address=f"tcp://{host}:{server.port}")
    device = RemoteCamera(settings, Context("camera", SiteGrid(6, 7), clock=RealClock(stop or StopFlag())))
    device.open()
    try:
        yield device
    finally:
        with suppress(DeviceError):
            device.close()


def test_a_call_that_arrives_twice_is_carried_out_once(server: Served, faulty: Proxy) -> None:
    with camera(server, PROXY) as device:
        device.arm(2, 0.01, "software")
        faulty.fault = lambda message: [message, message]
        for number in range(2):  # a third exposure would be refused
            device.trigger()
            assert device.read(1.0).number == number


def test_an_old_call_is_not_carried_out_again(server: Served, faulty: Proxy) -> None:
    old: list[list[bytes]] = []

    def replay(message: list[bytes]) -> list[list[bytes]]:
        old.append(message)
        return [message, *old[:-1]]

    with camera(server, PROXY) as device:
        device.arm(3, 0.01, "software")
        faulty.fault = replay
        for number in range(3):
            device.trigger()
            assert device.read(1.0).number == number


def test_a_call_out_of_order_ends_the_connection(server: Served, faulty: Proxy) -> None:
    def renumber(message: list[bytes]) -> list[list[bytes]]:
        content = wire.unpack(message)
        return [[bytes(part) for part in wire.pack({**content, "n": content["n"] + 1})]]

    with instrument(server, PROXY) as device:
        faulty.fault = renumber
        with pytest.raises(DeviceError, match=r"^laser: .*(out of order|lost)"):
            device.command("open")
        until(lambda: server.server.devices["instrument"].owner is None)
    assert any("out of order" in text and "made safe" in text for text in server.told)


def test_a_message_that_cannot_be_read_is_an_error_of_the_device(server: Served, faulty: Proxy) -> None:
    with instrument(server, PROXY) as device:
        faulty.fault = lambda message: [[b"\xc1call" + message[0]]]
        with pytest.raises(DeviceError, match=r"^laser: .*cannot read a message"):
            device.command("open")


def test_the_port_of_a_device_is_not_that_of_its_server(server: Served) -> None:
    device = RemoteDevice(
        server.settings("instrument", port=server.port + 1),
        Context("laser", SiteGrid(6, 7), clock=FakeClock()),
    )
    place = rf"laser at tcp://127.0.0.1:{server.port + 1}"
    with pytest.raises(
        ConfigError, match=f"^{place}: this is the port .*; expected port {server.port}; change"
    ):
        device.open()


def test_a_slow_network_is_no_failure(server: Served, faulty: Proxy) -> None:
    def delay(message: list[bytes]) -> list[list[bytes]]:
        time.sleep(0.1)
        return [message]

    with instrument(server, PROXY) as device:
        faulty.reply_fault = delay
        device.command("set", power=0.5)
        assert device.read("power") == 0.5


def test_both_sides_notice_a_cut(server: Served, faulty: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    context = Context("", SiteGrid(6, 7), clock=FakeClock())
    address = f"tcp://{PROXY}:{server.port}"
    devices = {
        name: role(server.settings(name, address=address), replace(context, name=name))
        for name, role in ROLES.items()
    }
    for device in devices.values():
        device.open()
    devices["static_tweezers"].start()
    n_told = len(server.told)
    faulty.is_cut = True
    monkeypatch.setattr(labseq.remote.control, "LOST_S", 0.3)
    monkeypatch.setattr(wire_of_plugins, "LOST_S", 0.3)
    for name, device in devices.items():
        until(lambda name=name: any(f"{name}: the" in text for text in server.told[n_told:]))
        assert "made safe" in next(text for text in server.told[n_told:] if f"{name}: the" in text)
        until(lambda device=device: bool(device.link.connect().life.lost))
        with pytest.raises(DeviceError, match=rf"^{name}: the connection is lost.*127\.0\.0\.2"):
            device.safe_state()
        with suppress(DeviceError):
            device.close()
    monkeypatch.undo()
    with instrument(server) as again:
        again.command("open")


def test_a_lost_reply_ends_the_connection(
    server: Served, faulty: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    with instrument(server, PROXY) as device:
        monkeypatch.setattr(wire_of_plugins, "LOST_S", 0.5)
        faulty.reply_fault = lambda message: [] if b"state" in message[0] else [message]
        with pytest.raises(DeviceError, match="no reply"):
            device.command("open")


def test_arguments_of_any_name_travel(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    got: dict[str, Any] = {}
    monkeypatch.setattr(VirtualDevice, "command", lambda _, __, **named: got.update(named))
    with instrument(server) as device:
        device.command("set", driver=1, device=2)
    assert got == {"driver": 1, "device": 2}


def test_a_second_client_may_look_but_not_act(server: Served) -> None:
    with instrument(server) as first:
        first.command("open")
        other = RemoteDevice(server.settings("instrument"), Context("laser", clock=FakeClock()))
        with pytest.raises(DeviceError, match=r"^laser: in use by this computer \(.*process \d+\)"):
            other.open()
        with pytest.raises(DeviceError, match="not open"):
            other.command("open")
        assert other.describe()["remote"]["device"] == "instrument"
        first.command("open")


def test_a_device_is_made_safe_beside_a_call_that_hangs(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, made_safe = threading.Event(), threading.Event()
    monkeypatch.setattr(VirtualDevice, "command", lambda *_, **__: released.wait(20.0))
    monkeypatch.setattr(VirtualDevice, "safe_state", lambda *_: made_safe.set())
    with instrument(server) as device:
        caller = threading.Thread(target=device.command, args=["open"], daemon=True)
        caller.start()
        sessions = server.server.devices["instrument"].sessions
        until(lambda: any(session.call == "command" for session in [*sessions.values()]))
        device.safe_state()
        assert made_safe.is_set()
        released.set()
        caller.join(5.0)


@pytest.mark.parametrize("grace_s", [0.05, 0.5], ids=["made safe before", "made safe after"])
def test_a_call_that_was_given_up_delays_neither_the_safe_state_nor_the_end(
    server: Served, monkeypatch: pytest.MonkeyPatch, grace_s: float
) -> None:
    monkeypatch.setattr(labseq.remote.sessions, "GRACE_S", grace_s)
    released, entered = threading.Event(), threading.Semaphore(0)
    inside, together = 0, 0

    def make_safe(*_: object) -> None:
        nonlocal inside, together
        inside += 1
        together = max(together, inside)
        released.set()  # the call returns now; the device's thread goes on
        entered.acquire(timeout=0.1)  # only if another thread comes
        inside -= 1

    monkeypatch.setattr(VirtualDevice, "command", lambda *_, **__: released.wait(20.0))
    monkeypatch.setattr(VirtualDevice, "safe_state", make_safe)
    monkeypatch.setattr(VirtualDevice, "close", make_safe)
    stop = StopFlag()
    context = Context("laser", SiteGrid(6, 7), clock=RealClock(stop))
    device = RemoteDevice(server.settings("instrument"), context)
    device.open()
    threading.Timer(0.05, stop.request).start()
    begun_s = time.monotonic()
    with pytest.raises(StopRequested):
        device.command("open")
    with stop.held():
        device.safe_state()
        device.close()
    assert time.monotonic() < begun_s + 5.0  # the call would have taken 20 s
    until(lambda: server.server.devices["instrument"].owner is None)
    assert together == 1


def test_the_next_connection_is_not_taken_for_one_that_has_ended(server: Served) -> None:
    """The operating system gives it the same number."""
    from tests.remote.fuzz import _begin

    with zmq.Context() as context:
        first = context.socket(zmq.DEALER)
        first.connect(f"tcp://127.0.0.1:{server.port}")
        token = _begin(first, "instrument", "device")
        first.close(linger=0)
        with instrument(server) as device:
            sessions = server.server.devices["instrument"].sessions
            until(lambda: token not in sessions)
            device.command("open")


def test_a_server_that_has_ended_is_not_waited_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wire_of_plugins, "LOST_S", 30.0)
    with served(tmp_path, devices=("instrument",)) as one:
        device = RemoteDevice(one.settings("instrument"), Context("laser", clock=FakeClock()))
        device.open()
        connection = device.link.connect()
    until(lambda: bool(connection.life.lost))
    begun_s = time.monotonic()
    with pytest.raises(DeviceError, match="the server has ended"):
        connection.control.ask("beat")
    assert time.monotonic() < begun_s + 10.0


def test_errors_keep_their_class_and_values(server: Served) -> None:
    with camera(server) as device, pytest.raises(LimitError) as caught:
        device.arm(0, 0.01, "software")
    assert (caught.value.value, caught.value.exit_code) == (0, 2)
    assert f"tcp://127.0.0.1:{server.port}" in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"device": "laser_7"}, "no device 'laser_7'; expected one of"),
        ({"device": "camera"}, "is of the kind camera, but the profile uses it as device"),
    ],
)
def test_a_wrong_name_is_refused(server: Served, settings: dict[str, str], match: str) -> None:
    with pytest.raises(DeviceError, match=match), instrument(server, **settings):
        pass


def test_another_version_is_named(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire_of_plugins, "PROTOCOL", 99)
    with (
        pytest.raises(DeviceError, match=r"speaks protocol 99, and labseq .* of the server speaks 2"),
        instrument(server),
    ):
        pass


def test_no_server_is_named(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "CONNECT_S", 0.2)
    with pytest.raises(DeviceError, match="nothing answers there"):
        RemoteCamera(server.settings("camera", port=1), Context("camera", clock=FakeClock())).open()


def test_keys(tmp_path: Path, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "CONNECT_S", 1.0)
    with served(tmp_path, plain=False) as one:

        def with_key() -> RemoteDevice:
            settings = one.settings("instrument", server_key="here")
            return RemoteDevice(settings, Context("laser", clock=FakeClock()))

        device = with_key()
        device.open()
        device.command("open")
        stranger = tmp_path / "stranger"
        wire.new_keys("stranger", stranger)
        (stranger / "known" / "here.key").write_bytes((keys / "here.key").read_bytes())
        with monkeypatch.context() as patch:
            patch.setattr(wire_of_plugins, "keys_root", lambda: stranger)
            with pytest.raises(DeviceError, match="does not know this computer's key"):
                with_key().open()
        with pytest.raises(DeviceError, match="keys do not match"):  # without keys
            RemoteDevice(one.settings("instrument"), Context("laser", clock=FakeClock())).open()
        secret = keys / "known" / "here.key"
        withdrawn = secret.read_bytes()
        secret.unlink()
        until(lambda: any("withdrawn" in text and "made safe" in text for text in one.told))
        with pytest.raises(DeviceError, match="withdrawn"):
            device.command("open")
        secret.write_bytes(withdrawn)
        with suppress(DeviceError):
            device.close()


WITHOUT_FILES = """
import resource, sys
from pathlib import Path
from labseq import wire
folder = Path(sys.argv[1])
assert [*wire.known_keys(folder).values()] == ["here"]
soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
try:
    wire.known_keys(folder)
except OSError as error:
    print(error)
"""
"""In a process of its own: ZeroMQ ends a process that waits for messages while it may open no file."""


@pytest.mark.skipif(sys.platform == "win32", reason="processes have no limit of open files")
def test_a_computer_has_one_key(keys: Path) -> None:
    wire.new_keys("another", keys)
    with pytest.raises(ConfigError, match="there are several keys of this computer; keep one of them"):
        wire.find_keys(keys)


def test_keys_that_cannot_be_read_are_not_taken_for_withdrawn_ones(tmp_path: Path) -> None:
    _, public = wire.new_keys("here", tmp_path)
    (tmp_path / "known" / "here.key").write_bytes(public.read_bytes())
    assert [*wire.known_keys(tmp_path).values()] == ["here"]
    command = [sys.executable, "-c", WITHOUT_FILES, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Too many open files" in done.stdout
    (tmp_path / "known" / "damaged.key").write_bytes(b"\0")
    (tmp_path / "known" / "folder.key").mkdir()
    assert [*wire.known_keys(tmp_path).values()] == ["here"]


def test_the_message_of_a_distant_error_is_one_printable_line_that_says_where() -> None:
    report = messages.report_error(DeviceError("lamp", "no\nlight\x1b[2J"))
    error = messages.error_of(report, "far lamp", "tcp://there")
    assert isinstance(error, DeviceError)
    assert error.message == r"no light\x1b[2J (at tcp://there)"
    assert str(error) == f"far lamp: {error.message}"


def test_a_server_without_keys_cannot_be_reached_by_others(tmp_path: Path, keys: Path) -> None:
    path = tmp_path / "served.yaml"
    path.write_text(PROFILE, encoding="utf-8")
    everywhere = Serving("tcp://0.0.0.0:5760", plain=True)
    with pytest.raises(ConfigError, match="needs keys"), serving(str(path), (), everywhere, print):
        pass
    settings = RemoteSettings(address="tcp://camera-pc:5760", device="camera")
    with pytest.raises(ConfigError, match=r"camera-pc\.key: there is no key of camera-pc; copy"):
        RemoteCamera(settings, Context("camera", clock=FakeClock())).open()


def test_no_message_ends_the_server(server: Served) -> None:
    """A few hundred; `python -m tests.remote.fuzz` sends more."""
    from tests.remote.fuzz import fuzz

    with instrument(server) as device:
        assert fuzz(server.server, server.port, 200, seed=1) > 0
        device.command("set", power=0.25)
        assert device.read("power") == 0.25


def test_a_message_beyond_the_limit_is_not_received(server: Served) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger = 0
        socket.connect(f"tcp://127.0.0.1:{server.port}")
        socket.send(bytes((1 << 26) + 1))
        assert not socket.poll(200)
    with instrument(server) as device:
        device.command("open")


def test_shapes_are_checked_before_arrays_are_made() -> None:
    import msgpack

    def message(index: int, dtype: object, shape: object) -> list[bytes]:
        packb: Any = msgpack.packb
        return [packb(msgpack.ExtType(1, packb([[index, 0], dtype, shape, {}]))), bytes(16)]

    assert np.array_equal(wire.unpack(message(1, "<f8", [2])), np.zeros(2))
    (empty,) = wire.unpack(wire.pack([np.zeros((0, 3))]))
    assert empty.shape == (0, 3)
    for wrong in (
        (1, "<f8", [3]),
        (1, "<f8", [-2]),
        (1, "<f8", [1 << 40, 1 << 40]),
        (1, "|O", [2]),
        (1, "<f8", [2, 1, 1, 1, 1]),
        (2, "<f8", [2]),
        (0, "<f8", [2]),
        (1, "<M8", [2]),
    ):
        with pytest.raises(wire.MessageError):
            wire.unpack(message(*wrong))


def test_what_is_too_large_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(messages, "MAX_PART", 1 << 15)
    assert len(wire.pack(np.zeros(1 << 12))) == 3
    with pytest.raises(wire.MessageError, match="too large to be sent"):
        wire.pack(np.zeros((1 << 12) + 1))


def test_times_of_frames_are_on_the_clock_of_the_client(
    server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    with camera(server) as device:
        clock = device.link.connect()._calls._clock
        monkeypatch.setattr(clock, "now", lambda: time.monotonic() + 1000.0)  # not that of the server
        device.arm(1, 0.01, "software")
        before_s = clock.now()
        device.trigger()
        assert before_s <= device.read(2.0).t_start_s <= clock.now() - 0.01


def test_a_stop_request_aborts_the_call_at_the_server(server: Served) -> None:
    stop = StopFlag()
    with camera(server, stop=stop) as device:
        device.arm(1, 0.01, "software")
        threading.Timer(0.1, stop.request).start()
        with pytest.raises(StopRequested):
            device.read(600.0)  # nothing triggers it
        with stop.held():
            device.safe_state()
            device.close()


def test_a_simulated_device_refuses_a_line_that_nothing_can_switch_there(server: Served) -> None:
    line = LineSpec("trigger", 0, ("image",), triggers="camera")
    context = Context("camera", SiteGrid(6, 7), clock=RealClock(StopFlag()), lines=(line,))
    with pytest.raises(ConfigError, match=r"'camera' is simulated at its server.*--dry-run"):
        RemoteCamera(server.settings("camera"), context).open()


def test_a_client_cannot_replace_the_driver_of_an_open_device(server: Served) -> None:
    with instrument(server) as device:
        connection = device.link.connect()
        with pytest.raises(DeviceError, match="already has a driver"):
            connection.call("attach", served_context("laser", Context("laser")))
        device.command("open")


BROKEN = """
from labseq.plugin import Device, DeviceError, hookimpl
LABSEQ_API = 1

class Broken(Device):
    def __init__(self, settings, context): self.name = context.name
    def open(self): raise DeviceError(self.name, "no answer")
    def close(self): pass
    def safe_state(self): pass
    def describe(self): return {}
    def command(self, name, **arguments): pass
    def read(self, name): pass

@hookimpl
def labseq_register(registry):
    registry.device("broken", Broken)
"""


def test_a_server_does_not_start_with_a_device_that_fails(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(BROKEN, encoding="utf-8")
    profile = PROFILE.replace("{use: virtual, commands: [open, set], values: {power: 1.0}}", "{use: broken}")
    with (
        pytest.raises(DeviceError, match=r"^instrument: no answer$"),
        served(tmp_path, f"{profile}plugin_folders: [.]\n"),
    ):
        pass


OUTLIVING = """
import sys
from pathlib import Path
from labseq.plugin import Device, Emergency, hookimpl
LABSEQ_API = 1

class Outliving(Device):
    def __init__(self, settings, context): pass
    def open(self): pass
    def close(self): pass
    def safe_state(self): pass
    def describe(self): return {}
    def command(self, name, **arguments): pass
    def read(self, name): return 1.0
    def emergency(self): return Emergency(Path(__file__).with_name("off.py"), {})

@hookimpl
def labseq_register(registry):
    registry.device("outliving", Outliving)
"""
OFF = """
from pathlib import Path
def off(): return Path(__file__).with_name("off").write_text("off") and "off"
"""


def test_a_device_has_one_server_and_is_switched_off_when_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "outliving.py").write_text(OUTLIVING, encoding="utf-8")
    (tmp_path / "off.py").write_text(OFF, encoding="utf-8")
    devices = PROFILE.replace(
        "{use: virtual, commands: [open, set], values: {power: 1.0}}", "{use: outliving}"
    )
    path = tmp_path / "served.yaml"
    path.write_text(f"{devices}plugin_folders: [.]\n", encoding="utf-8")
    port = free_port(4)
    serve = [sys.executable, "-m", "labseq", "serve-devices", str(path), "--plain"]
    with subprocess.Popen(
        [*serve, "--bind", f"tcp://127.0.0.1:{port}"], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert any("serves instrument" in line for line in process.stdout)
            another = Serving(f"tcp://127.0.0.1:{free_port(4)}", plain=True)
            with pytest.raises(DeviceError, match="serve-devices"), serving(str(path), (), another, print):
                pass
            settings = RemoteSettings(device="instrument", address=f"tcp://127.0.0.1:{port}")
            device = RemoteDevice(settings, Context("laser", clock=RealClock(StopFlag())))
            device.open()
            assert device.read("power") == 1.0
        finally:
            process.kill()
    with pytest.raises(DeviceError, match=r"^laser: the connection is lost: the server has ended"):
        [device.read("power") for _ in range(1000)]
    until((tmp_path / "off").exists)
    device.link.end()


def test_a_port_that_is_taken_is_named(server: Served, tmp_path: Path) -> None:
    path = tmp_path / "served.yaml"
    path.write_text(PROFILE, encoding="utf-8")
    how = Serving(f"tcp://127.0.0.1:{server.port}", ("instrument",), plain=True)
    with (
        pytest.raises(ConfigError, match=r"cannot be used.*already running"),
        serving(str(path), (), how, print),
    ):
        pass
