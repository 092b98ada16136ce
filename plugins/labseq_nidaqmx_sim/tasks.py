"""Tasks of the simulated NI-DAQmx, with their refusals and their playing."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from labseq_nidaqmx.settings import NidaqmxSettings
from numpy.typing import NDArray

from labseq.plugin import Context
from labseq_nidaqmx_sim.cards import MODELS, CardModel, Code, Outputs, Refused

_OUTPUT: Final = re.compile(r"(?P<device>[^/]+)/(?:port(?P<port>\d+)/line(?P<line>\d+)|ao(?P<ao>\d+))")
_TERMINAL: Final = re.compile(r"/(?P<device>[^/]+)/(?:(?P<kind>ao|do)/sampleclock|pfi(?:\d|1[0-5]))")
ROUNDING_S: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of a task.

    Attributes:
        kind: "ao" or "do".
        outputs: Name of each output -> its bit in a sample, 0 for an analogue one.
        limits_v: Least and highest voltage.
    """

    kind: str
    outputs: Mapping[str, int]
    limits_v: tuple[float, float] = (0.0, 0.0)

    def levels(self, samples: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """The levels of its outputs for samples (n_samples,) of the channel."""
        if self.kind == "ao":
            return dict.fromkeys(self.outputs, samples)
        return {name: samples >> bit & 1 for name, bit in self.outputs.items()}


@dataclass(slots=True, eq=False)
class Task:
    """A task with its channels, timing and samples.

    Attributes:
        rate_hz: Rate of its sample clock, 0 for on demand.
        source: Terminal of that clock in small letters, empty for the card's own.
        n_samples: Samples of a channel after which it is done.
        trigger: Terminal of its start trigger, empty for none.
        samples: (n_channels, n_written), None before they were written.
        is_reserved: Whether other tasks cannot have its outputs.
        is_running: Whether it was started, and not stopped.
        begin_s: When its first sample came, inf before.
    """

    channels: list[Channel] = field(default_factory=list["Channel"])
    rate_hz: float = 0.0
    source: str = ""
    n_samples: int = 0
    trigger: str = ""
    samples: NDArray[Any] | None = None
    is_reserved: bool = False
    is_running: bool = False
    begin_s: float = math.inf

    @property
    def kind(self) -> str:
        """Kind of its channels."""
        return self.channels[0].kind if self.channels else ""

    @property
    def outputs(self) -> list[str]:
        """Names of its outputs."""
        return [name for channel in self.channels for name in channel.outputs]

    @property
    def device(self) -> str:
        """Name of its card in small letters."""
        return self.outputs[0].split("/")[0]

    @property
    def clock(self) -> str:
        """Terminal at which other tasks get its clock."""
        return f"/{self.device}/{self.kind}/sampleclock"


class Computer:
    """A computer with NI-DAQmx and the cards that the lines of a profile name."""

    def __init__(self, settings: NidaqmxSettings, context: Context) -> None:
        self._faults = settings.faults
        self._clock = context.clock
        self.outputs = Outputs(context, settings.levels)
        cards = () if self._faults.missing else (str(spec.channel).split("/")[0] for spec in context.lines)
        self.cards = tuple(dict.fromkeys(cards))
        self.product = self._faults.card
        self.model: CardModel = MODELS[self.product]
        self.tasks: dict[int, Task] = {}
        self._n_made = 0
        self._is_unplugged = False

    def new_task(self) -> int:
        """Make a task, and return its handle."""
        self._n_made += 1
        self.tasks[self._n_made] = Task()
        return self._n_made

    def task(self, handle: int | None) -> Task:
        """The task with a handle."""
        if handle not in self.tasks:
            raise Refused(Code.INVALID_TASK)
        return self.tasks[handle]

    def find(self, name: str, kind: str) -> tuple[str, re.Match[str]]:
        """An output by its name, which is returned in small letters."""
        output = _OUTPUT.fullmatch(name.lower())
        device = name.lower().split("/")[0]
        if device not in {card.lower() for card in self.cards}:
            raise Refused(Code.NO_SUCH_DEVICE, name)
        if self._is_unplugged:
            raise Refused(Code.NO_ACCESS, name)
        if output is None or (output["ao"] is None) != (kind == "do"):
            raise Refused(Code.NO_SUCH_CHANNEL, name)
        ports = self.model.ports
        if kind == "ao":
            is_there = int(output["ao"]) < self.model.n_ao
        else:
            is_there = int(output["port"]) < len(ports) and int(output["line"]) < ports[int(output["port"])]
        if not is_there:
            raise Refused(Code.NO_SUCH_CHANNEL, name)
        return name.lower(), output

    def add_channel(
        self, task: Task, names: Sequence[str], kind: str, limits_v: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Add one channel with these outputs."""
        self._refuse_running(task)
        outputs: dict[str, int] = {}
        for name in names:
            found, output = self.find(name, kind)
            if found in task.outputs or found in outputs:
                raise Refused(Code.CHANNEL_IN_TASK, name)
            outputs[found] = int(output["line"] or 0)
        least_v, most_v = self.model.ao_range_v
        if kind == "ao" and not least_v <= limits_v[0] < limits_v[1] <= most_v:
            raise Refused(Code.INVALID_VALUE, f"range {limits_v[0]:g} V to {limits_v[1]:g} V of {names[0]}")
        task.channels.append(Channel(kind, outputs, limits_v))

    def set_timing(self, task: Task, source: str, rate_hz: float, n_samples: int) -> None:
        """Use a sample clock for a finite number of samples."""
        self._refuse_running(task)
        if not task.channels:
            raise Refused(Code.NO_CHANNELS)
        self._check_terminal(source)
        task.rate_hz, task.source, task.n_samples = rate_hz, source.lower(), n_samples
        task.samples = None

    def set_trigger(self, task: Task, terminal: str) -> None:
        """Start on a rising edge."""
        self._refuse_running(task)
        if not task.channels:
            raise Refused(Code.NO_CHANNELS)
        self._check_terminal(terminal)
        task.trigger = terminal

    def write(self, task: Task, samples: NDArray[Any], n_samples: int, *, auto_start: bool) -> int:
        """Write samples (n_channels, n_samples), and return how many of a channel were taken."""
        self._reach(task)
        if samples.size != n_samples * len(task.channels):
            raise Refused(Code.CHANNELS_MISMATCH)
        samples = samples.reshape(len(task.channels), n_samples).copy()
        for channel, row in zip(task.channels, samples, strict=True):
            if channel.kind == "ao" and not (
                channel.limits_v[0] <= row.min() and row.max() <= channel.limits_v[1]
            ):
                raise Refused(Code.AO_OUT_OF_RANGE)
        if not task.rate_hz:
            self._write_at_once(task, samples, auto_start=auto_start)
            return n_samples
        if task.is_running or n_samples > task.n_samples:
            raise Refused(Code.TOO_MANY_SAMPLES)
        self.reserve(task)
        task.samples = samples
        if auto_start:
            self.start(task)
        return n_samples

    def _write_at_once(self, task: Task, samples: NDArray[Any], *, auto_start: bool) -> None:
        if samples.shape[1] > 1:
            raise Refused(Code.BUFFER_ON_DEMAND)
        if not (auto_start or task.is_running):
            raise Refused(Code.NOT_STARTED)
        self.reserve(task)
        task.is_running = True
        self.outputs.play(_levels([task], samples.shape[1], {task: samples}), 1.0)

    def reserve(self, task: Task) -> None:
        """Check the settings of a task against its card, and keep its outputs from other tasks."""
        self._reach(task)
        self._verify(task)
        others = [other for other in self.tasks.values() if other is not task and other.is_reserved]
        taken = {name for other in others for name in other.outputs}
        # the clock of a card's outputs of one kind is one resource, too
        clocks = {other.clock for other in others if other.rate_hz}
        if self._faults.in_use or taken & set(task.outputs) or (task.rate_hz and task.clock in clocks):
            raise Refused(Code.RESERVED)
        task.is_reserved = True

    def _verify(self, task: Task) -> None:
        if not task.channels:
            raise Refused(Code.NO_CHANNELS)
        if not task.rate_hz:
            return
        model, outputs = self.model, [self.find(name, task.kind)[1] for name in task.outputs]
        if task.kind == "ao":
            rates_hz = model.ao_rates_hz
            fastest_hz = rates_hz[len(outputs) - 1] if rates_hz else 0.0
        else:
            is_timed = all(int(output["port"]) in model.timed_ports for output in outputs)
            fastest_hz = model.do_rate_hz if is_timed else 0.0
        if not fastest_hz:
            raise Refused(Code.INVALID_VALUE, "sample clock (supported: on demand)")
        if not 0 < task.rate_hz <= fastest_hz:
            raise Refused(Code.INVALID_VALUE, f"rate {task.rate_hz:g} Hz (at most {fastest_hz:g} Hz)")
        if task.kind == "do" and not model.has_do_clock and not task.source:
            raise Refused(Code.NO_CLOCK_SOURCE)

    def start(self, task: Task) -> None:
        """Start a task. A task with another's clock waits for it."""
        self._refuse_running(task)
        self.reserve(task)
        if not task.rate_hz:
            task.is_running = True
            return
        if task.samples is None:
            raise Refused(Code.NO_SAMPLES)
        if task.samples.shape[1] < 2:
            raise Refused(Code.BUFFER_TOO_SMALL)
        task.is_running, task.begin_s = True, math.inf
        if not task.source and not (task.trigger and self._faults.no_edge):
            self._begin(task)

    def _begin(self, leader: Task) -> None:
        """Begin the clock of a task, also for tasks that wait for it."""
        waiting = [task for task in self.tasks.values() if task.is_running and task.begin_s == math.inf]
        playing = [task for task in waiting if task is leader or task.source == leader.clock]
        for task in playing:
            task.begin_s = self._clock.now()
        n_samples = leader.n_samples
        if self._faults.underflow is not None:
            n_samples = min(n_samples, 1 + int(self._faults.underflow * leader.rate_hz))
        self.outputs.play(_levels(playing, n_samples), leader.rate_hz)
        self._is_unplugged = self._faults.unplugged

    def is_done(self, task: Task) -> bool:
        """Whether a task has played all its samples, or does not run."""
        self._reach(task)
        return not task.is_running or self.left_s(task) <= ROUNDING_S

    def left_s(self, task: Task) -> float:
        """Time until a running task is done, in seconds, inf if its clock has not begun."""
        played_s, underflow_s = self._clock.now() - task.begin_s, self._faults.underflow
        duration_s = task.n_samples / task.rate_hz if task.rate_hz else 0.0
        if underflow_s is not None and underflow_s < min(duration_s, played_s):
            raise Refused(Code.UNDERFLOW)
        return duration_s - played_s

    def wait(self, task: Task, timeout_s: float) -> None:
        """Let the session's time pass until a task is done."""
        if not self.is_done(task):
            if self.left_s(task) > timeout_s + ROUNDING_S:
                raise Refused(Code.NOT_DONE)
            self._clock.sleep(self.left_s(task))

    def stop(self, task: Task) -> None:
        """Stop a task, which keeps its samples. Its outputs hold their levels."""
        is_done = self.is_done(task)
        self._hold(task)
        task.is_running = False
        if not is_done:
            raise Refused(Code.STOPPED_BEFORE_DONE)

    def clear(self, handle: int | None) -> None:
        """End a task. Its outputs hold their levels."""
        task = self.task(handle)
        self._hold(task)
        self.tasks = {number: other for number, other in self.tasks.items() if other is not task}

    def reset(self, device: str) -> None:
        """End the tasks of a card, other programs' too. All its outputs go to 0."""
        if device.lower() not in {card.lower() for card in self.cards}:
            raise Refused(Code.NO_SUCH_DEVICE, device)
        self._faults = self._faults.model_copy(update={"in_use": False})
        self.tasks = {
            number: task
            for number, task in self.tasks.items()
            if not task.channels or task.device != device.lower()
        }

    def _hold(self, task: Task) -> None:
        """Keep the present levels of a task that is ended in the middle of its samples."""
        if not task.is_running or task.samples is None:
            return
        played_s = self._clock.now() - task.begin_s
        if 0.0 <= played_s < task.n_samples / task.rate_hz - ROUNDING_S:
            now = int(played_s * task.rate_hz) % task.samples.shape[1]
            self.outputs.play(_levels([task], 1, {task: task.samples[:, now : now + 1]}), 1.0)

    def _reach(self, task: Task) -> None:
        if self._is_unplugged:
            raise Refused(Code.NO_ACCESS, task.device)

    def _check_terminal(self, name: str) -> None:
        terminal = _TERMINAL.fullmatch(name.lower())
        if name and (terminal is None or terminal["device"] not in {card.lower() for card in self.cards}):
            raise Refused(Code.NO_SUCH_TERMINAL, name)

    def _refuse_running(self, task: Task) -> None:
        if task.is_running:
            raise Refused(Code.RUNNING)


def _levels(
    tasks: Sequence[Task], n_samples: int, samples: Mapping[Task, NDArray[Any]] | None = None
) -> dict[str, NDArray[Any]]:
    """The levels of all outputs of tasks, which repeat written samples until they have enough."""
    levels: dict[str, NDArray[Any]] = {}
    for task in tasks:
        written = task.samples if samples is None else samples[task]
        assert written is not None
        for channel, row in zip(task.channels, written, strict=True):
            levels |= channel.levels(row[:n_samples] if len(row) >= n_samples else np.resize(row, n_samples))
    return levels
