"""For the tests of the timing box: simulated boxes, a driver on one, and what its outputs did."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from labseq_ttl.box import Box
from labseq_ttl.go_lines import ttl_lines
from labseq_ttl.lines import TtlLines
from labseq_ttl.programs import mask_of
from labseq_ttl.protocol import framed, unframed
from labseq_ttl.settings import TtlSettings
from labseq_ttl_sim import SimulatedAccess
from labseq_ttl_sim.model import ModelBox

from labseq.plugin import Context, LineProgram, LineSpec
from labseq.sequencer.lines import line_program
from labseq.testing.contracts.instruments import SPECS
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

from .labseq_ttl_simavr import SimavrBox

MAX_WAIT_S = 60.0
FIRMWARE = pytest.param("firmware", marks=pytest.mark.needs("firmware"))
"""What a simulated box is; else "model"."""


class FirmwareAccess(SimulatedAccess):
    """A simulated box that is the firmware itself, in the place of the model."""

    max_wait_s = 15.0  # on a busy computer

    def __init__(self, settings: TtlSettings, context: Context) -> None:
        super().__init__(settings, context)
        active_low = mask_of([spec.active_low for spec in context.lines], context.lines)
        self._polarity = active_low | (0 if settings.go is None else settings.go.polarity)

    def _new_box(self) -> Any:
        return SimavrBox(self._polarity)


@contextmanager
def simulated_by(box: str) -> Generator[None]:
    """While it is open, simulated boxes are these: "model" or "firmware"."""
    with pytest.MonkeyPatch.context() as patch:
        if box == "firmware":
            patch.setattr("labseq_ttl.lines.choose_box", FirmwareAccess)
        yield


@dataclass
class Rig:
    """A driver in a simulation that records everything, on a virtual clock; the box has these lines."""

    lines: TtlLines
    clock: FakeClock
    world: RecordingSimulation
    specs: tuple[LineSpec, ...] = SPECS

    @property
    def played(self) -> list[tuple[LineProgram, float]]:
        """What the simulation received of the lines, and when."""
        plays = [call.args for call in self.world.calls if call.method == "play"]
        return [(args[1], args[2]) for args in plays]

    @property
    def driver_box(self) -> Box:
        """The box as the driver sees it."""
        return self.lines._opened()

    @property
    def box(self) -> Any:
        """The simulated box; None for one at a serial port."""
        return getattr(self.lines.access, "box", None)

    def program(self, kind: str = "image", duration_s: float = 10e-3) -> LineProgram:
        return line_program(self.specs, kind, duration_s)

    def fire(self, kind: str = "image", duration_s: float = 10e-3) -> LineProgram:
        """Compile, arm and fire."""
        program = self.program(kind, duration_s)
        self.lines.compile(program)
        self.lines.arm()
        self.lines.fire()
        return program


def make_rig(specs: tuple[LineSpec, ...] = SPECS, box: str = "model", **settings: Any) -> Rig:
    """A driver that is not open."""
    clock = FakeClock()
    world = RecordingSimulation(Calls(clock))
    context = Context("lines", clock=clock, simulation=world, lines=specs)
    with simulated_by(box):
        return Rig(ttl_lines(TtlSettings.model_validate(settings), context), clock, world, specs)


@contextmanager
def rig(**settings: Any) -> Generator[Rig]:
    """A driver, open."""
    made = make_rig(**settings)
    made.lines.open()
    try:
        yield made
    finally:
        made.lines.close()


def works(lab: Rig) -> None:
    """A shot's worth of it."""
    program = lab.fire("load", 20e-3)
    lab.lines.wait(60.0)
    if lab.box is not None:
        np.testing.assert_allclose(lab.played[-1][0].t_s, program.t_s, atol=1e-12)


class ModelOnACable:
    """The model of the box at the end of a cable: a pty, which a thread serves."""

    def __init__(self) -> None:
        import pty
        import tty

        self._box, self._lock, self._stopped = ModelBox(), threading.Lock(), threading.Event()
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.name = os.ttyname(self._slave)
        self._wake, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def start(self) -> None:
        """A rising edge at the start input."""
        with self._lock:
            self._box.start()
            self._flush()

    def unplug(self) -> None:
        """Pull the cable; repeatable."""
        if not self._stopped.is_set():
            self._stopped.set()
            os.write(self._waker, b".")
            self._thread.join()
            for fd in (self._master, self._slave, self._wake, self._waker):
                os.close(fd)

    def _serve(self) -> None:
        while not self._stopped.is_set():
            if self._master in select.select([self._master, self._wake], [], [])[0]:
                with self._lock:
                    self._box.write(os.read(self._master, 4096))
                    self._flush()

    def _flush(self) -> None:
        while self._box.in_waiting:
            os.write(self._master, self._box.read(4096))


class FirmwareOnACable(SimavrBox):
    """The firmware at the end of a cable."""

    def __init__(self) -> None:
        super().__init__()

    def unplug(self) -> None:
        """End its process, whose pty goes with it; repeatable."""
        self.close()


class Firmware:
    """The firmware on its simulated processor, spoken to line by line."""

    def __init__(self) -> None:
        self.simavr = SimavrBox()
        self._port: Any = self.simavr.port
        self._port.timeout = MAX_WAIT_S

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def line(self) -> str | None:
        """The next line that it says; None for a damaged one."""
        came = self._port.read_until(b"\n")
        assert came.endswith(b"\n"), f"only {came!r} came"
        return unframed(came[:-1])

    def ask(self, question: str) -> str:
        """Say something and read the answer, past what was not asked for."""
        self.write(framed(question))
        while True:
            said = self.line()
            if said is not None and said.startswith(question[:2]):
                return said

    def put(self, slot: int, edges: list[tuple[int, int]]) -> None:
        for i, (ticks, mask) in enumerate(edges):
            assert self.ask(f"a put {slot:x} {i:x} {ticks:x} {mask:x}") == f"a ok {i + 1:02x}"

    def drop_course(self) -> None:
        """Forget what the outputs did until now."""
        while self.simavr._look(0.0) is not None:
            pass

    def close(self) -> None:
        self.simavr.close()
