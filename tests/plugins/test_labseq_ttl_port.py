"""The timing box at a serial port: the firmware at the other end of it, as a real box would be."""

from __future__ import annotations

import threading
from collections.abc import Generator

import pytest
from labseq_ttl.__main__ import main
from labseq_ttl.counterpart.simavr import SimavrBox
from labseq_ttl.heartbeat import Heartbeat

from labseq.errors import DeviceError, DeviceTimeoutError, StopRequested
from labseq.roles.shot import NeverStopped

from .labseq_ttl_rig import Rig, make_rig, need_simavr, rig, works


@pytest.fixture
def plugged() -> Generator[SimavrBox]:
    """The firmware at the end of a cable: a serial port of this computer."""
    need_simavr()
    simavr = SimavrBox("lines", NeverStopped())
    yield simavr
    simavr.close()


def test_a_box_that_is_unplugged_during_a_program_is_an_error(plugged: SimavrBox) -> None:
    with rig(port=plugged.name, start="external") as lab:
        lab.fire()
        plugged._process.kill()
        with pytest.raises(DeviceError, match="the line to the box broke"):
            lab.lines.wait(60.0)
        with pytest.raises(DeviceError, match="cannot open"):
            lab.lines.safe_state()


def test_a_box_that_stays_unplugged_cannot_be_made_safe(plugged: SimavrBox) -> None:
    with rig(port=plugged.name) as lab:
        works(lab)
        plugged._process.kill()
        plugged._process.wait()
        with pytest.raises(DeviceError):
            lab.lines.safe_state()
        lab.lines.safe_state()
        lab.lines.close()


def test_a_real_port_does_the_same_as_a_simulated_box(plugged: SimavrBox) -> None:
    with rig(port=plugged.name) as lab:
        for _ in range(3):
            works(lab)
        assert lab.lines.describe()["port"] == plugged.name


def test_the_self_test_finds_a_processor_that_runs_too_fast(plugged: SimavrBox) -> None:
    with rig(port=plugged.name) as lab, pytest.raises(DeviceError, match="does its processor run at 16 MHz"):
        lab.lines.self_test()  # simavr plays without a pause


def test_the_port_has_one_user(plugged: SimavrBox) -> None:
    with rig(port=plugged.name) as lab:
        with pytest.raises(DeviceError, match="another program has it open"):
            make_rig(port=plugged.name).lines.open()
        works(lab)


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(DeviceError, match="cannot open /dev/ttyNONE: there is no such port"):
        make_rig(port="/dev/ttyNONE").lines.open()
    with pytest.raises(DeviceError, match="cannot open socket://here: it is no network port; expected"):
        make_rig(port="socket://here").lines.open()


def test_a_box_with_another_serial_number_is_refused(plugged: SimavrBox) -> None:
    with pytest.raises(DeviceError, match="has the serial number 0; expected 7"):
        make_rig(port=plugged.name, serial_number=7).lines.open()
    with rig(port=plugged.name, serial_number=0) as lab:
        works(lab)


def test_an_external_start_is_waited_for(plugged: SimavrBox) -> None:
    with rig(port=plugged.name, start="external") as lab:
        lab.fire("load", 20e-3)
        with pytest.raises(DeviceTimeoutError, match="did the edge at the start input come"):
            lab.lines.wait(0.05)
        plugged.start()
        lab.lines.wait(60.0)
        works_with_start(lab, plugged)
        lab.fire("load", 20e-3)
        lab.lines.safe_state()
        works_with_start(lab, plugged)


def works_with_start(lab: Rig, plugged: SimavrBox) -> None:
    lab.fire("load", 20e-3)
    plugged.start()
    lab.lines.wait(60.0)


def test_a_wait_for_a_start_ends_with_a_request_to_stop(plugged: SimavrBox) -> None:
    with rig(port=plugged.name, start="external") as lab:
        lab.fire()
        lab.clock.stop.request()
        with pytest.raises(StopRequested):
            lab.lines.wait(60.0)
        with lab.clock.stop.held():
            lab.lines.close()


def test_safe_state_ends_the_wait_of_another_thread(plugged: SimavrBox) -> None:
    with rig(port=plugged.name, start="external") as lab:
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
        works_with_start(lab, plugged)


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


def test_a_box_with_lights_out_hears_signs_of_life_until_it_is_closed(plugged: SimavrBox) -> None:
    with rig(port=plugged.name, watchdog_timeout="60 s") as lab:
        works(lab)
        assert any(isinstance(thread, Heartbeat) for thread in threading.enumerate())
    assert not any(isinstance(thread, Heartbeat) for thread in threading.enumerate())


def test_the_command_gives_a_box_its_serial_number(
    plugged: SimavrBox, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([plugged.name, "--serial", "12"]) == 0
    assert main([plugged.name]) == 0
    assert capsys.readouterr().out.startswith(
        "serial number 12, started 0 times, last by power-up; active low: none"
    )
    with rig(port=plugged.name, serial_number=12) as lab:
        works(lab)
    main([plugged.name])
    assert "active low: 6" in capsys.readouterr().out


def test_the_command_says_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["/dev/ttyNONE"]) == 3
    assert "there is no such port" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["/dev/ttyNONE", "--serial", "70000"])
