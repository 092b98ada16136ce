"""The modes that play from the on-board memory: once, at each trigger, or as a sequence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from labseq_spcm.simulator import facts, registers as r
from labseq_spcm.simulator.memory import Samples
from labseq_spcm.simulator.output import ROUNDING
from labseq_spcm.simulator.rules import refuse


@dataclass(frozen=True, slots=True)
class Stretch:
    """Samples of all active channels that were played in a row.

    Attributes:
        start_s: When the first one was at the output.
        samples: int16 (n, n_channels); repeats.
        n_samples: How many were played, per channel.
    """

    start_s: float
    samples: Samples
    n_samples: int


class Run(Protocol):
    """One run of the card in one of its modes, from its start to its stop."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end by itself."""
        ...

    @property
    def failed(self) -> bool:
        """Whether it broke off for want of data."""
        ...

    def advance(self, now_s: float) -> None:
        """Let everything happen that is due."""
        ...

    def trigger(self, out_s: float) -> None:
        """A trigger that reaches the output at ``out_s``."""
        ...

    def ends_s(self) -> float | None:
        """When it will end, if that is known."""
        ...

    def played(self, now_s: float) -> list[Stretch]:
        """What was played up to now."""
        ...


def cut(stretches: list[Stretch], sample_rate_hz: float, now_s: float) -> list[Stretch]:
    """Only what has been played by now."""
    parts: list[Stretch] = []
    for stretch in stretches:
        n_samples = min(stretch.n_samples, math.floor((now_s - stretch.start_s) * sample_rate_hz + ROUNDING))
        if n_samples > 0:
            parts.append(replace(stretch, n_samples=n_samples))
    return parts


class Replay:
    """STD_SINGLE and STD_SINGLERESTART.

    Args:
        content: Gives the memory, int16 (n, n_channels), as it is when a replay begins.
        sample_rate_hz: Sample rate.
        loops: How often the memory is played; 0: until the stop.
        restart: Once for each trigger, rather than all loops after the first.
    """

    failed = False

    def __init__(
        self, content: Callable[[], Samples], sample_rate_hz: float, loops: int, *, restart: bool
    ) -> None:
        self._content = content
        self._rate = sample_rate_hz
        self._loops = loops
        self._restart = restart
        self._n_played = 0
        self._end_s: float | None = None
        self._stretches: list[Stretch] = []
        self.finished = False

    def advance(self, now_s: float) -> None:
        """End the replay that is over."""
        if self._end_s is not None and now_s >= self._end_s:
            self._end_s = None
            self._n_played += 1 if self._restart else self._loops
            self.finished = bool(self._loops) and self._n_played >= self._loops

    def trigger(self, out_s: float) -> None:
        """Begin, unless it plays or has ended."""
        if self._end_s is not None or self.finished:
            return
        samples = self._content()
        loops = 1 if self._restart else self._loops
        n_samples = len(samples) * loops if loops else 2**62
        self._end_s = out_s + n_samples / self._rate if loops else math.inf
        self._stretches.append(Stretch(out_s, samples, n_samples))

    def ends_s(self) -> float | None:
        """Known while the last replay is on."""
        last = not self._restart or self._n_played + 1 == self._loops
        return self._end_s if last and self._loops else None

    def played(self, now_s: float) -> list[Stretch]:
        """All replays so far."""
        return cut(self._stretches, self._rate, now_s)


@dataclass(frozen=True, slots=True)
class Step:
    """One entry of the sequence memory.

    Attributes:
        segment: The segment that it plays.
        loops: How often.
        following: The step after it.
        on_trigger: It plays again until a trigger has come.
        last: The card stops after it.
    """

    segment: int
    loops: int
    following: int
    on_trigger: bool
    last: bool

    @classmethod
    def decode(cls, value: int) -> Step:
        """From the 64 bits of the register."""
        high = value >> 32 & 0xFFFFFFFF
        return cls(
            segment=value & r.SPCSEQ_SEGMENTMASK,
            loops=high & r.SPCSEQ_LOOPMASK,
            following=(value & r.SPCSEQ_NEXTSTEPMASK) >> 16,
            on_trigger=bool(high & r.SPCSEQ_ENDLOOPONTRIG),
            last=bool(high & r.SPCSEQ_END),
        )

    def check(self, n_segments: int) -> None:
        """Refuse what is not in the memory.

        Raises:
            Refusal: No such segment or step, or no loop.
        """
        if self.segment >= n_segments:
            raise refuse(self.segment, f"a segment below {n_segments}")
        if not self.loops or self.following >= facts.MAX_STEPS:
            raise refuse(self.following, f"at least one loop, and a next step below {facts.MAX_STEPS}")


class Sequence:
    """STD_SEQUENCE: segments, one step after the other.

    Args:
        content: Gives a segment, int16 (n, n_channels), as it is when a step begins.
        steps: The step memory: index -> the register's value. May change while it runs.
        first: The step to begin with.
        sample_rate_hz: Sample rate.
    """

    failed = False

    def __init__(
        self, content: Callable[[int], Samples], steps: dict[int, int], first: int, sample_rate_hz: float
    ) -> None:
        self._content = content
        self._steps = steps
        self._rate = sample_rate_hz
        self._pass_s: float | None = None
        self._triggered = False
        self._stretches: list[Stretch] = []
        self.step = first
        self.finished = False

    def _now(self) -> Step:
        return Step.decode(self._steps.get(self.step, 0))

    def _begin(self, start_s: float) -> None:
        step = self._now()
        samples = self._content(step.segment)
        self._pass_s = start_s
        self._stretches.append(Stretch(start_s, samples, len(samples) * max(1, step.loops)))

    def _end_s(self) -> float:
        last = self._stretches[-1]
        return last.start_s + last.n_samples / self._rate

    def advance(self, now_s: float) -> None:
        """Play on, step after step."""
        while self._pass_s is not None and not self.finished and now_s >= self._end_s():
            step = self._now()
            if step.on_trigger and not self._triggered:
                self._repeat(step, now_s)
            elif step.last:
                self.finished = True
            else:
                self._triggered = self._triggered and not step.on_trigger
                if step.following == self.step:
                    self._repeat(step, now_s)
                else:
                    self.step = step.following
                    self._begin(self._end_s())

    def _repeat(self, step: Step, now_s: float) -> None:
        """Play the same step again, as often as it fits up to now and once more."""
        samples, last = self._content(step.segment), self._stretches[-1]
        n_samples = len(samples) * max(1, step.loops)
        if samples.shape != last.samples.shape or not np.shares_memory(samples, last.samples):
            self._begin(self._end_s())
            return
        n_passes = max(1, math.floor((now_s - self._end_s()) * self._rate / n_samples) + 1)
        self._stretches[-1] = replace(last, n_samples=last.n_samples + n_passes * n_samples)

    def trigger(self, out_s: float) -> None:
        """Begin; later, let the step that waits for it end with its loops."""
        if self._pass_s is None:
            self._begin(out_s)
        else:
            self._triggered = True

    def ends_s(self) -> float | None:
        """Known if all steps from now on lead to the last one without a trigger."""
        if self._pass_s is None:
            return None
        end_s, index, seen = self._end_s(), self.step, {self.step}
        while True:
            step = Step.decode(self._steps.get(index, 0))
            if step.on_trigger and not (index == self.step and self._triggered):
                return None
            if step.last:
                return end_s
            index = step.following
            if index in seen:
                return None
            seen.add(index)
            after = Step.decode(self._steps.get(index, 0))
            end_s += len(self._content(after.segment)) * max(1, after.loops) / self._rate

    def played(self, now_s: float) -> list[Stretch]:
        """All steps so far."""
        return cut(self._stretches, self._rate, now_s)
