"""The firmware itself, on a simulated processor in a process of its own."""

from __future__ import annotations

import os
import select
import subprocess
from contextlib import suppress
from typing import Final

from labseq.plugin import BROKEN, Clock, DeviceError, Port, wait_for
from labseq_ttl.counterpart.build import FIRMWARE, runner
from labseq_ttl.port import open_box
from labseq_ttl.protocol import OUTPUTS, Edge

CYCLES_PER_TICK: Final = 8
GATE: Final = 1 << 13
APART_CYCLES: Final = 3
"""The two ports of the processor do not switch in the same cycle; what is nearer than this is one edge."""

MAX_WAIT_S: Final = 60.0
"""How long the simulated processor may take for a program, on a computer that is busy."""


class SimavrBox:
    """A box made of the firmware and simavr.

    Args:
        device: Name of the box, for messages.
        clock: The session's clock, asked for a stop request.

    Attributes:
        name: Name of its serial port.
        port: The port, open; None if it was not to be opened.

    Raises:
        DeviceError: It cannot be built or started.
    """

    def __init__(self, device: str, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._rest = b""
        self._port: Port | None = None
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            [runner(device), FIRMWARE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        )
        try:
            while (words := self._next_line())[0] != "pty":  # what its outputs did at power-up
                pass
            self.name = words[1]
        except BaseException:
            self.close()
            raise

    @property
    def port(self) -> Port:
        """Its serial port, opened when it is first asked for."""
        if self._port is None:
            self._port = open_box(self.name, self._device)
        return self._port

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

    def command(self, text: str) -> None:
        """Tell the simulator something; ``runner.c`` says what it knows."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{text}\n".encode())

    def reset(self, after_ticks: int | None = None) -> None:
        """Press the reset button, now or so long after the first edge of the next program."""
        self.command("reset" if after_ticks is None else f"reset {after_ticks * CYCLES_PER_TICK}")

    def start(self) -> None:
        """A rising edge at the start input."""
        self.command("start")

    def lower(self) -> None:
        """The start input goes low."""
        self.command("low")

    def played(self, polarity: int) -> list[Edge]:
        """What the outputs did; see :class:`~labseq_ttl.counterpart.Counterpart`."""
        first: int | None = None
        edges: list[tuple[int, int]] = []
        for cycle, levels in self.course():
            if first is None:
                first = cycle
            on = 0 if levels is None else (levels ^ polarity) & OUTPUTS
            if edges and cycle - edges[-1][0] < APART_CYCLES:
                edges[-1] = (edges[-1][0], on)
            elif not edges or edges[-1][1] != on:
                edges.append((cycle, on))
        return [(round((cycle - (first or 0)) / CYCLES_PER_TICK), on) for cycle, on in edges]

    def course(self) -> list[tuple[int, int | None]]:
        """What the output registers did while the gate was high, cycle by cycle.

        Returns:
            Clock cycle, and the levels from then on; None after a reset.

        Raises:
            DeviceError: The simulator died.
        """
        course: list[tuple[int, int | None]] = []
        while True:
            words = self._next_line()
            if words[0] == "reset" and course:
                return [*course, (int(words[1]), None)]
            if not words[0].isdecimal():
                continue
            cycle, levels = int(words[0]), int(words[1], 16)
            if levels & GATE:
                course.append((cycle, levels))
            elif course:
                return course

    def close(self) -> None:
        """End the process."""
        if self._port is not None:
            with suppress(*BROKEN):
                self._port.close()
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _next_line(self) -> list[str]:
        """The next line of the simulator, in words."""
        words = wait_for(self._look, MAX_WAIT_S, self._clock)
        if words is None:
            raise DeviceError(self._device, "the simulated processor is silent; expected what it put out")
        return words

    def _look(self, timeout_s: float) -> list[str] | None:
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        while b"\n" not in self._rest:
            if not select.select([pipe], [], [], timeout_s)[0]:
                return None
            came = os.read(pipe, 1 << 16)
            if not came:
                raise DeviceError(self._device, "the simulated processor died; expected it to run")
            self._rest += came
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("ascii", "replace").split()
