"""The firmware of the timing box itself, on a simulated processor (simavr) in a separate process."""

from __future__ import annotations

import hashlib
import os
import select
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

import labseq_ttl
from labseq_ttl.box import open_box
from labseq_ttl.protocol import OUTPUTS, Edge

from labseq.plugin import wait_for
from labseq.plugin.serial import BROKEN, Port
from labseq.plugin.system import NeverStopped, cache_root

SOURCE: Final = Path(__file__).with_name("labseq_ttl_runner.c")
FIRMWARE: Final = Path(labseq_ttl.__file__).parent / "firmware" / "labseq_ttl.hex"
CYCLES_PER_TICK: Final = 8
GATE: Final = 1 << 13
APART_CYCLES: Final = 3
"""The two ports of the processor do not switch in the same cycle; changes closer than this are one edge."""

MAX_WAIT_S: Final = 60.0
"""How long the simulated processor may take for a program, on a computer that is busy."""


class SimavrBox:
    """A box: the firmware run by simavr.

    Attributes:
        name: Name of its serial port.
        port: The port.

    Args:
        polarity: Outputs that are low when they are on.
    """

    def __init__(self, polarity: int = 0) -> None:
        self._polarity = polarity
        self._rest = b""
        self._port: Port | None = None
        self._process = subprocess.Popen(
            [runner(), FIRMWARE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        )
        try:
            while (words := self._next_line())[0] != "pty":  # changes of its outputs at power-up
                pass
            self.name = words[1]
        except BaseException:
            self.close()
            raise

    @property
    def port(self) -> Port:
        """Its serial port, opened on first use."""
        if self._port is None:
            self._port = open_box(self.name, "lines")
        return self._port

    def command(self, text: str) -> None:
        """Send a command to the simulator; ``runner.c`` lists them."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{text}\n".encode())

    def reset(self, after_ticks: int | None = None) -> None:
        """Press the reset button, now or some ticks after the first edge of the next program."""
        self.command("reset" if after_ticks is None else f"reset {after_ticks * CYCLES_PER_TICK}")

    def start(self) -> None:
        """A rising edge at the start input."""
        self.command("start")

    def lower(self) -> None:
        """The start input goes low."""
        self.command("low")

    def played(self) -> list[Edge]:
        """What the outputs did since the start of the program that was just fired.

        Returns:
            Ticks since the first edge, and what was on from then on; after a reset nothing is.
        """
        first: int | None = None
        edges: list[tuple[int, int]] = []
        for cycle, levels in self.course():
            if first is None:
                first = cycle
            on = 0 if levels is None else (levels ^ self._polarity) & OUTPUTS
            if edges and cycle - edges[-1][0] < APART_CYCLES:
                edges[-1] = (edges[-1][0], on)
            elif not edges or edges[-1][1] != on:
                edges.append((cycle, on))
        return [(round((cycle - (first or 0)) / CYCLES_PER_TICK), on) for cycle, on in edges]

    def course(self) -> list[tuple[int, int | None]]:
        """The output registers while the gate was high, cycle by cycle.

        Returns:
            Clock cycle, and the levels from then on; None after a reset.
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
        """The words of the simulator's next line."""
        words = wait_for(self._look, MAX_WAIT_S, NeverStopped())
        assert words is not None, "the simulated processor is silent"
        return words

    def _look(self, timeout_s: float) -> list[str] | None:
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        while b"\n" not in self._rest:
            if not select.select([pipe], [], [], timeout_s)[0]:
                return None
            came = os.read(pipe, 1 << 16)
            assert came, "the simulated processor died"
            self._rest += came
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("ascii", "replace").split()


def runner() -> Path:
    """The compiled program that runs the firmware, from labseq's cache."""
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:24]
    program = cache_root() / "ttl" / digest / "runner"
    if not program.is_file():
        program.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=program.parent) as folder:
            built = Path(folder) / "runner"
            libraries = ("-lsimavr", "-lelf", "-lutil")
            subprocess.run(["cc", "-O2", "-std=gnu11", SOURCE, "-o", built, *libraries], check=True)
            built.replace(program)  # whole or not at all, also if another process does the same
    return program
