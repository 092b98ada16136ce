"""The cards that can be simulated, NI's codes, and the outputs of all cards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np
from labseq_nidaqmx.settings import LevelSettings
from numpy.typing import NDArray

from labseq.plugin import Context, LineProgram


class Code(IntEnum):
    """NI's codes for refused calls."""

    RESERVED = -50103
    NO_SUCH_TERMINAL = -89120
    INVALID_VALUE = -200077
    INVALID_TASK = -200088
    NO_SUCH_CHANNEL = -200170
    NOT_SUPPORTED = -200197
    BUFFER_ON_DEMAND = -200217
    NO_SUCH_DEVICE = -200220
    NO_CLOCK_SOURCE = -200303
    NO_SAMPLES = -200462
    NO_CHANNELS = -200478
    RUNNING = -200479
    CHANNEL_IN_TASK = -200489
    CHANNELS_MISMATCH = -200524
    NOT_DONE = -200560
    AO_OUT_OF_RANGE = -200561
    BUFFER_TOO_SMALL = -200609
    UNDERFLOW = -200621
    NOT_STARTED = -200846
    TOO_MANY_SAMPLES = -200288
    NO_ACCESS = -201003
    STOPPED_BEFORE_DONE = 200010


TEXTS: Final[Mapping[Code, str]] = {
    Code.RESERVED: "the resource is reserved by another task",
    Code.NO_SUCH_TERMINAL: "there is no such terminal",
    Code.INVALID_VALUE: "the device does not support the value of a property",
    Code.INVALID_TASK: "there is no such task",
    Code.NO_SUCH_CHANNEL: "the device has no such physical channel",
    Code.NOT_SUPPORTED: "the device does not have this property",
    Code.BUFFER_ON_DEMAND: "several samples need a sample clock, but the timing is on demand",
    Code.NO_SUCH_DEVICE: "there is no device of this name",
    Code.NO_CLOCK_SOURCE: "the device has no sample clock of its own for these lines, and no source is given",
    Code.NO_SAMPLES: "no samples were written before the start",
    Code.NO_CHANNELS: "the task has no channels",
    Code.RUNNING: "the task is running",
    Code.CHANNEL_IN_TASK: "the channel is in the task already",
    Code.CHANNELS_MISMATCH: "the samples do not have as many channels as the task",
    Code.NOT_DONE: "the task is not done within the time to wait",
    Code.AO_OUT_OF_RANGE: "a sample exceeds the range of the channel",
    Code.BUFFER_TOO_SMALL: "the buffer has fewer than two samples",
    Code.UNDERFLOW: "the memory of the device ran out of samples, because the bus was too slow",
    Code.NOT_STARTED: "the task is not running, is on demand, and is not to be started by the write",
    Code.TOO_MANY_SAMPLES: "samples were written that a finite task never generates",
    Code.NO_ACCESS: "the device cannot be accessed; it may have been disconnected",
    Code.STOPPED_BEFORE_DONE: "the task was stopped before it was done",
}


class Refused(Exception):  # noqa: N818 - a call is refused, which is no error of the simulator
    """A call is refused with a code."""

    def __init__(self, code: Code, about: str = "") -> None:
        super().__init__(f"{TEXTS[code]}: {about}" if about else TEXTS[code])
        self.code = code


@dataclass(frozen=True, slots=True)
class CardModel:
    """Limits of a product, from its data sheet.

    Attributes:
        ports: Number of lines of each port.
        timed_ports: Ports whose lines follow a sample clock.
        has_do_clock: Whether it makes a sample clock for its lines itself.
        do_rate_hz: Highest rate of their clock.
        n_ao: Number of analogue outputs.
        ao_rates_hz: Highest rate of one, two, ... analogue outputs together, empty for on demand only.
        ao_range_v: Least and highest voltage.
    """

    ports: tuple[int, ...]
    timed_ports: tuple[int, ...]
    has_do_clock: bool
    do_rate_hz: float
    n_ao: int
    ao_rates_hz: tuple[float, ...]
    ao_range_v: tuple[float, float]


_AO_RATES_HZ: Final = (2.86e6, 2.0e6, 1.54e6, 1.25e6)
MODELS: Final[Mapping[str, CardModel]] = {
    "PCIe-6363": CardModel((32, 8, 8), (0,), True, 10e6, 4, _AO_RATES_HZ, (-10.0, 10.0)),
    "PCI-6259": CardModel((32, 8, 8), (0,), False, 10e6, 4, _AO_RATES_HZ, (-10.0, 10.0)),
    "USB-6008": CardModel((8, 4), (), False, 0.0, 2, (), (0.0, 5.0)),
}


class Outputs:
    """The levels of all outputs, which the simulation receives as states of the lines."""

    def __init__(self, context: Context, levels: Mapping[str, LevelSettings]) -> None:
        self._specs = context.lines
        self._clock = context.clock
        self._simulation = context.simulation
        self._names = [str(spec.channel).lower() for spec in self._specs]
        self._off = [self._level_off(spec.name, spec.active_low, levels) for spec in self._specs]
        self._on = [
            levels[spec.name].on if spec.name in levels else float(not spec.active_low)
            for spec in self._specs
        ]
        self.levels: dict[str, float] = {}

    @staticmethod
    def _level_off(name: str, active_low: bool, levels: Mapping[str, LevelSettings]) -> float:
        return levels[name].off if name in levels else float(active_low)

    def play(self, levels: Mapping[str, NDArray[Any]], rate_hz: float) -> None:
        """Outputs take these levels, from now on.

        Args:
            levels: Name of each output in small letters -> (n_samples,).
            rate_hz: Samples per second.
        """
        n_samples = max(len(samples) for samples in levels.values())
        changed = np.zeros(n_samples, np.bool_)
        changed[0] = True
        for samples in levels.values():
            changed[1 : len(samples)] |= samples[1:] != samples[:-1]
        edges = np.flatnonzero(changed)
        states = [self._state(i, levels, edges) for i in range(len(self._specs))]
        on = np.array(states, np.bool_).reshape(len(self._specs), len(edges)).T
        kept = [i for i in range(len(edges)) if i == 0 or (on[i] != on[i - 1]).any()]
        self.levels |= {name: float(samples[-1]) for name, samples in levels.items()}
        program = LineProgram(
            "played",
            tuple(spec.name for spec in self._specs),
            edges[kept] / rate_hz,
            on[kept],
            0.0,
            (n_samples - 1) / rate_hz,
        )
        if self._simulation is not None:
            self._simulation.play("lines", program, self._clock.now())

    def _state(
        self, i: int, levels: Mapping[str, NDArray[Any]], edges: NDArray[np.int64]
    ) -> Sequence[bool] | NDArray[np.bool_]:
        """Whether a line is on at each edge, as its level is nearer to its on level than to its off level."""
        name = self._names[i]
        samples = levels.get(name)
        if samples is None:
            samples = np.full(1, self.levels.get(name, self._off[i]))
        at_edges = samples[np.minimum(edges, len(samples) - 1)].astype(np.float64)
        return np.abs(at_edges - self._on[i]) < np.abs(at_edges - self._off[i])
