"""Faults of the timing box, and a box at the end of a real serial port."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, ClassVar

import pytest
from labseq_ttl import box as box_module
from labseq_ttl.__main__ import main
from labseq_ttl.lines import Heartbeat
from labseq_ttl.protocol import STOP, framed
from labseq_ttl_sim.model import ModelBox

from labseq.errors import DeviceError, DeviceTimeoutError, StopRequested
from labseq.roles import NeverStopped

from .emergency import outsider
from .labseq_ttl_rig import FIRMWARE, MAX_WAIT_S, FirmwareOnACable, ModelOnACable, Rig, make_rig, rig, works

MIDDLE = 10_000
"""Ticks: 5 ms after the first edge."""


@pytest.fixture(params=["model", FIRMWARE])
def lab(request: pytest.FixtureRequest) -> Generator[Rig]:
    """A driver, open, on a simulated box."""
    with rig(box=request.param) as made:
        yield made


def test_a_reset_in_the_middle_of_a_program_turns_all_lines_off_and_is_reported(lab: Rig) -> None:
    lab.box.reset(MIDDLE)
    lab.fire("load", 20e-3)
    played = lab.played[-1][0]
    assert played.t_s.tolist() == pytest.approx([0.0, 5e-3])
    assert not played.on[-1].any()
    with pytest.raises(DeviceError, match=r"the box was reset \(reason: reset input\)") as raised:
        lab.lines.wait(1.0)
    assert raised.value.device == "lines"
    lab.lines.safe_state()
    works(lab)
    lab.box.reset()
    with pytest.raises(DeviceError, match="the box was reset"):
        lab.fire()
    assert len(lab.played) == 4  # the idle state three times and what worked
    lab.lines.safe_state()
    works(lab)


def unplug(lab: Rig) -> None:
    box = lab.box
    if isinstance(box, ModelBox):
        box.unplug()
    else:
        box._process.kill()
        box._process.wait()


@pytest.mark.parametrize("use", ["compile", "arm", "fire"])
def test_an_unplugged_box_is_an_error_and_safe_again_once_it_is_back(lab: Rig, use: str) -> None:
    steps: dict[str, Callable[[], None]] = {
        "compile": lambda: lab.lines.compile(lab.program("image", 7e-3)),
        "arm": lab.lines.arm,
        "fire": lab.lines.fire,
    }
    for name, step in steps.items():
        if name == use:
            unplug(lab)
            with pytest.raises(DeviceError, match="the line to the box broke"):
                step()
            break
        step()
    lab.lines.safe_state()
    works(lab)


class DamagesLines(ModelBox):
    """Every other line is damaged on its way to the box."""

    n_lines = 0

    def write(self, data: bytes, /) -> int:
        self.n_lines += 1
        return super().write(data.replace(b" ", b"_", 1) if self.n_lines % 2 else data)


class DamagesAnswers(ModelBox):
    """Every other answer is damaged on its way back, but not that to `fire`, which is never sent twice."""

    n_sent = 0

    def _send(self, text: str) -> None:
        self.n_sent += 1
        is_answer = not text.startswith("!") and text[1:] != " ok"
        self._out += framed(text).replace(b"*", b"+") if is_answer and self.n_sent % 2 else framed(text)


def use_box(monkeypatch: pytest.MonkeyPatch, box: Any) -> None:
    monkeypatch.setattr("labseq_ttl_sim.access.SimulatedAccess._new_box", lambda _: box)


@pytest.mark.parametrize("cable", [DamagesLines, DamagesAnswers])
def test_what_came_damaged_is_sent_again(monkeypatch: pytest.MonkeyPatch, cable: type[ModelBox]) -> None:
    use_box(monkeypatch, cable())
    with rig() as lab:
        for _ in range(5):
            works(lab)
        lab.lines.self_test()


class StopsLater(ModelBox):
    """Drops what it receives between the stop byte and its message, as the firmware does."""

    is_stopping = False

    def _take(self, byte: int) -> None:
        if byte == STOP[0]:
            self.is_stopping = True
        elif not self.is_stopping:
            super()._take(byte)

    @property
    def in_waiting(self) -> int:
        if self.is_stopping:
            self.is_stopping = False
            super()._take(STOP[0])
        return super().in_waiting


def test_the_safe_state_waits_until_the_box_has_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_ttl_sim.access.SimulatedAccess.max_wait_s", 0.1)
    use_box(monkeypatch, StopsLater())
    with rig() as lab:
        works(lab)
        monkeypatch.setattr(lab.lines, "_connect", lambda: pytest.fail("it has lost the box"))
        lab.lines.safe_state()
        works(lab)


class ReadLate(ModelBox):
    """What it sends is read only after the stop byte was sent to it."""

    def __init__(self) -> None:
        super().__init__()
        self.is_read, self.is_stopped = threading.Event(), threading.Event()

    def read(self, size: int = 1, /) -> bytes:
        self.is_read.set()
        assert self.is_stopped.wait(MAX_WAIT_S)
        return super().read(size)

    def write(self, data: bytes, /) -> int:
        n_bytes = super().write(data)
        if data == STOP:
            self.is_stopped.set()
        return n_bytes


def test_a_wait_in_another_thread_does_not_take_the_message_of_the_stop() -> None:
    port, ends = ReadLate(), list[object]()
    box = box_module.Box(port, "lines", NeverStopped(), MAX_WAIT_S)

    def wait() -> None:
        try:
            ends.append(box.new_events(MAX_WAIT_S))
        except DeviceError as error:
            ends.append(str(error))

    thread = threading.Thread(target=wait)
    thread.start()
    assert port.is_read.wait(MAX_WAIT_S)
    box.stop()
    thread.join(MAX_WAIT_S)
    assert ends == ["lines: aborted by the safe state"]


class KeepsQuiet(ModelBox):
    """The end of its program is not reported."""

    def _send(self, text: str) -> None:
        if not text.startswith("!done"):
            super()._send(text)


def test_an_end_whose_message_is_lost_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_ttl_sim.access.SimulatedAccess.max_wait_s", 0.01)
    use_box(monkeypatch, KeepsQuiet())
    with rig() as lab:
        works(lab)
        works(lab)


class Dies(ModelBox):
    """Plays nothing more, and does not say so."""

    def _play(self) -> None:
        self._armed, self._is_due = None, False


def test_a_program_that_never_ends_is_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_ttl_sim.access.SimulatedAccess.max_wait_s", 0.01)
    use_box(monkeypatch, Dies())
    with rig() as lab:
        lab.box._edges = [(0, 0)]  # type: ignore[union-attr]
        lab.fire()
        with pytest.raises(DeviceTimeoutError, match="not over after"):
            lab.lines.wait(1.0)


class Other(ModelBox):
    """Something else that speaks in lines."""

    says = "shutter 01 0000 0000 01"

    def _identify(self) -> str:
        return self.says


@pytest.mark.parametrize(
    ("says", "text"),
    [
        ("shutter 01 0000 0000 01", "'shutter 01 0000 0000 01' answers, not 'labseq-ttl'"),
        ("labseq-ttl 03 0000 0000 01", "has version 3 of the protocol, not 2"),
        ("labseq-ttl 02 what", "the box answers 'what', not 3 hexadecimal numbers"),
    ],
)
def test_something_else_at_the_port_is_refused(monkeypatch: pytest.MonkeyPatch, says: str, text: str) -> None:
    other = Other()
    other.says = says
    use_box(monkeypatch, other)
    with pytest.raises(DeviceError, match=text):
        make_rig().lines.open()


class Babble(ModelBox):
    """An instrument that does not speak the protocol at all."""

    def _answer(self) -> None:
        self._out += b"ERR -113\r\n"


class Mute(ModelBox):
    """No box answers."""

    def _answer(self) -> None:
        pass


@pytest.mark.parametrize(("box", "message"), [(Babble, "but 'ERR -113"), (Mute, "is this the box's port")])
def test_a_port_at_which_no_box_answers_is_reported(
    monkeypatch: pytest.MonkeyPatch, box: type[ModelBox], message: str
) -> None:
    monkeypatch.setattr(box_module, "BOOT_S", 0.0)
    monkeypatch.setattr("labseq_ttl_sim.access.SimulatedAccess.max_wait_s", 0.01)
    use_box(monkeypatch, box())
    with pytest.raises(DeviceTimeoutError, match=message):
        make_rig().lines.open()


def test_garbage_does_no_harm() -> None:
    with rig() as lab:
        for noise in (b"\xff\x00\n", b"!done 0000 0007*0000\n", b"a ok*dead\n", b"x" * 10_000, b"\n"):
            lab.box.say(noise)
            works(lab)


@pytest.mark.parametrize(
    ("says", "text"),
    [("!off 0000", "a command to turn all lines off"), ("!alone 0000", "heard nothing for 2 s")],
)
def test_a_box_that_turned_all_lines_off_by_itself_is_an_error(says: str, text: str) -> None:
    with rig() as lab:
        lab.box.say(framed(says))
        with pytest.raises(DeviceError, match=text):
            lab.fire()
        lab.lines.safe_state()
        works(lab)


def test_a_bad_memory_is_found_by_the_self_test(monkeypatch: pytest.MonkeyPatch) -> None:
    with rig() as lab:
        get = lab.driver_box.get
        monkeypatch.setattr(
            lab.driver_box, "get", lambda slot, i: (get(slot, i)[0] ^ (i == 17), get(slot, i)[1])
        )
        with pytest.raises(DeviceError, match="edge 17 in slot 0 reads"):
            lab.lines.self_test()


class Plugged:
    """A box at the end of a cable, under a name that no other port gets when it is unplugged."""

    def __init__(self, box: ModelOnACable | FirmwareOnACable, link: Path) -> None:
        self._box, self._link, self.name = box, link, str(link)
        self.start = box.start
        link.symlink_to(box.name)

    def unplug(self) -> None:
        self._link.unlink(missing_ok=True)
        self._box.unplug()


on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


@pytest.fixture(params=[pytest.param("model", marks=on_a_pty), FIRMWARE])
def plugged(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Generator[Plugged]:
    """A box at a serial port of this computer: the model, and the firmware. Both answer late under load."""
    monkeypatch.setattr("labseq_ttl.access.RealBox.max_wait_s", MAX_WAIT_S)
    monkeypatch.setattr("labseq_ttl.__main__.MAX_WAIT_S", MAX_WAIT_S)
    kind = FirmwareOnACable if request.param == "firmware" else ModelOnACable
    plugged = Plugged(kind(), tmp_path / "ttyACM0")
    yield plugged
    plugged.unplug()


def test_a_box_that_is_unplugged_and_stays_so_cannot_be_made_safe(plugged: Plugged) -> None:
    with rig(port=plugged.name, start="external") as lab:
        lab.fire()
        plugged.unplug()
        with pytest.raises(DeviceError, match="the line to the box broke"):
            lab.lines.wait(60.0)
        with pytest.raises(DeviceError, match="cannot open"):
            lab.lines.safe_state()
        lab.lines.safe_state()
        lab.lines.close()


def test_a_real_port_does_the_same_as_a_simulated_box(plugged: Plugged) -> None:
    with rig(port=plugged.name) as lab:
        for _ in range(3):
            works(lab)
        assert lab.lines.describe()["port"] == plugged.name
        with pytest.raises(DeviceError, match="another program has it open"):
            make_rig(port=plugged.name).lines.open()
        works(lab)
        with pytest.raises(DeviceError, match="does its processor run at 16 MHz"):
            lab.lines.self_test()  # a simulated box plays without a pause


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(DeviceError, match="/dev/ttyNONE: there is no such port"):
        make_rig(port="/dev/ttyNONE").lines.open()
    with pytest.raises(DeviceError, match="socket://here: it is not a network port"):
        make_rig(port="socket://here").lines.open()


def test_an_external_start_is_waited_for(plugged: Plugged, monkeypatch: pytest.MonkeyPatch) -> None:
    with rig(port=plugged.name, start="external") as lab:
        lab.fire("load", 20e-3)
        with monkeypatch.context() as patch:  # it answers no question until the edge
            patch.setattr(lab.driver_box, "_max_wait_s", 0.1)
            with pytest.raises(DeviceTimeoutError, match="did the edge at the start input come"):
                lab.lines.wait(0.05)
        lab.lines.safe_state()
        n_runs = lab.driver_box.state().runs
        plugged.start()
        assert lab.driver_box.state().runs == n_runs, "an edge after safe_state() played the program"
        for _ in range(2):
            lab.fire("load", 20e-3)
            plugged.start()
            lab.lines.wait(60.0)
        lab.fire()
        failures: list[Exception] = []

        def wait() -> None:
            try:
                lab.lines.wait(60.0)
            except DeviceError as failure:
                failures.append(failure)

        thread = threading.Thread(target=wait)
        thread.start()
        lab.lines.safe_state()
        thread.join(60.0)
        assert not thread.is_alive()
        lab.fire()
        lab.clock.stop.request()
        with pytest.raises(StopRequested):
            lab.lines.wait(60.0)
        with lab.clock.stop.held():
            lab.lines.close()


def test_signs_of_life_go_on_past_a_failure() -> None:
    beats, enough = [0], threading.Event()

    def beat() -> None:
        beats[0] += 1
        if beats[0] == 3:
            enough.set()
        raise DeviceError("lines", "unplugged")

    heartbeat = Heartbeat(beat, 0.004)
    heartbeat.start()
    assert enough.wait(60.0)
    heartbeat.stop()
    assert not heartbeat.is_alive()


def test_signs_of_life_come_several_times_within_the_timeout() -> None:
    class Waits(threading.Event):
        seconds: ClassVar[list[float]] = []

        def wait(self, timeout: float | None = None) -> bool:
            assert timeout is not None
            self.seconds.append(timeout)
            return len(self.seconds) > 3

    beats: list[None] = []
    heartbeat = Heartbeat(lambda: beats.append(None), 2.0)
    heartbeat._stopped = Waits()
    heartbeat.run()
    assert len(beats) == 3
    assert max(Waits.seconds) <= 1.0, "one that is late would turn the lines off"


def test_a_box_with_lights_out_hears_signs_of_life_until_it_is_closed(plugged: Plugged) -> None:
    with rig(port=plugged.name, watchdog_timeout="60 s") as lab:
        works(lab)
        assert any(isinstance(thread, Heartbeat) for thread in threading.enumerate())
    assert not any(isinstance(thread, Heartbeat) for thread in threading.enumerate())


def test_another_process_turns_all_lines_off(plugged: Plugged) -> None:
    with rig(port=plugged.name) as lab:
        emergency = lab.lines.emergency()
        assert emergency is not None
        lab.driver_box.set_lines(0x204)
        with outsider({"lines": (str(emergency.script), emergency.arguments)}) as other:
            assert (other.prepared, other.heavy_modules) == ({"lines": None}, [])
            lab.lines._heartbeat = None
            assert other.off()["lines"].text == f"sent '!' to {plugged.name}"
        assert lab.driver_box.state().on == 0
    with rig() as simulated:
        assert simulated.lines.emergency() is None


def test_the_command_gives_a_box_its_serial_number(
    plugged: Plugged, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([plugged.name, "--serial", "12"]) == 0
    assert main([plugged.name]) == 0
    said = capsys.readouterr().out
    assert all(fact in said for fact in ("serial number 12", "started 0 times", "active low: none"))
    with pytest.raises(DeviceError, match="serial number 12, not 7"):
        make_rig(port=plugged.name, serial_number=7).lines.open()
    with rig(port=plugged.name, serial_number=12) as lab:
        works(lab)
    main([plugged.name])
    assert "active low: 6" in capsys.readouterr().out


def test_the_command_says_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["/dev/ttyNONE"]) == 3
    assert "there is no such port" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["/dev/ttyNONE", "--serial", "70000"])
