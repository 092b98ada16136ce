"""The mode STD_SEQUENCE, with segments of the on-board memory and the steps that play them.

Source: Spectrum's manual, chapter "Sequence Mode". Where the manual leaves it to the user to take care, the
    simulated card refuses. A segment that the steps in use lead to cannot be written, and no step in use may
    lead to a segment that was never written or whose samples have not arrived.
"""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Final

import numpy as np

from labseq_spcm_sim import registers as r
from labseq_spcm_sim.modes import Memory, Samples, Stretch, cut, is_silent
from labseq_spcm_sim.output import ROUNDING
from labseq_spcm_sim.setup import (
    MAX_LOOPS_OF_STEP,
    MAX_SEGMENTS,
    MAX_STEPS,
    OUTPUT_FIFO_BYTES,
    UNKNOWN,
    CardModel,
    Refusal,
    refuse,
)

SEGMENT_STEP: Final = 32
LEAST_SAMPLES: Final = 384
"""Least size of a segment, in samples of all active channels together."""
FEATURES: Final = r.SPCSEQ_ENDLOOPONTRIG | r.SPCSEQ_END
REGISTERS: Final = range(r.SPC_SEQMODE_STEPMEM0, r.SPC_SEQMODE_STATUS + 1)


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the sequence memory.

    Attributes:
        word: The value of its register.
        n_samples: Size of its segment when the step was written. The driver works out the segment's addresses
            then, so a step has to be written again after its segment has another size.
    """

    word: int
    n_samples: int

    @property
    def segment(self) -> int:
        """The segment that it plays."""
        return self.word & r.SPCSEQ_SEGMENTMASK

    @property
    def next_step(self) -> int:
        """The step that follows."""
        return (self.word & r.SPCSEQ_NEXTSTEPMASK) >> 16

    @property
    def loops(self) -> int:
        """How often the step plays its segment before the next step."""
        return self.word >> 32 & r.SPCSEQ_LOOPMASK

    @property
    def flags(self) -> int:
        """The conditions SPCSEQ_ENDLOOPONTRIG and SPCSEQ_END."""
        return self.word >> 32 & 0xFFFFFFFF & ~r.SPCSEQ_LOOPMASK


class SequenceMemory(Memory):
    """The on-board memory in segments of equal room, and the steps.

    Args:
        model: The card.
        n_channels: Active channels.

    Attributes:
        segments: Segment -> samples that arrived there, int16 (n, n_channels).
        steps: Number -> step, as far as they were written.
        start_step: The first step after the start.
    """

    def __init__(self, model: CardModel, n_channels: int) -> None:
        super().__init__()
        self._room = model.memory_samples // n_channels
        self._n_channels = n_channels
        self._n_segments = 2
        self._selected = self.start_step = 0
        self._divide(2)

    def _divide(self, n_segments: int) -> None:
        """Divide the memory. All samples and steps are lost."""
        self._n_segments = n_segments
        self._sizes: dict[int, int] = {}
        self._arriving: list[int] = []
        self.segments: dict[int, Samples] = {}
        self.steps: dict[int, Step] = {}

    def size(self, segment: int) -> int:
        """Samples per channel of a segment."""
        return self._sizes.get(segment, 0)

    @property
    def room_bytes(self) -> int:
        """Bytes of the selected segment."""
        return 2 * self._n_channels * self.size(self._selected)

    def write(self, register: int, value: int, used: AbstractSet[int] | None) -> None:
        """Write a register of the sequence mode.

        Args:
            register: Its number.
            value: Its value.
            used: Segments that the steps in use play, None if the card does not run.

        Raises:
            Refusal: Out of range, or not while the card runs, or not while the segment is in use.
        """
        if register < r.SPC_SEQMODE_STEPMEM0 + MAX_STEPS:
            self._write_step(register - r.SPC_SEQMODE_STEPMEM0, value & (2**64 - 1))
        elif register == r.SPC_SEQMODE_WRITESEGMENT:
            self._selected = _within(value, self._n_segments - 1)
        elif register == r.SPC_SEQMODE_SEGMENTSIZE:
            self.check_unused(used)
            self._set_size(value)
        elif register not in (r.SPC_SEQMODE_MAXSEGMENTS, r.SPC_SEQMODE_STARTSTEP):
            raise Refusal(r.ERR_NOWRITEALLOWED, "this register can only be read")
        elif used is not None:
            raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
        elif register == r.SPC_SEQMODE_STARTSTEP:
            self.start_step = _within(value, MAX_STEPS - 1)
        elif not 2 <= value <= MAX_SEGMENTS or value & (value - 1):
            raise refuse(value, f"a power of two from 2 to {MAX_SEGMENTS}")
        else:
            self._divide(value)

    def value(self, register: int) -> int:
        """The value of a register of the sequence mode, except the status."""
        number = register - r.SPC_SEQMODE_STEPMEM0
        if number < MAX_STEPS:
            step = self.steps.get(number)
            return 0 if step is None else step.word
        values = {
            r.SPC_SEQMODE_MAXSEGMENTS: self._n_segments,
            r.SPC_SEQMODE_WRITESEGMENT: self._selected,
            r.SPC_SEQMODE_SEGMENTSIZE: self.size(self._selected),
            r.SPC_SEQMODE_STARTSTEP: self.start_step,
        }
        if register not in values:
            raise Refusal(r.ERR_REG, UNKNOWN)
        return values[register]

    def restore(self, number: int, step: Step | None) -> None:
        """Give a step its earlier value."""
        if step is None:
            self.steps.pop(number, None)
        else:
            self.steps[number] = step

    def _write_step(self, number: int, word: int) -> None:
        step = Step(word, self.size(word & r.SPCSEQ_SEGMENTMASK))
        _within(step.segment, self._n_segments - 1)
        _within(step.next_step, MAX_STEPS - 1)
        if not 1 <= step.loops <= MAX_LOOPS_OF_STEP:
            raise refuse(step.loops, f"1 to {MAX_LOOPS_OF_STEP} loops")
        if step.flags & ~FEATURES:
            raise refuse(step.flags, "SPCSEQ_ENDLOOPALWAYS, SPCSEQ_ENDLOOPONTRIG or SPCSEQ_END")
        self.steps[number] = step

    def _set_size(self, n_samples: int) -> None:
        least, most = LEAST_SAMPLES // self._n_channels, self._room // self._n_segments
        if not least <= n_samples <= most or n_samples % SEGMENT_STEP:
            raise refuse(n_samples, f"{least} to {most} samples in steps of {SEGMENT_STEP}")
        self._sizes[self._selected] = n_samples

    def check_unused(self, used: AbstractSet[int] | None) -> None:
        """Refuse to change the selected segment while it is in use."""
        if used is not None and self._selected in used:
            raise Refusal(r.ERR_SEQUENCE, f"segment {self._selected} is in use by the running sequence")

    def send(self, now_s: float, data: Samples, bytes_per_s: float) -> None:
        """Put data for the selected segment on the bus, at a speed."""
        super().send(now_s, data, bytes_per_s)
        self._arriving.append(self._selected)

    def drop(self) -> None:
        """Drop data that have not arrived."""
        super().drop()
        self._arriving.clear()

    def store(self, data: Samples) -> None:
        """Store arriving data in their segment, before any older samples that reach further."""
        segment, new = self._arriving.pop(0), data.reshape(-1, self._n_channels)
        old = self.segments.get(segment, new[:0])
        self.segments[segment] = np.concatenate([new, old[len(new) :]]) if len(old) > len(new) else new

    def samples(self, step: Step) -> Samples:
        """Samples that a step plays once, int16 (n, n_channels), zeros where nothing was ever written."""
        content = self.segments[step.segment][: step.n_samples]
        return np.pad(content, ((0, step.n_samples - len(content)), (0, 0)))

    def following(self, first: int) -> list[int]:
        """The numbers of the steps that are played from ``first`` on, included.

        Raises:
            Refusal: A step is missing, or its samples are not there.
        """
        numbers: list[int] = []
        seen: set[int] = set()
        number = first
        while number not in seen:
            step = self.steps.get(number)
            if step is None:
                raise Refusal(r.ERR_SEQUENCE, f"step {number} is used, but was never written")
            if step.segment in self._arriving or step.segment not in self.segments:
                text = f"step {number} is used, but the samples of its segment {step.segment} are not there"
                raise Refusal(r.ERR_SEQUENCE, text)
            seen.add(number)
            numbers.append(number)
            if step.flags & r.SPCSEQ_END:
                break
            number = step.next_step
        return numbers


def _within(value: int, most: int) -> int:
    if not 0 <= value <= most:
        raise refuse(value, f"0 to {most}")
    return value


@dataclass(frozen=True, slots=True)
class Visit:
    """A time in which the card plays one step.

    Attributes:
        number: The step's number.
        step: The step as it was entered.
        first: First sample, counted from the beginning of the output.
        samples: Samples that it repeats, of no length if they are not kept.
    """

    number: int
    step: Step
    first: int
    samples: Samples


class SequenceRun:
    """STD_SEQUENCE, a run from the start step on, after the first trigger.

    The next step is chosen when the samples enter the output FIFO, half of it in use (manual, "Sequence
    Mode"), and the status tells the step at the output. The step that follows is the one in the register at
    that time. A further trigger counts for the next step that waits for a trigger, until the detection of
    triggers is disabled (ours).

    Args:
        memory: The segments and steps.
        n_channels: Active channels.
        sample_rate_hz: Sample rate.
        keeps: Whether played samples are kept for :meth:`played`.

    Raises:
        Refusal: The start step leads to steps or samples that are not there.
    """

    failed = False

    def __init__(
        self, memory: SequenceMemory, n_channels: int, sample_rate_hz: float, *, keeps: bool = True
    ) -> None:
        memory.following(memory.start_step)
        self._memory, self._rate, self._keeps = memory, sample_rate_hz, keeps
        self._ahead = OUTPUT_FIFO_BYTES // 2 // (2 * n_channels)
        self._nothing = np.zeros((0, n_channels), np.int16)
        self._visits: list[Visit] = []
        self._out_s = math.inf
        self._at = self._pass_end = 0
        self._end: int | None = None
        self._has_trigger = False
        self.finished = False

    @property
    def used(self) -> set[int]:
        """The segments that are played, unless a step is changed."""
        memory = self._memory
        current = self._visits[-1] if self._visits else None
        first = memory.start_step if current is None else current.number
        segments = {memory.steps[number].segment for number in memory.following(first)}
        return segments if current is None else segments | {current.step.segment}

    def trigger(self, out_s: float) -> None:
        """Begin at the first trigger. A later one is for a step that waits for it."""
        if self._visits:
            self._has_trigger = True
            return
        self._out_s = out_s
        self._enter(self._memory.start_step, 0)

    def drop_trigger(self) -> None:
        """Forget a trigger that no step has waited for."""
        self._has_trigger = False

    def _enter(self, number: int, at: int) -> None:
        step = self._memory.steps[number]
        samples = self._memory.samples(step) if self._keeps else self._nothing
        if self._keeps and is_silent(samples.ravel()):
            samples = self._nothing
        self._visits.append(Visit(number, step, at, samples))
        self._pass_end = at + step.loops * step.n_samples

    def _at_output(self, now_s: float) -> int:
        """The number of samples that were at the output by now."""
        return math.floor((now_s - self._out_s) * self._rate + ROUNDING)

    def advance(self, now_s: float) -> None:
        """Choose the steps that enter the output FIFO up to now."""
        if not self._visits:
            return
        self._at = self._at_output(now_s)
        decided = self._at + self._ahead
        while self._end is None and self._pass_end <= decided:
            self._leave(decided)
        self.finished = self._end is not None and self._end <= self._at
        if not self._keeps:
            self.forget(now_s)

    def _leave(self, decided: int) -> None:
        """After all loops of a step, go on, or play it again for as long as that is decided."""
        visit = self._visits[-1]
        step = self._memory.steps[visit.number]
        if step.flags & r.SPCSEQ_END:
            self._end = self._pass_end
            return
        target = step.next_step
        if step.flags & r.SPCSEQ_ENDLOOPONTRIG:
            target = target if self._has_trigger else visit.number
            self._has_trigger = False
        if target == visit.number and step == visit.step:
            length = step.loops * step.n_samples
            self._pass_end += (1 + (decided - self._pass_end) // length) * length
        else:
            self._enter(target, self._pass_end)

    @property
    def at_output(self) -> int:
        """The step at the output when time was last advanced."""
        return next((visit.number for visit in reversed(self._visits) if visit.first <= self._at), 0)

    def played(self, now_s: float) -> list[Stretch]:
        """The samples played so far, without the silence."""
        ends = [visit.first for visit in self._visits[1:]] + [2**62 if self._end is None else self._end]
        stretches = [
            Stretch(self._out_s + visit.first / self._rate, visit.samples, end - visit.first)
            for visit, end in zip(self._visits, ends, strict=False)
            if len(visit.samples)
        ]
        return cut(stretches, self._rate, now_s)

    def forget(self, before_s: float) -> None:
        """Drop samples played before a time."""
        if self._visits:
            at = self._at_output(before_s)
            n_over = sum(visit.first <= at for visit in self._visits[1:])
            del self._visits[:n_over]
