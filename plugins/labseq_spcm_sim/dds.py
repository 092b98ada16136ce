"""The DDS: a list in the driver, a queue on the card, shadow registers, and the output.

Commands gather in the list; WRITE_TO_CARD sends it to the queue. From the queue a block at
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
from labseq_spcm_sim.setup import Number, Refusal, refuse

Masks = tuple[int, int]
"""For each channel the cores that it has, a bit each."""

FREQUENCY, FREQUENCY_SLOPE, AMPLITUDE, AMPLITUDE_SLOPE, PHASE = range(5)
"""Rows of the cores' state, in the order of their registers and of the fields of :class:`Tone`."""
KIND: Final = 1000
"""Difference between the register numbers of one kind and the next."""


@dataclass(frozen=True, slots=True)
class CoreOutputs:
    """The output of all cores between two events.

    Attributes:
        start_s: When it was first at the output, on the session's clock.
        end_s: When the next event changed it.
        cores: float64 (5, n_cores), at the start: frequency in Hz, its slope, amplitude, its slope,
            phase in radians.
        masks: Which cores each channel had.
    """

    start_s: float
    end_s: float
    cores: NDArray[np.float64]
    masks: Masks

    def until(self, now_s: float) -> CoreOutputs:
        """The part that was output by now."""
        return self if self.end_s <= now_s else replace(self, end_s=now_s)

    def spans(self, channel: int) -> list[ToneSpan]:
        """The output of a channel, without its voltage; empty for silence."""
        own = _in_mask(self.masks[channel])
        found = zip(own, self.cores[:, own].T.tolist(), strict=True)
        tones = tuple(Tone(core, *does) for core, does in found if does[AMPLITUDE] or does[AMPLITUDE_SLOPE])
        return [ToneSpan(self.start_s, self.end_s, 0.0, tones)] if tones else []


@lru_cache
def _in_mask(mask: int) -> list[int]:
    """The cores of a mask."""
    return [core for core in range(mask.bit_length()) if mask >> core & 1]


class Cores:
    """All cores of one card.

    Args:
        n_cores: How many there are.

    Attributes:
        outputs: The output between events since the start, in time's order.
    """

    def __init__(self, n_cores: int) -> None:
        self._n_cores = n_cores
        self.outputs: list[CoreOutputs] = []
        self.silence()

    def silence(self) -> None:
        """Set all cores to zero."""
        self._now = np.zeros((5, self._n_cores))
        self._phase_deg: dict[int, float] = {}
        self._since_s = math.inf

    def advance_to(self, to_s: float, masks: Masks) -> None:
        """Record the output up to the next event, and advance all cores to it."""
        self.outputs += self.current_outputs(to_s, masks)
        duration_s = to_s - self._since_s
        self._since_s = to_s
        if duration_s > 0:
            self._now = later_state(self._now, duration_s)

    def write(self, register: int, value: float, *, shift: bool) -> None:
        """Set a value of a core; its phase is set, or shifted by the difference from the phase set before."""
        kind, core = divmod(register - r.SPC_DDS_CORE0_FREQ, KIND)
        if kind == PHASE:
            before_deg = self._phase_deg.get(core, 0.0)
            self._phase_deg[core] = value
            value = math.radians(value)
            if shift:
                value += self._now[PHASE, core] - math.radians(before_deg)
        self._now[kind, core] = value

    def current_outputs(self, until_s: float, masks: Masks) -> list[CoreOutputs]:
        """The output since the last event."""
        silent = not self._now[AMPLITUDE : AMPLITUDE_SLOPE + 1].any()
        if self._since_s >= until_s or silent:
            return []
        return [CoreOutputs(self._since_s, until_s, self._now.copy(), masks)]


def later_state(cores: NDArray[np.float64], duration_s: float) -> NDArray[np.float64]:
    """The state of cores some time later: linear changes, amplitudes within full scale.

    Args:
        cores: float64 (5, n), as in :class:`CoreOutputs`.
        duration_s: How much later.
    """
    later = cores.copy()
    later[FREQUENCY] += duration_s * cores[FREQUENCY_SLOPE]
    amplitude = later[AMPLITUDE]
    amplitude += duration_s * cores[AMPLITUDE_SLOPE]
    np.minimum(amplitude, 1.0, out=amplitude)
    np.maximum(amplitude, -1.0, out=amplitude)
    turns = (cores[FREQUENCY] + 0.5 * duration_s * cores[FREQUENCY_SLOPE]) * duration_s
    later[PHASE] += math.tau * (turns - np.rint(turns))
    return later


KINDS: Final = (
    r.SPC_DDS_CORE0_FREQ,
    r.SPC_DDS_CORE0_FREQ_SLOPE,
    r.SPC_DDS_CORE0_AMP,
    r.SPC_DDS_CORE0_AMP_SLOPE,
    r.SPC_DDS_CORE0_PHASE,
)
"""First register of each kind that there is per core."""
PHASE_KIND: Final = KINDS.index(r.SPC_DDS_CORE0_PHASE)

LIMITS: Final = {
    r.SPC_DDS_AVAIL_FREQ_MIN: 0.0,
    r.SPC_DDS_AVAIL_FREQ_MAX: facts.DDS_RATE_HZ / 2,
    r.SPC_DDS_AVAIL_FREQ_STEP: facts.DDS_FREQUENCY_STEP_HZ,
    r.SPC_DDS_AVAIL_FREQ_SLOPE_MIN: -facts.DDS_FREQUENCY_SLOPE_MAX,
    r.SPC_DDS_AVAIL_FREQ_SLOPE_MAX: facts.DDS_FREQUENCY_SLOPE_MAX,
    r.SPC_DDS_AVAIL_AMP_MIN: -1.0,
    r.SPC_DDS_AVAIL_AMP_MAX: 1.0,
    r.SPC_DDS_AVAIL_AMP_STEP: facts.DDS_AMPLITUDE_STEP,
    r.SPC_DDS_AVAIL_AMP_SLOPE_MIN: -facts.DDS_AMPLITUDE_SLOPE_MAX,
    r.SPC_DDS_AVAIL_AMP_SLOPE_MAX: facts.DDS_AMPLITUDE_SLOPE_MAX,
    r.SPC_DDS_AVAIL_PHASE_MIN: 0.0,
    r.SPC_DDS_AVAIL_PHASE_MAX: 360.0,
    r.SPC_DDS_AVAIL_PHASE_STEP: facts.DDS_PHASE_STEP_DEG,
}

STEPPED: Final = (
    r.SPC_DDS_TRG_SRC,
    r.SPC_DDS_TRG_TIMER,
    r.SPC_DDS_PHASE_BEHAVIOUR,
    r.SPC_DDS_DATA_TRANSFER_MODE,
    r.SPC_DDS_FREQ_RAMP_STEPSIZE,
    r.SPC_DDS_AMP_RAMP_STEPSIZE,
)
"""Registers, besides those of the cores, that have a range and a step."""

FIXED_CORES: Final = 0xFF
"""Cores that always belong to channel 0."""
BLOCKS: Final = (0xF00, 0xF000, 0xF0000)
"""Groups of four cores that channel 0 may have; the first may go to channel 1 instead."""
LONE_CORE: Final = 1 << 20
"""The core that always belongs to channel 1."""


class DdsValues:
    """The last values of the DDS registers, rounded as the driver rounds them.

    Args:
        n_cores: How many cores the card has.
    """

    def __init__(self, n_cores: int) -> None:
        self.n_cores = n_cores
        self.reset()

    def reset(self) -> None:
        """Back to the state after power-on: 20 cores on channel 0, one on channel 1."""
        self._values: dict[int, float] = {
            **LIMITS,
            r.SPC_DDS_NUM_CORES: self.n_cores,
            r.SPC_DDS_TRG_SRC: r.SPCM_DDS_TRG_SRC_CARD,
            r.SPC_DDS_TRG_TIMER: facts.DDS_TIMER_S[0],
            r.SPC_DDS_PHASE_BEHAVIOUR: r.SPCM_DDS_PHASE_JUMP,
            r.SPC_DDS_DATA_TRANSFER_MODE: r.SPCM_DDS_DTM_SINGLE,
            r.SPC_DDS_FREQ_RAMP_STEPSIZE: 1,
            r.SPC_DDS_AMP_RAMP_STEPSIZE: 1,
            r.SPC_DDS_CORES_ON_CH0: FIXED_CORES | sum(BLOCKS),
            r.SPC_DDS_CORES_ON_CH1: LONE_CORE,
        }

    def __getitem__(self, register: int) -> float:
        if register == r.SPC_DDS_AVAIL_FREQ_SLOPE_STEP:
            return facts.DDS_FREQUENCY_SLOPE_STEP / self._values[r.SPC_DDS_FREQ_RAMP_STEPSIZE]
        if register == r.SPC_DDS_AVAIL_AMP_SLOPE_STEP:
            return facts.DDS_AMPLITUDE_SLOPE_STEP / self._values[r.SPC_DDS_AMP_RAMP_STEPSIZE]
        if register in self._values:
            return self._values[register]
        if self._is_core(register):
            return 0.0
        raise Refusal(r.ERR_REG, "the simulator does not know this register")

    @property
    def masks(self) -> tuple[int, int]:
        """The cores of each channel, a bit each."""
        return int(self._values[r.SPC_DDS_CORES_ON_CH0]), int(self._values[r.SPC_DDS_CORES_ON_CH1])

    def _is_core(self, register: int) -> bool:
        return register // 1000 * 1000 in KINDS and register % 1000 < self.n_cores

    def write(self, register: int, value: Number) -> float:
        """Take a value.

        Returns:
            The value that the card really has: rounded, or snapped.

        Raises:
            Refusal: Out of range, or a register that can only be read.
        """
        if self._is_core(register):
            exact = self._core(register // 1000 * 1000, value)
        elif register in STEPPED:
            exact = self._stepped(value, *self._range(register))
        elif register in (r.SPC_DDS_CORES_ON_CH0, r.SPC_DDS_CORES_ON_CH1):
            return self._connect(register, int(value))
        else:
            self[register]
            raise Refusal(r.ERR_NOWRITEALLOWED, "this register can only be read")
        self._values[register] = exact
        return exact

    def write_many(self, registers: NDArray[np.int32], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take many values of cores, trigger source and timer, at once.

        Args:
            registers: int32 (n,).
            values: float64 (n,).

        Returns:
            float64 (n,): the values that the card really has.

        Raises:
            Refusal: One is out of range, or of another register; none is taken.
        """
        kinds, numbers = registers // 1000 - r.SPC_DDS_CORE0_FREQ // 1000, registers % 1000
        settings = kinds == len(KINDS)  # source and timer: two more kinds
        kinds = np.where(settings, kinds + numbers, kinds)
        known = (kinds >= 0) & (kinds < len(KINDS) + 2) & (settings | (numbers < self.n_cores))
        if not (known.all() and np.isfinite(values).all()):
            raise Refusal(r.ERR_REG, "there is another register, or a value that is not finite")
        low, high, step = self._ranges()[:, kinds]
        phases = kinds == PHASE_KIND
        wanted = np.where(phases, values % 360, values)
        if ((wanted < low) | (wanted > high)).any():
            raise Refusal(r.ERR_VALUE, "a value is out of range")
        steps = np.rint(wanted / step)
        exact = np.where(phases, steps % 4096, steps) * step
        self._values.update(zip(registers.tolist(), exact.tolist(), strict=True))
        return exact

    def _core(self, kind: int, value: Number) -> float:
        if kind == r.SPC_DDS_CORE0_PHASE:
            if not math.isfinite(value):
                raise refuse(value, "an angle in degrees")
            return round(value % 360 / facts.DDS_PHASE_STEP_DEG) % 4096 * facts.DDS_PHASE_STEP_DEG
        return self._stepped(value, *self._range(kind))

    def _range(self, register: int) -> tuple[float, float, float]:
        """Least, most and step of a register, or of all registers of a kind."""
        if register == r.SPC_DDS_TRG_TIMER:
            return *facts.DDS_TIMER_S, facts.DDS_TIMER_STEP_S
        if register == r.SPC_DDS_TRG_SRC:
            return 0, 2, 1
        if register in (r.SPC_DDS_PHASE_BEHAVIOUR, r.SPC_DDS_DATA_TRANSFER_MODE):
            return 0, 1, 1
        if register in (r.SPC_DDS_FREQ_RAMP_STEPSIZE, r.SPC_DDS_AMP_RAMP_STEPSIZE):
            return 1, 4096, 1
        if register == r.SPC_DDS_CORE0_FREQ:
            return 0.0, facts.DDS_RATE_HZ / 2, facts.DDS_FREQUENCY_STEP_HZ
        if register == r.SPC_DDS_CORE0_AMP:
            return -1.0, 1.0, facts.DDS_AMPLITUDE_STEP
        if register == r.SPC_DDS_CORE0_FREQ_SLOPE:
            most, step = facts.DDS_FREQUENCY_SLOPE_MAX, self[r.SPC_DDS_AVAIL_FREQ_SLOPE_STEP]
        else:
            most, step = facts.DDS_AMPLITUDE_SLOPE_MAX, self[r.SPC_DDS_AVAIL_AMP_SLOPE_STEP]
        return -most, most, step

    def _ranges(self) -> NDArray[np.float64]:
        """Least, most and step of the kinds of core registers, of the source and of the timer."""
        phase = -np.inf, np.inf, facts.DDS_PHASE_STEP_DEG
        kinds = (*KINDS, r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER)
        return np.array([phase if k == r.SPC_DDS_CORE0_PHASE else self._range(k) for k in kinds]).T

    def _stepped(self, value: Number, low: float, high: float, step: float) -> float:
        if not low <= value <= high:
            raise refuse(value, f"{low:g} to {high:g}")
        return round(value / step) * step

    def _connect(self, register: int, mask: int) -> float:
        """Snap a mask to the connections that the chip has; the first block has one owner."""
        if register == r.SPC_DDS_CORES_ON_CH0:
            mask = FIXED_CORES | sum(block for block in BLOCKS if mask & block)
            other, lost = r.SPC_DDS_CORES_ON_CH1, mask & BLOCKS[0]
        else:
            mask = LONE_CORE | (BLOCKS[0] if mask & BLOCKS[0] else 0)
            other, lost = r.SPC_DDS_CORES_ON_CH0, mask & BLOCKS[0]
        self._values[register] = mask
        self._values[other] = int(self._values[other]) & ~lost
        return mask


QUEUED: Final = (r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER, r.SPC_DDS_PHASE_BEHAVIOUR)
"""Commands, besides those of the cores, that take effect with their block."""


@dataclass(slots=True)
class Block:
    """Commands that take effect together.

    Attributes:
        writes: Register -> value.
        n_commands: How many commands it is.
        at_once: EXEC_NOW rather than EXEC_AT_TRG.
        arrival_s: When all of it is on the card.
    """

    writes: dict[int, float] = field(default_factory=dict[int, float])
    n_commands: int = 0
    at_once: bool = False
    arrival_s: float = -math.inf


class Dds:
    """The DDS part of one card.

    Args:
        values: The DDS registers of the driver, which round what is written.
        queue_length: Commands that the queue holds in SINGLE mode.

    Attributes:
        running: Whether the card is started.
        free_running: Whether the software trigger burns the blocks.
        n_queued: Commands in the queue, without those that wait in the shadow registers.
    """

    def __init__(self, values: DdsValues, queue_length: int) -> None:
        self._values = values
        self._queue_length = queue_length
        self.running = False
        self.free_running = False
        self._cores = Cores(max(values.n_cores, LONE_CORE.bit_length()))
        self.reset()

    def reset(self) -> None:
        """Forget all commands; silence."""
        self._values.reset()
        self._list = Block()
        self._finished: list[Block] = []
        self._queue: deque[Block] = deque()
        self.n_queued = 0
        self._shadow: Block | None = None
        self._flags = 0
        self._primed = False
        self._n_events = 0
        self._wire_free_s = -math.inf
        self._silence()

    def _silence(self) -> None:
        self._source = r.SPCM_DDS_TRG_SRC_CARD
        self._timer_s = facts.DDS_TIMER_S[0]
        self._shift = False
        self._tick_s = math.inf
        self._cores.silence()
        self._retrigger_s = -math.inf

    def start(self) -> None:
        """The card starts: silent until the first event; what is queued stays."""
        self._silence()
        self._cores.outputs = []
        self.running = True
        self._primed = bool(self._shadow or self._queue)

    def run_free(self, now_s: float) -> None:
        """The software trigger is always there: it burns block after block until none is left."""
        self.free_running = True
        self._retrigger_s = max(self._retrigger_s, now_s)

    def stop(self, now_s: float) -> list[CoreOutputs]:
        """The card stops; what is queued stays.

        Returns:
            All that was put out since the start.
        """
        self.advance(now_s)
        outputs = self.played(now_s)
        self._cores.outputs = []
        self.running = self.free_running = False
        self._silence()
        return outputs

    def write(self, register: int, value: Number, now_s: float) -> float:
        """Take a command.

        Returns:
            Seconds that the call takes.

        Raises:
            Refusal: The value is out of range, or EXEC_NOW comes before the first block.
        """
        if register == r.SPC_DDS_CMD:
            return self._command(int(value), now_s)
        exact = self._values.write(register, value)
        if register in QUEUED or r.SPC_DDS_CORE0_FREQ <= register < r.SPC_DDS_TRG_SRC:
            self._list.writes[register] = exact
            self._list.n_commands += 1
        return 0.0

    def write_many(self, registers: NDArray[np.int32], values: NDArray[np.float64], now_s: float) -> float:
        """Take many commands in a row, faster than one by one.

        Args:
            registers: int32 (n,).
            values: float64 (n,).
            now_s: The time.

        Returns:
            Seconds that the call takes.

        Raises:
            Refusal: There is anything but values of cores, trigger sources, timers, EXEC_AT_TRG and
                WRITE_TO_CARD, or a value is out of range: nothing is taken.
        """
        is_command = registers == r.SPC_DDS_CMD
        if not set(values[is_command].tolist()) <= {r.SPCM_DDS_CMD_EXEC_AT_TRG, r.SPCM_DDS_CMD_WRITE_TO_CARD}:
            raise Refusal(r.ERR_VALUE, "an unusual command")
        exact = values.copy()
        exact[~is_command] = self._values.write_many(registers[~is_command], values[~is_command])
        names, numbers, first, busy_s = registers.tolist(), exact.tolist(), 0, 0.0
        for last in [*np.flatnonzero(is_command).tolist(), len(names)]:
            self._list.writes.update(zip(names[first:last], numbers[first:last], strict=True))
            self._list.n_commands += last - first
            first = last + 1
            if last < len(names):
                busy_s = max(busy_s, self._command(int(numbers[last]), now_s))
        return busy_s

    def _command(self, command: int, now_s: float) -> float:
        if command & r.SPCM_DDS_CMD_RESET:
            self._cores.advance_to(now_s, self._values.masks)
            self.reset()
        if command & r.SPCM_DDS_CMD_EXEC_NOW and not (self.running and self._primed):
            raise Refusal(
                r.ERR_SETUP, "the setup isn't valid: write a block with EXEC_AT_TRG to the card first"
            )
        if command & (r.SPCM_DDS_CMD_EXEC_AT_TRG | r.SPCM_DDS_CMD_EXEC_NOW):
            self._list.at_once = bool(command & r.SPCM_DDS_CMD_EXEC_NOW)
            self._finished.append(self._list)
            self._list = Block()
        if command & r.SPCM_DDS_CMD_WRITE_TO_CARD:
            return self._send(now_s)
        return 0.0

    def _send(self, now_s: float) -> float:
        by_dma = self._values[r.SPC_DDS_DATA_TRANSFER_MODE] == r.SPCM_DDS_DTM_DMA
        rate = facts.DDS_DMA_PER_S if by_dma else facts.DDS_SINGLE_PER_S
        room = facts.DDS_DMA_QUEUE if by_dma else self._queue_length
        wire_s = max(now_s, self._wire_free_s)
        for block in self._finished:
            if self.n_queued + block.n_commands > room:
                self._flags |= r.SPCM_DDS_STAT_QUEUE_OVERRUN
                break
            wire_s += block.n_commands / rate
            block.arrival_s = wire_s + (facts.DDS_DMA_LATENCY_S if by_dma else 0.0)
            self._queue.append(block)
            self.n_queued += block.n_commands
            self._primed = self._primed or not block.at_once
        self._finished = []
        self._wire_free_s = wire_s
        return 0.0 if by_dma else wire_s - now_s

    def read(self, register: int) -> float:
        """The value of a DDS register."""
        waiting = self._shadow is not None and self.running
        live = {
            r.SPC_DDS_STATUS: self._flags | (r.SPCM_DDS_STAT_WAITING_FOR_TRG if waiting else 0),
            r.SPC_DDS_QUEUE_CMD_MAX: self._queue_length,
            r.SPC_DDS_NUM_QUEUED_CMD_IN_SW: self._list.n_commands
            + sum(block.n_commands for block in self._finished),
            r.SPC_DDS_TRG_COUNT: max(0, self._n_events - 1),
        }
        if register == r.SPC_DDS_QUEUE_CMD_COUNT:
            return min(self.n_queued, self._queue_length)
        return live[register] if register in live else self._values[register]

    def advance(self, now_s: float) -> None:
        """Let everything happen that is due: arrivals, ticks, free-running triggers."""
        while True:
            tick_s = self._tick_s
            if self.free_running and self._source == r.SPCM_DDS_TRG_SRC_CARD:
                tick_s = self._retrigger_s if self._shadow is None else self._ready_s(self._shadow)
            if self._arrived(min(now_s, tick_s)):
                self._take(self._next())
            elif self.running and tick_s <= now_s:
                if not self._event(tick_s):
                    self._skip_ticks(now_s)
            else:
                return

    def _arrived(self, now_s: float) -> bool:
        """Whether the next block is on the card, and the place where it would wait is free."""
        if not self._queue or self._shadow is not None or self._queue[0].arrival_s > now_s:
            return False
        return self.running or not self._queue[0].at_once

    def _next(self) -> Block:
        block = self._queue.popleft()
        self.n_queued -= block.n_commands
        return block

    def _take(self, block: Block) -> None:
        if block.at_once:
            self._execute(block, max(block.arrival_s, self._retrigger_s))
        else:
            self._shadow = block

    def _ready_s(self, block: Block) -> float:
        return max(block.arrival_s, self._retrigger_s)

    def _skip_ticks(self, now_s: float) -> None:
        """Without a block the timer ticks on without effect until the next one comes."""
        self.free_running = False
        if self._source == r.SPCM_DDS_TRG_SRC_TIMER:
            until_s = min(now_s, self._queue[0].arrival_s) if self._queue else now_s
            n_ticks = max(0, math.ceil((until_s - self._tick_s) / self._timer_s))
            self._tick_s += n_ticks * self._timer_s

    def trigger(self, at_s: float) -> None:
        """A trigger of the card: an edge, or a force."""
        self.advance(at_s)
        if self._source == r.SPCM_DDS_TRG_SRC_CARD:
            self._event(at_s)

    def _event(self, at_s: float) -> bool:
        if self._source == r.SPCM_DDS_TRG_SRC_TIMER:
            self._tick_s = at_s + self._timer_s
        if self._shadow is None:
            self._flags |= r.SPCM_DDS_STAT_QUEUE_UNDERRUN
            return False
        block, self._shadow = self._shadow, None
        self._execute(block, at_s)
        return True

    def _execute(self, block: Block, at_s: float) -> None:
        self._n_events += 1
        self._retrigger_s = at_s + facts.DDS_RETRIGGER_S
        out_s = at_s + facts.DDS_TRIGGER_DELAY_S
        self._cores.advance_to(out_s, self._values.masks)
        self._shift = bool(block.writes.get(r.SPC_DDS_PHASE_BEHAVIOUR, self._shift))
        for register, value in block.writes.items():
            if register < r.SPC_DDS_TRG_SRC:
                self._cores.write(register, value, shift=self._shift)
        self._source = int(block.writes.get(r.SPC_DDS_TRG_SRC, self._source))
        self._timer_s = block.writes.get(r.SPC_DDS_TRG_TIMER, self._timer_s)
        self._tick_s = at_s + self._timer_s if self._source == r.SPCM_DDS_TRG_SRC_TIMER else math.inf

    def played(self, now_s: float) -> list[CoreOutputs]:
        """All that was put out since the start, up to now."""
        ended = [output.until(now_s) for output in self._cores.outputs if output.start_s < now_s]
        return ended + self._cores.current_outputs(now_s, self._values.masks)

    def forget(self, before_s: float) -> None:
        """Drop what ended before a time."""
        self._cores.outputs = [output for output in self._cores.outputs if output.end_s > before_s]
