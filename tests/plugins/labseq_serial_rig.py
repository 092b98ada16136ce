"""The driver of serial instruments, and the simulator that it speaks to."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from labseq_serial.device import SerialDevice
from labseq_serial.settings import SerialSettings

from labseq.config.document import Document
from labseq.config.yaml_nodes import compose
from labseq.plugin import Clock, Context
from labseq.testing.fakes import FakeClock

PROFILE = r"""
  write_ends_with: "\n"
  read_ends_with: "\n"
  timeout: 10 s
  retries: 1
  identify: {ask: "*IDN?", reply: "LAB,(?P<model>[^,]+),(?P<serial_number>[^,]+),(?P<firmware>.+)"}
  commands:
    open: {send: OPEN, reply: OK, repeatable: true, timeout: 250 ms}
    close: {send: CLOSE, reply: OK, repeatable: true}
    once: {send: OPEN, reply: OK, timeout: 250 ms}
    toggle_on: {send: TOGGLE, reply: OK, makes: {is_open: true}}
    toggle_off: {send: TOGGLE, reply: OK, makes: {is_open: false}}
    never: {send: OPEN, reply: OK, makes: {is_open: false}, timeout: 250 ms}
    set:
      send: "FREQ {frequency:.6f}"
      arguments: {frequency: {unit: MHz, min: 1 MHz, max: 200 MHz}}
    dark: {send: FREQ 1.000000}
    nonsense: {send: NONSENSE, reply: OK, error: "ERR.*", repeatable: true}
  values:
    is_open: {ask: "STATE?", type: bool, poll: true}
    frequency: {ask: "FREQ?", unit: MHz, poll: true}
    temperature:
      ask: "TEMP?"
      timeout: 250 ms
      unit: degC
      min: -50 degC
      max: 100 degC
      interlock: {min: 15 degC, max: 25 degC, message: look at the chiller}
  safe_state: [dark, close]
"""
"""The description of the simulator."""


def settings(text: str = PROFILE, **more: Any) -> SerialSettings:
    """Settings of a profile's text; what is given replaces what it says."""
    node = compose(f"device:\n{text}", "profile.yaml")
    assert node is not None
    text = json.dumps({"device": {**node.plain()["device"], **more}})
    return Document.parse(text, "profile.yaml").validate(SerialSettings, ("device",))


class Simulator:
    """An instrument on a pty, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.port = str(folder / "port")
        program = str(Path(__file__).with_name("labseq_serial_simulator.py"))
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", program, self.port],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.order("log")  # it is there now

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate("")

    def order(self, *words: object) -> Any:
        """Have it do something; see there."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    @property
    def log(self) -> list[str]:
        """What it was sent."""
        return self.order("log")


@contextmanager
def opened(port: str | None, clock: Clock | None = None, **more: Any) -> Generator[SerialDevice]:
    """The driver, open on a port."""
    device = SerialDevice(settings(port=port, **more), Context("synth", clock=clock or FakeClock()))
    device.open()
    try:
        yield device
    finally:
        device.close()
