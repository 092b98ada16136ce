"""The DDS: a list in the driver, a queue on the card, shadow registers, and what is put out.

Commands gather in the list; WRITE_TO_CARD sends it to the queue. From the queue a block at
a time goes into the shadow registers, where it waits for its trigger: an edge or a force
where the source is the card, a tick where it is the timer. Source and timer are part of a
block, so block k carries those that lead to event k + 1.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_spcm.simulator import facts, registers as r
from labseq_spcm.simulator.dds_cores import CoreOutputs, Cores
from labseq_spcm.simulator.dds_values import LONE_CORE, DdsValues
from labseq_spcm.simulator.rules import Number, Refusal

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
        self._cores.chords = []
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
        chords = self.played(now_s)
        self._cores.chords = []
        self.running = self.free_running = False
        self._silence()
        return chords

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
            self._cores.go_on(now_s, self._values.masks)
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
        """Without a block the timer ticks on unheard until the next one comes."""
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
        self._cores.go_on(out_s, self._values.masks)
        self._shift = bool(block.writes.get(r.SPC_DDS_PHASE_BEHAVIOUR, self._shift))
        for register, value in block.writes.items():
            if register < r.SPC_DDS_TRG_SRC:
                self._cores.write(register, value, shift=self._shift)
        self._source = int(block.writes.get(r.SPC_DDS_TRG_SRC, self._source))
        self._timer_s = block.writes.get(r.SPC_DDS_TRG_TIMER, self._timer_s)
        self._tick_s = at_s + self._timer_s if self._source == r.SPCM_DDS_TRG_SRC_TIMER else math.inf

    def played(self, now_s: float) -> list[CoreOutputs]:
        """All that was put out since the start, up to now."""
        ended = [chord.until(now_s) for chord in self._cores.chords if chord.start_s < now_s]
        return ended + self._cores.current_outputs(now_s, self._values.masks)

    def forget(self, before_s: float) -> None:
        """Drop what ended before a time."""
        self._cores.chords = [chord for chord in self._cores.chords if chord.end_s > before_s]
