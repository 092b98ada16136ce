"""The DDS: a list in the driver, a queue on the card, shadow registers, and the output.

Commands gather in the list; WRITE_TO_CARD sends it to the queue by DMA. From the queue a block at
a time goes into the shadow registers, where it waits for its trigger: an edge or a force
where the source is the card, a tick where it is the timer. Source and timer are part of a
block, so block k carries those that lead to event k + 1.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_spcm_sim import registers as r, setup as facts
from labseq_spcm_sim.output import Tone, ToneSpan
from labseq_spcm_sim.setup import Number, Refusal, refuse, stepped

FREQUENCY, FREQUENCY_SLOPE, AMPLITUDE, AMPLITUDE_SLOPE, PHASE = range(5)
"""Rows of the cores' state, in the order of their registers and of the fields of :class:`Tone`."""
KIND: Final = 1000
"""Difference between the register numbers of one kind and the next."""
FIRST: Final = r.SPC_DDS_CORE0_FREQ
END: Final = r.SPC_DDS_TRG_SRC
"""The registers of the cores are from FIRST to END."""

RANGES: Final = {
    FREQUENCY: (0.0, facts.DDS_RATE_HZ / 2, facts.DDS_FREQUENCY_STEP_HZ),
    FREQUENCY_SLOPE: (
        -facts.DDS_FREQUENCY_SLOPE_MAX,
        facts.DDS_FREQUENCY_SLOPE_MAX,
        facts.DDS_FREQUENCY_SLOPE_STEP,
    ),
    AMPLITUDE: (-1.0, 1.0, facts.DDS_AMPLITUDE_STEP),
    AMPLITUDE_SLOPE: (
        -facts.DDS_AMPLITUDE_SLOPE_MAX,
        facts.DDS_AMPLITUDE_SLOPE_MAX,
        facts.DDS_AMPLITUDE_SLOPE_STEP,
    ),
    r.SPC_DDS_TRG_SRC: (0, 2, 1),
    r.SPC_DDS_TRG_TIMER: (*facts.DDS_TIMER_S, facts.DDS_TIMER_STEP_S),
    r.SPC_DDS_DATA_TRANSFER_MODE: (0, 1, 1),
    r.SPC_DDS_FREQ_RAMP_STEPSIZE: (1, 4096, 1),
    r.SPC_DDS_AMP_RAMP_STEPSIZE: (1, 4096, 1),
}
"""Least, most and step of a kind of core registers or of a register; slopes with a ramp step size of 1."""
STEPSIZES: Final = {
    FREQUENCY_SLOPE: r.SPC_DDS_FREQ_RAMP_STEPSIZE,
    AMPLITUDE_SLOPE: r.SPC_DDS_AMP_RAMP_STEPSIZE,
}
"""Kind of slopes -> the register that makes them finer."""

FIXED_CORES: Final = 0xFF
"""Cores that always belong to channel 0."""
GROUPS: Final = (0xF00, 0xF000, 0xF0000)
"""Groups of four cores that channel 0 may have; the first may go to channel 1 instead."""
LONE_CORE: Final = 1 << 20
"""The core that always belongs to channel 1."""


@dataclass(frozen=True, slots=True)
class CoreOutputs:
    """The output of all cores between two events.

    Attributes:
        start_s: When it was first at the output, on the session's clock.
        end_s: When the next event changed it.
        cores: float64 (5, n_cores), at the start: frequency in Hz, its slope, amplitude, its slope,
            phase in radians.
        masks: For each channel the cores that it had, a bit each.
    """

    start_s: float
    end_s: float
    cores: NDArray[np.float64]
    masks: tuple[int, int]

    def spans(self, channel: int) -> list[ToneSpan]:
        """The output of a channel, without its voltage; empty for silence."""
        own = _in_mask(self.masks[channel])
        found = zip(own, self.cores[:, own].T.tolist(), strict=True)
        tones = tuple(Tone(core, *does) for core, does in found if does[AMPLITUDE] or does[AMPLITUDE_SLOPE])
        return [ToneSpan(self.start_s, self.end_s, 0.0, tones)] if tones else []


@lru_cache
def _in_mask(mask: int) -> list[int]:
    return [core for core in range(mask.bit_length()) if mask >> core & 1]


def later_state(cores: NDArray[np.float64], duration_s: float) -> NDArray[np.float64]:
    """The state of cores, float64 (5, n), some time later: linear changes, amplitudes within full scale."""
    later = cores.copy()
    later[FREQUENCY] += duration_s * cores[FREQUENCY_SLOPE]
    later[AMPLITUDE] = np.clip(cores[AMPLITUDE] + duration_s * cores[AMPLITUDE_SLOPE], -1.0, 1.0)
    turns = (cores[FREQUENCY] + 0.5 * duration_s * cores[FREQUENCY_SLOPE]) * duration_s
    later[PHASE] += math.tau * (turns - np.rint(turns))
    return later


@dataclass(slots=True)
class Block:
    """Commands that take effect together.

    Attributes:
        writes: Register -> value.
        n_commands: How many commands it is.
        arrival_s: When all of it is on the card.
    """

    writes: dict[int, float] = field(default_factory=dict[int, float])
    n_commands: int = 0
    arrival_s: float = -math.inf


class Dds:
    """The DDS part of one card.

    Args:
        n_cores: How many cores the card has.
        queue_length: Commands for which the card reports room.

    Attributes:
        outputs: The output between events since the start, in time's order.
    """

    def __init__(self, n_cores: int, queue_length: int) -> None:
        self._n_cores = n_cores
        self._queue_length = queue_length
        self._is_running = False
        self.outputs: list[CoreOutputs] = []
        self.reset(0.0)

    def reset(self, now_s: float) -> None:
        """Forget all commands; silence; 20 cores on channel 0, one on channel 1."""
        if self._is_running:
            self._advance_cores(now_s)
        self._values: dict[int, float] = {
            r.SPC_DDS_NUM_CORES: self._n_cores,
            r.SPC_DDS_QUEUE_CMD_MAX: self._queue_length,
            r.SPC_DDS_TRG_SRC: r.SPCM_DDS_TRG_SRC_CARD,
            r.SPC_DDS_TRG_TIMER: facts.DDS_TIMER_S[0],
            r.SPC_DDS_DATA_TRANSFER_MODE: r.SPCM_DDS_DTM_SINGLE,
            r.SPC_DDS_FREQ_RAMP_STEPSIZE: 1,
            r.SPC_DDS_AMP_RAMP_STEPSIZE: 1,
            r.SPC_DDS_CORES_ON_CH0: FIXED_CORES | sum(GROUPS),
            r.SPC_DDS_CORES_ON_CH1: LONE_CORE,
        }
        self._list = Block()
        self._finished: list[Block] = []
        self._queue: deque[Block] = deque()
        self._n_queued = 0
        self._shadow: Block | None = None
        self._flags = 0
        self._n_events = 0
        self._wire_free_s = -math.inf
        self._silence()

    def _silence(self) -> None:
        self._source = r.SPCM_DDS_TRG_SRC_CARD
        self._timer_s = facts.DDS_TIMER_S[0]
        self._tick_s = math.inf
        self._now = np.zeros((5, max(self._n_cores, LONE_CORE.bit_length())))
        self._since_s = math.inf

    def start(self) -> None:
        """The card starts: silent until the first event; what is queued stays."""
        self._silence()
        self._is_running = True

    def stop(self, now_s: float) -> list[CoreOutputs]:
        """The card stops; what is queued stays. Returns all that was put out since the start."""
        self.advance(now_s)
        outputs, self.outputs = self.played(now_s), []
        self._is_running = False
        self._silence()
        return outputs

    # Registers and commands

    def write(self, register: int, value: Number, now_s: float) -> None:
        """Take a value or a command."""
        if register == r.SPC_DDS_CMD:
            self._command(int(value), now_s)
        elif register in (r.SPC_DDS_CORES_ON_CH0, r.SPC_DDS_CORES_ON_CH1):
            self._connect(register, int(value))
        else:
            self._values[register] = exact = self._rounded(register, value)
            if register < END or register in (r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER):
                self._list.writes[register] = exact
                self._list.n_commands += 1

    def _rounded(self, register: int, value: Number) -> float:
        kind = register
        if register < END:
            kind, core = divmod(register - FIRST, KIND)
            if core >= self._n_cores:
                raise Refusal(r.ERR_REG, facts.UNKNOWN)
            if kind == PHASE:
                if not math.isfinite(value):
                    raise refuse(value, "an angle in degrees")
                return round(value % 360 / facts.DDS_PHASE_STEP_DEG) % 4096 * facts.DDS_PHASE_STEP_DEG
        if kind not in RANGES:
            self.read(register)
            raise Refusal(r.ERR_NOWRITEALLOWED, "this register can only be read")
        low, high, step = RANGES[kind]
        finer = self._values[STEPSIZES[kind]] if kind in STEPSIZES else 1
        return stepped(value, low, high, step / finer)

    def _connect(self, register: int, mask: int) -> None:
        """Snap a mask to the connections that the chip has; the first group has one owner."""
        if register == r.SPC_DDS_CORES_ON_CH0:
            mask = FIXED_CORES | sum(group for group in GROUPS if mask & group)
            other = r.SPC_DDS_CORES_ON_CH1
        else:
            mask = LONE_CORE | (GROUPS[0] if mask & GROUPS[0] else 0)
            other = r.SPC_DDS_CORES_ON_CH0
        self._values[register] = mask
        self._values[other] = int(self._values[other]) & ~(mask & GROUPS[0])

    def _command(self, command: int, now_s: float) -> None:
        if command == r.SPCM_DDS_CMD_RESET:
            self.reset(now_s)
        elif command == r.SPCM_DDS_CMD_EXEC_AT_TRG:
            self._finished.append(self._list)
            self._list = Block()
        elif command == r.SPCM_DDS_CMD_WRITE_TO_CARD:
            self._send(now_s)
        else:
            raise Refusal(r.ERR_FNCNOTSUPPORTED, f"the simulator does not model the DDS command {command}")

    def _send(self, now_s: float) -> None:
        if self._values[r.SPC_DDS_DATA_TRANSFER_MODE] != r.SPCM_DDS_DTM_DMA:
            raise Refusal(r.ERR_FNCNOTSUPPORTED, "the simulator models only commands sent by DMA")
        wire_s = max(now_s, self._wire_free_s)
        for block in self._finished:
            if self._n_queued + block.n_commands > self._queue_length:
                self._flags |= r.SPCM_DDS_STAT_QUEUE_OVERRUN
                break
            wire_s += block.n_commands / facts.DDS_COMMANDS_PER_S
            block.arrival_s = wire_s + facts.DDS_LATENCY_S
            self._queue.append(block)
            self._n_queued += block.n_commands
        self._finished = []
        self._wire_free_s = wire_s

    def read(self, register: int) -> float:
        """The value of a DDS register."""
        if register == r.SPC_DDS_STATUS:
            waiting = self._shadow is not None and self._is_running
            return self._flags | (r.SPCM_DDS_STAT_WAITING_FOR_TRG if waiting else 0)
        if register == r.SPC_DDS_QUEUE_CMD_COUNT:
            return self._n_queued
        if register == r.SPC_DDS_TRG_COUNT:
            return max(0, self._n_events - 1)
        is_core = register < END and (register - FIRST) % KIND < self._n_cores
        if register not in self._values and not is_core:
            raise Refusal(r.ERR_REG, facts.UNKNOWN)
        return self._values.get(register, 0.0)

    # Events

    def advance(self, now_s: float) -> None:
        """Let everything happen that is due: arrivals and ticks."""
        while True:
            if self._shadow is None and self._queue and self._queue[0].arrival_s <= min(now_s, self._tick_s):
                self._shadow = self._queue.popleft()
                self._n_queued -= self._shadow.n_commands
            elif self._is_running and self._tick_s <= now_s:
                if not self._event(self._tick_s):
                    self._skip_ticks(now_s)
            else:
                return

    def _skip_ticks(self, now_s: float) -> None:
        """Without a block the timer ticks on without effect until the next one comes."""
        until_s = min(now_s, self._queue[0].arrival_s) if self._queue else now_s
        n_ticks = max(0, math.ceil((until_s - self._tick_s) / self._timer_s))
        self._tick_s += n_ticks * self._timer_s

    def trigger(self, at_s: float) -> None:
        """A trigger of the card: an edge, or a force."""
        self.advance(at_s)
        if self._source == r.SPCM_DDS_TRG_SRC_CARD:
            self._event(at_s)

    def _event(self, at_s: float) -> bool:
        """The waiting block takes effect; whether there was one."""
        if self._source == r.SPCM_DDS_TRG_SRC_TIMER:
            self._tick_s = at_s + self._timer_s
        if self._shadow is None:
            self._flags |= r.SPCM_DDS_STAT_QUEUE_UNDERRUN
            return False
        writes, self._shadow = self._shadow.writes, None
        self._n_events += 1
        self._advance_cores(at_s + facts.DDS_TRIGGER_DELAY_S)
        for register, value in writes.items():
            if register < END:
                kind, core = divmod(register - FIRST, KIND)
                self._now[kind, core] = math.radians(value) if kind == PHASE else value
        self._source = int(writes.get(r.SPC_DDS_TRG_SRC, self._source))
        self._timer_s = writes.get(r.SPC_DDS_TRG_TIMER, self._timer_s)
        self._tick_s = at_s + self._timer_s if self._source == r.SPCM_DDS_TRG_SRC_TIMER else math.inf
        return True

    # Output

    def _advance_cores(self, to_s: float) -> None:
        """Record the output up to an event, and advance all cores to it."""
        self.outputs += self._current_outputs(to_s)
        duration_s, self._since_s = to_s - self._since_s, to_s
        if duration_s > 0:
            self._now = later_state(self._now, duration_s)

    def _current_outputs(self, until_s: float) -> list[CoreOutputs]:
        """The output since the last event."""
        silent = not self._now[AMPLITUDE : AMPLITUDE_SLOPE + 1].any()
        if self._since_s >= until_s or silent:
            return []
        masks = int(self._values[r.SPC_DDS_CORES_ON_CH0]), int(self._values[r.SPC_DDS_CORES_ON_CH1])
        return [CoreOutputs(self._since_s, until_s, self._now.copy(), masks)]

    def played(self, now_s: float) -> list[CoreOutputs]:
        """All that was put out since the start, up to now."""
        begun = [output for output in self.outputs if output.start_s < now_s]
        ended = [replace(output, end_s=min(output.end_s, now_s)) for output in begun]
        return ended + self._current_outputs(now_s)

    def forget(self, before_s: float) -> None:
        """Drop what ended before a time."""
        self.outputs = [output for output in self.outputs if output.end_s > before_s]
