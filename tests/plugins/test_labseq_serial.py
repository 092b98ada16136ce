"""The serial device: on a simulated instrument, at a pty, over the network, and in whole runs."""

from __future__ import annotations

import importlib
import json
import re
import socket
import socketserver
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
from labseq_serial.device import SerialDevice

from labseq import ConfigError, DeviceError, LimitError, Session, TransientError
from labseq.config.find import find_profile
from labseq.config.yaml_nodes import compose
from labseq.data.reader import Run
from labseq.plugin import Context
from labseq.safety.devices import check_devices
from labseq.session.check import check
from labseq.testing import DeviceContract
from labseq.testing.fakes import FakeClock

from .labseq_serial_rig import PROFILE, Simulator, opened, settings

Factory = Callable[..., Any]
on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulator]:
    with Simulator(tmp_path_factory.mktemp("serial")) as simulator:
        yield simulator


class Declared(DeviceContract):
    commands: ClassVar = {
        "open": {},
        "close": {},
        "toggle_on": {},
        "toggle_off": {},
        "set": {"frequency": "80 MHz"},
    }
    excessive_commands: ClassVar = {"a frequency beyond the limit": ("set", {"frequency": 201e6})}
    values: ClassVar = ("is_open", "frequency", "temperature")


class TestSimulatedInstrument(Declared):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(SerialDevice, settings(port="simulated"))


@on_a_pty
class TestInstrumentOnAPty(Declared):
    @pytest.fixture
    def factory(self, simulator: Simulator) -> Factory:
        return partial(SerialDevice, settings(port=simulator.port))


@on_a_pty
def test_commands_and_values_cross_the_line_in_the_units_of_the_instrument(simulator: Simulator) -> None:
    with opened(simulator.port) as synth:
        synth.command("set", frequency="80.5 MHz")
        assert synth.read("frequency") == 80.5e6
        assert simulator.log[-2:] == ["FREQ 80.500000", "FREQ?"]
        synth.command("close")
        assert synth.poll() == {"is_open": False, "frequency": 80.5e6}
        assert synth.read("temperature") == pytest.approx(273.15 + 21.5)
        n_sent = simulator.log.count("TOGGLE")
        for _ in range(2):  # sent only where it brings about what is asked for
            synth.command("toggle_on")
            assert synth.read("is_open") is True
        assert simulator.log.count("TOGGLE") == n_sent + 1
        text = "synth: never: 'OPEN' was sent, .* is_open is true, not false"
        with pytest.raises(DeviceError, match=text):
            synth.command("never")


@on_a_pty
def test_what_fails_on_open_is_taken_back(simulator: Simulator) -> None:
    device = SerialDevice(settings(port=simulator.port, on_open=["open", "nonsense"]), Context("synth"))
    with pytest.raises(DeviceError, match="'NONSENSE' was refused"):
        device.open()
    assert simulator.log[-2:] == ["FREQ 1.000000", "CLOSE"]
    with pytest.raises(DeviceError, match="not open"):
        device.command("open")


@pytest.mark.parametrize(
    ("command", "arguments", "kind", "text"),
    [
        ("opne", {}, DeviceError, "unknown command 'opne'; expected one of 'open', 'close'"),
        ("set", {}, DeviceError, "'set' has no arguments; expected frequency"),
        ("set", {"frequency": "80 mm"}, DeviceError, "'80 mm' is a length, not a frequency"),
        ("set", {"frequency": "0.2 GHz "}, None, ""),
        (
            "set",
            {"frequency": "201 MHz"},
            LimitError,
            "synth: frequency of 'set' is 201 MHz; .* 1 MHz to 200",
        ),
        ("set", {"frequency": float("nan")}, DeviceError, "expected a finite one"),
    ],
)
def test_commands_can_be_checked_before_anything_is_open(
    command: str, arguments: dict[str, Any], kind: type[Exception] | None, text: str
) -> None:
    device = SerialDevice(settings(port="simulated"), Context("synth"))
    if kind is None:
        device.check_command(command, **arguments)
    else:
        with pytest.raises(kind, match=text):
            device.check_command(command, **arguments)


@on_a_pty
def test_a_value_beyond_its_limits_or_unreadable_stops_everything(simulator: Simulator) -> None:
    with opened(simulator.port) as synth:
        synth.check_interlocks()
        simulator.order("fault", "other", 2)
        with pytest.raises(DeviceError, match=r"synth: temperature: 'TEMP\?' was answered by 'WHAT'"):
            synth.check_interlocks()
        for value, text in (
            ("25.60", "25.6 degC, .* 15 degC to 25 degC; look at the chiller"),
            ("9.9e37", "implausible; expected -50 degC to 100 degC"),
        ):
            simulator.order("set", "temperature", value)
            try:
                with pytest.raises(DeviceError, match=text):
                    synth.check_interlocks()
            finally:
                simulator.order("set", "temperature", "21.50")


def test_a_reading_may_be_as_old_as_the_interlock_lets_it() -> None:
    clock, lock = FakeClock(), {"max": "25 degC", "max_age": "1 s"}
    values = {"temperature": {"ask": "TEMP?", "unit": "degC", "poll": True, "interlock": lock}}
    with opened("simulated", clock, values=values, commands={}, safe_state=[]) as synth:
        synth.poll()
        before_s = clock.now()
        synth.check_interlocks()
        assert clock.now() == before_s
        clock.sleep(1.0)
        synth.check_interlocks()
        assert clock.now() > before_s + 1.0


def test_a_simulated_line_takes_its_time() -> None:
    clock = FakeClock()
    with opened("simulated", clock, baud_rate=1200, pause="30 ms", wait_after_open="2 s") as synth:
        assert clock.now() >= 2.0
        before_s = clock.now()
        synth.command("set", frequency="80 MHz")
        n_bytes = len("FREQ 80.000000\n")
        assert clock.now() - before_s == pytest.approx(30e-3 + n_bytes * 10 / 1200)


class Answering(socketserver.StreamRequestHandler):
    """An instrument on the network; it hangs up when described so."""

    def handle(self) -> None:
        for line in self.rfile:
            if line == b"BYE\n":
                return
            self.wfile.write(line.replace(b"T?", b"21.5"))


def test_an_instrument_behind_a_network_port_is_the_same() -> None:
    values = {"t": {"ask": "T?"}, "bye": {"ask": "BYE"}}
    with socketserver.TCPServer(("127.0.0.1", 0), Answering) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        port = f"socket://127.0.0.1:{server.server_address[1]}"
        with opened(port, values=values, commands={}, safe_state=[], identify=None) as synth:
            assert synth.read("t") == 21.5
            with pytest.raises(TransientError, match="synth: the line broke at 'BYE'"):
                synth.read("bye")
            assert synth.read("t") == 21.5, "it was opened again"
        server.shutdown()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name)")  # pyserial 3.5
def test_an_instrument_behind_a_terminal_server_is_the_same() -> None:
    serial: Any = importlib.import_module("serial.rfc2217")
    behind: Any = importlib.import_module("serial").serial_for_url("loop://", timeout=0.02)
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve_rfc2217, args=(serial, behind, server), daemon=True).start()
        port = f"rfc2217://127.0.0.1:{server.getsockname()[1]}"
        values = {"t": {"ask": "T?", "type": "text"}}
        with opened(port, values=values, commands={}, safe_state=[], identify=None) as synth:
            assert synth.read("t") == "T?", "behind the server is a loop"


def serve_rfc2217(serial: Any, behind: Any, server: socket.socket) -> None:
    """One client of a terminal server, until it hangs up."""
    client, _ = server.accept()
    with client, client.makefile("wb", 0) as out:
        manager = serial.PortManager(behind, out)
        while data := client.recv(1024):
            behind.write(b"".join(manager.filter(data)))
            if behind.in_waiting:
                client.sendall(b"".join(manager.escape(behind.read(behind.in_waiting))))


SEQUENCE = """
labseq: 1
name: serial
profile: ./lab.yaml
shots: 2
seed: 1
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca}
shot:
  - load: {duration: 10 ms}
  - device: {name: synth, do: set, arguments: {frequency: 80 MHz}}
  - device: {name: synth, do: toggle_on}
  - image: {exposure: 5 ms}
"""


@pytest.fixture
def session_simulator(tmp_path: Path) -> Iterator[Simulator]:
    with Simulator(tmp_path) as session_simulator:
        yield session_simulator


def lab(folder: Path, port: str, **more: Any) -> Path:
    """A sequence in a folder, and the virtual lab with the instrument as its profile."""
    text = find_profile("virtual", folder).read_text()
    profile, synth = compose(text, ""), compose(f"synth:\n{PROFILE}", "")
    assert profile is not None
    assert synth is not None
    device = {"use": "serial", "port": port, **synth.plain()["synth"], **more}
    (folder / "lab.yaml").write_text(json.dumps({**profile.plain(), "devices": {"synth": device}}))
    (folder / "sequence.yaml").write_text(SEQUENCE)
    return folder / "sequence.yaml"


def run(sequence: Path, **options: Any) -> Run:
    with Session.open(sequence, output=sequence.parent / "data", **options) as session:
        return session.run()


class Observer:
    """Notes how each attempt at a shot ends; unplugs an instrument when the first one begins."""

    def __init__(self, unplugged: Simulator | None = None) -> None:
        self.ends: list[tuple[str, str]] = []
        self._unplugged = unplugged

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "shot_started" and self._unplugged is not None and not self.ends:
            self._unplugged.order("unplug")
        if name in ("shot_finished", "shot_repeated"):
            self.ends.append((values["shot"].status, values["shot"].error))


def test_a_dry_run_speaks_to_an_instrument_made_of_the_description(tmp_path: Path) -> None:
    done = run(lab(tmp_path, "/dev/ttyNOSUCH7"), dry_run="full")
    readings = [shot.readings for shot in done.shots]
    assert [reading["synth.is_open"] for reading in readings] == [False, True]
    assert [reading["synth.frequency"] for reading in readings] == [0.0, 80e6]
    assert done.record["devices"]["synth"]["port"] == "simulated"


@on_a_pty
def test_a_run_tests_the_instrument_keeps_its_values_and_leaves_it_safe(
    tmp_path: Path, session_simulator: Simulator
) -> None:
    sequence = lab(tmp_path, session_simulator.port)
    report = check_devices(str(sequence.with_name("lab.yaml")))
    (synth,) = [found for found in report.devices if found.name == "synth"]
    assert synth.ok
    assert synth.tested
    assert synth.described["serial_number"] == "0042"
    assert synth.latency_s
    session_simulator.order("set", "frequency", "100")
    done = run(sequence)
    assert [shot.readings["synth.frequency"] for shot in done.shots] == [100e6, 80e6]
    assert session_simulator.log[-2:] == ["FREQ 1.000000", "CLOSE"]


@on_a_pty
def test_a_value_past_its_interlock_ends_the_run_before_anything_is_done(
    tmp_path: Path, session_simulator: Simulator
) -> None:
    session_simulator.order("set", "temperature", "25.60")
    observer = Observer()
    with pytest.raises(DeviceError, match=r"25.6 degC, .* 15 degC to 25 degC; look at the chiller") as caught:
        run(lab(tmp_path, session_simulator.port), observer=observer)
    assert "TOGGLE" not in session_simulator.log
    assert session_simulator.log[-1] == "CLOSE"
    assert observer.ends == [("failed", f"InterlockError: {caught.value}")]


@on_a_pty
def test_a_shot_in_which_the_line_breaks_is_repeated_and_ends_the_run_if_it_stays_broken(
    tmp_path: Path, session_simulator: Simulator
) -> None:
    observer = Observer(unplugged=session_simulator)
    with pytest.raises(DeviceError, match=r"synth: .*could not be opened again"):
        run(lab(tmp_path, session_simulator.port), observer=observer)
    (first, first_error), (second, second_error) = observer.ends
    assert (first, second) == ("failed", "failed")
    assert first_error.startswith("TransientError: synth: the line broke at 'STATE?'")
    assert second_error.startswith("DeviceError: ")


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("do: set,", "do: sett,", ":11:31: synth: unknown command 'sett'"),
        ("80 MHz", "300 MHz", ":11:31: synth: frequency of 'set' is 300 MHz"),
    ],
)
def test_a_command_that_the_device_does_not_know_is_refused_before_anything_is_opened(
    tmp_path: Path, right: str, wrong: str, message: str
) -> None:
    sequence = lab(tmp_path, "/dev/ttyNOSUCH7")
    sequence.write_text(SEQUENCE.replace(right, wrong, 1))
    with Session.open(sequence, output=tmp_path / "data") as session:
        for attempt in (partial(check, session), session.run):
            with pytest.raises(ConfigError, match=re.escape(message)):
                attempt()
    assert not (tmp_path / "data").exists()
