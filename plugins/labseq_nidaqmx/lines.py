"""The driver, which plays one compiled program of all lines by the sample clock of a card."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    Context,
    DeviceError,
    DeviceTimeoutError,
    Emergency,
    LimitError,
    LineProgram,
    Lines,
    LinesFacts,
    format_quantity,
    wait_for,
)
from labseq.plugin.lines import idle_program, off_program
from labseq.plugin.messages import one_of
from labseq_nidaqmx.library import choose_library
from labseq_nidaqmx.outputs import MAX_SAMPLES, OutputGroup, output_groups, sample_counts
from labseq_nidaqmx.settings import NidaqmxSettings

TEST_S: Final = 20e-3
NOT_DONE: Final = -200560
"""NI's code for a task that has not ended within the time to wait."""
HINTS: Final[Mapping[int, str]] = {
    -50103: "close the other program or task that uses these outputs",
    -200022: "close the other program or task that uses these outputs",
    -201003: "check the cable and the supply of the card",
    -88705: "check the cable and the supply of the card",
    -200621: "lower `rate`, or use a card on PCI Express",
    -200016: "lower `rate`, or use a card on PCI Express",
    -200303: "put a line on an analogue output, whose clock the digital lines of this card need",
}
"""NI's code -> remedy."""


class NidaqmxLines(Lines):
    """Lines on digital and analogue outputs of cards that NI-DAQmx drives.

    All outputs share one sample clock. The first task makes it, and the others start before it and wait
    for it, so that an edge comes at the same time on all outputs.

    Calls raise ``DeviceError`` if the cards are not open, refuse, or play a program.
    """

    def __init__(self, settings: NidaqmxSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "lines"
        self._clock = context.clock
        self._specs = context.lines
        self._names = tuple(spec.name for spec in self._specs)
        self._groups = output_groups(self._specs, settings.levels, self._name)
        self._library = choose_library(settings, context)
        self._package: Any = None
        self._tasks: list[Any] = []
        self._devices: dict[str, Any] = {}
        self._resting = off_program(self._specs)
        self._forget()

    @property
    def lines_facts(self) -> LinesFacts:
        """Limits. The cards are known only once they are open."""
        sample_s = 1.0 / self._settings.rate
        return LinesFacts((), sample_s, sample_s, MAX_SAMPLES)

    def open(self) -> None:
        """Find the cards, check that their clocks can play the lines, and turn all lines off.

        No effect if they are open.

        Raises:
            DeviceError: NI-DAQmx, a card or an output is missing, or an output has no hardware timing.
            LimitError: The sample rate is too high for an output.
        """
        if self._package is not None:
            return
        self._package = self._library.load(self._name)
        try:
            with self._calls() as ni:
                self._devices = {group.device: self._device(ni, group.device) for group in self._groups}
                for group in self._groups:
                    self._check_timing(ni, group)
            self._set(off_program(self._specs))
        except BaseException:
            self._disconnect()
            raise

    def idle(self) -> None:
        """Turn on the lines that are on between steps."""
        self._set(idle_program(self._specs))

    def close(self) -> None:
        """Turn all lines off and release the cards. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def safe_state(self) -> None:
        """End the tasks, which stops a program, and turn all lines off."""
        if self._package is not None:
            self._set(off_program(self._specs))

    def emergency(self) -> Emergency | None:
        """A script that writes the levels of lines that are off."""
        return None if self._package is None else self._library.emergency(self._groups)

    def check_program(self, program: LineProgram) -> None:
        """Refuse a program that samples cannot make.

        Raises:
            LimitError: Edges closer together than a sample, or too many samples.
        """
        sample_counts(program, self._settings.rate, self._name)

    def compile(self, program: LineProgram) -> None:
        """Write a program to the cards for the next firing, unless they hold it already.

        Raises:
            LimitError: Edges closer together than a sample, or too many samples.
        """
        with self._calls() as ni:
            if program.lines != self._names:
                text = f"a program has the lines {program.lines}; expected {self._names}"
                raise DeviceError(self._name, text)
            counts = sample_counts(program, self._settings.rate, self._name)
            self._refuse_while_running("compiled")
            self._is_armed = False
            if self._compiled is None or not _is_same(program, self._compiled):
                self._end_tasks()
                for group in self._groups:
                    self._write(ni, group, np.repeat(group.values(program.on), counts, axis=1))
            self._compiled = program

    def arm(self) -> None:
        """Let all tasks but the first wait for its clock."""
        with self._calls():
            self._refuse_while_running("armed")
            if self._compiled is None:
                raise DeviceError(self._name, "armed, but nothing was compiled; call compile() first")
            for task in self._tasks:
                task.stop()  # it is done, but starts again only after a stop
            for task in self._tasks[1:]:
                task.start()
            self._is_armed = True

    def fire(self) -> None:
        """Start the first task, or let the edge at its trigger start it, and return at once."""
        with self._calls():
            if not self._is_armed or self._compiled is None:
                raise DeviceError(self._name, "fired, but not armed; call arm() before each fire()")
            self._is_armed, self._is_running = False, True
            for task in self._tasks[:1]:
                task.start()
            self._end_s = self._clock.now() + self._compiled.duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        with self._calls():
            start_s = self._clock.now()
            self._clock.sleep(max(0.0, min(self._end_s - start_s, timeout_s)))
            left_s = max(0.0, timeout_s - (self._clock.now() - start_s))
            if self._is_running and not wait_for(self._is_over, left_s, self._clock):
                text = f"the program has not ended after {format_quantity(timeout_s, 'time')}"
                trigger = self._settings.trigger
                hint = f"; is there an edge at {trigger}?" if trigger else ""
                raise DeviceTimeoutError(self._name, text + hint, timeout_s)
            self._is_running = False

    def self_test(self) -> None:
        """Play a program that changes no line."""
        on = self._resting.on[-1:]
        self.compile(LineProgram("test", self._names, np.zeros(1), on, 0.0, TEST_S))
        self.arm()
        self.fire()
        self.wait(TEST_S + 1.0)
        self._set(self._resting)

    def describe(self) -> Mapping[str, Any]:
        """Cards, lines, settings."""
        cards = {name: device.product_type for name, device in self._devices.items()}
        numbers = ", ".join(f"{device.serial_num:X}" for device in self._devices.values())
        lines = {spec.name: spec.channel for spec in self._specs}
        facts = {"model": ", ".join(cards.values()), "cards": cards, "serial_number": numbers}
        return {**facts, "lines": lines, **self._settings.model_dump(mode="json")}

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the Python package and of NI-DAQmx."""
        if self._package is None:
            return {}
        driver = ".".join(map(str, self._package.system.System.local().driver_version))
        return {"nidaqmx": (version("nidaqmx"), "1.7.0"), "NI-DAQmx": (driver, "")}

    def _device(self, ni: Any, name: str) -> Any:
        connected = ni.system.System.local().devices.device_names
        if name not in connected:
            expected = one_of(connected) if connected else "a card, but none is connected"
            text = f"NI-DAQmx has no card '{name}'; expected {expected}"
            raise DeviceError(self._name, f"{text} (NI MAX shows and changes the names of cards)")
        return ni.system.System.local().devices[name]

    def _check_timing(self, ni: Any, group: OutputGroup) -> None:
        """Refuse outputs that only the computer can time, and a clock that is too fast for them."""
        device = self._devices[group.device]
        lines = [line for channel in group.channels for line in channel.split(",")]
        if group.kind == "ao":
            untimed = [] if device.ao_samp_clk_supported else lines
        else:
            channels = [ni.system.PhysicalChannel(line) for line in lines]
            untimed = [channel.name for channel in channels if not channel.do_samp_clk_supported]
        if untimed:
            text = f"{untimed[0]} of this {device.product_type} has no hardware timing"
            hint = "the computer would make its edges milliseconds late; use an output that the card clocks"
            raise DeviceError(self._name, f"{text}, so {hint}")
        fastest_hz = device.ao_max_rate if group.kind == "ao" else device.do_max_rate
        if self._settings.rate > fastest_hz:
            what = f"{self._name}: `rate`, with {group.device}/{group.kind} of this {device.product_type},"
            came, limit = (format_quantity(hz, "frequency") for hz in (self._settings.rate, fastest_hz))
            raise LimitError(what, came, f"at most {limit}", setting=("lines", "rate"))

    def _task(self, ni: Any, group: OutputGroup) -> Any:
        """A new task with the outputs of a group, which is ended with the others."""
        task = ni.Task()
        self._tasks.append(task)
        for channel, low, high in zip(group.channels, group.low, group.high, strict=True):
            if group.kind == "do":
                task.do_channels.add_do_chan(channel)  # bit n of a sample is line n of the port
            else:
                least, most = sorted((float(low.sum()), float(high.sum())))
                task.ao_channels.add_ao_voltage_chan(channel, min_val=least, max_val=most)
        return task

    def _write(self, ni: Any, group: OutputGroup, samples: NDArray[Any]) -> None:
        """Make the task of a group with its timing and samples, ready to start."""
        is_first, task = not self._tasks, self._task(ni, group)
        leader = self._groups[0]
        source = "" if is_first else f"/{leader.device}/{leader.kind}/SampleClock"
        task.timing.cfg_samp_clk_timing(self._settings.rate, source, samps_per_chan=samples.shape[1])
        if is_first and self._settings.trigger:
            task.triggers.start_trigger.cfg_dig_edge_start_trig(self._settings.trigger)
        writer = self._writer(ni, group, task, auto_start=False)
        writer(samples)
        task.control(ni.constants.TaskMode.TASK_COMMIT)

    def _writer(self, ni: Any, group: OutputGroup, task: Any, *, auto_start: bool) -> Any:
        """The writer of (n_channels, n_samples) to a task."""
        writers = ni.stream_writers
        if group.kind == "do":
            digital = writers.DigitalMultiChannelWriter(task.out_stream, auto_start)
            return digital.write_many_sample_port_uint32
        return writers.AnalogMultiChannelWriter(task.out_stream, auto_start).write_many_sample

    def _set(self, program: LineProgram) -> None:
        """End all tasks, and write the last states of a program without a clock. The outputs hold them."""
        self._forget()
        with self._calls() as ni:
            self._end_tasks()
            for group in self._groups:
                values = np.ascontiguousarray(group.values(program.on[-1:]))
                self._writer(ni, group, self._task(ni, group), auto_start=True)(values)
            self._end_tasks()  # which frees the outputs for the next program
            self._resting = program

    def _is_over(self, timeout_s: float) -> bool | None:
        try:
            for task in self._tasks:
                task.wait_until_done(timeout_s)
        except self._package.DaqError as error:
            if error.error_code != NOT_DONE:
                raise
            return None
        return True

    def _refuse_while_running(self, what: str) -> None:
        if self._is_running and not self._is_over(0.0):
            raise DeviceError(self._name, f"{what} while a program runs; call wait() first")
        self._is_running = False

    def _forget(self) -> None:
        self._compiled: LineProgram | None = None
        self._is_armed = self._is_running = False
        self._end_s = -math.inf

    def _end_tasks(self) -> None:
        """End all tasks, even if one of them cannot be ended."""
        with ExitStack() as stack:
            while self._tasks:
                stack.callback(self._tasks.pop().close)

    def _disconnect(self) -> None:
        self._forget()
        self._devices = {}
        package, self._package = self._package, None
        if package is not None:
            with suppress(package.DaqError):
                self._end_tasks()
            self._library.unload()

    @contextmanager
    def _calls(self) -> Generator[Any]:
        """Within the block NI's errors become errors of this device."""
        if self._package is None:
            raise DeviceError(self._name, "not open; call open() first")
        try:
            yield self._package
        except self._package.DaqError as error:
            text = " ".join(str(error).split("\n\n")[0].split()).rstrip(".")
            code = error.error_code
            hint = f"; {HINTS[code]}" if code in HINTS else ""
            raise DeviceError(self._name, f"NI-DAQmx: {text} ({code}){hint}") from error


def _is_same(program: LineProgram, other: LineProgram) -> bool:
    same_edges = np.array_equal(program.t_s, other.t_s) and np.array_equal(program.on, other.on)
    return same_edges and program.duration_s == other.duration_s
