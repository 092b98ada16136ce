"""The step `pulse`: lines switched within one step, with the exact times of a timing box."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Generic, NamedTuple, Self, TypeVar

from pydantic import Field, model_validator

from labseq.messages import did_you_mean
from labseq.plugin import (
    Duration,
    LinesFacts,
    LineSpec,
    Problem,
    Settings,
    Shot,
    Step,
    StepContext,
    Text,
    TimedBy,
    TimelineEntry,
    empty_is,
    format_quantity,
    setting_error,
)
from labseq.plugin.messages import one_of

MAX_PULSES = 10_000
"""Maximum number of pulses of a step, repetitions included, which is more than any box can play."""
ROUNDING = 1e-6
"""Allowed deviation of a duration from a multiple of the box's resolution, relative to it."""


class Played(NamedTuple):
    """A time during which nothing changes.

    Attributes:
        place: Place of its settings within the step's, such as "parts.dark.". "" for the step itself.
        lines: The lines that are on.
        duration_s: Duration, in seconds.
    """

    place: str
    lines: tuple[str, ...]
    duration_s: float


class PulseOfBlock(Settings):
    """A pulse in a repeated block."""

    lines: Annotated[tuple[Text, ...], empty_is(())] = Field(
        default=(), description="lines of the profile that are on. Without lines it is a pause"
    )
    duration: Duration = Field(description="duration of the pulse. With 0 it is left out")

    @property
    def n_played(self) -> int:
        """Number of pulses, always 1."""
        return 1

    def played(self, place: str = "") -> Iterator[Played]:
        """The pulse itself."""
        yield Played(place, self.lines, self.duration)


P = TypeVar("P", bound="PulseOfBlock | PulseOrBlock")


class Block(Settings, Generic[P]):
    """A pulse, or a sequence of parts that may be repeated as a whole."""

    lines: Annotated[tuple[Text, ...], empty_is(())] = Field(
        default=(), description="lines of the profile that are on. Without lines it is a pause"
    )
    duration: Duration | None = Field(default=None, description="how long it lasts. With 0 it is left out")
    parts: Annotated[dict[Text, P], empty_is({})] = Field(
        default={}, description="instead of `lines` and `duration`, successive pulses as name -> pulse"
    )
    repeat: int = Field(default=1, ge=1, le=MAX_PULSES, description="how often the block is played")

    @property
    def n_played(self) -> int:
        """Number of pulses, including repetitions."""
        return self.repeat * max(1, sum(part.n_played for part in self.parts.values()))

    def played(self, place: str = "") -> Iterator[Played]:
        """The pulses in order, repetitions one by one."""
        for _ in range(self.repeat):
            if self.duration is not None:
                yield Played(place, self.lines, self.duration)
            for name, part in self.parts.items():
                yield from part.played(f"{place}parts.{name}.")

    @model_validator(mode="after")
    def _is_pulse_or_parts(self) -> Self:
        if self.duration is None and not self.parts:
            raise setting_error("a pulse has no duration", "'duration', or 'parts'")
        extra = next((key for key in ("duration", "lines") if key in self.model_fields_set), None)
        if self.parts and extra:
            hint = "make it a separate part"
            raise setting_error(f"'{extra}' is set with 'parts'", "one of them", hint, at=(extra,), key=True)
        if self.n_played > MAX_PULSES:
            what = f"there are {self.n_played} pulses, including repetitions"
            raise setting_error(what, f"at most {MAX_PULSES}", at=("repeat",))
        if dotted := next((name for name in self.parts if "." in name), None):
            what = f"the name '{dotted}' has a dot, which separates the names of an address"
            raise setting_error(what, "a name without a dot", at=("parts", dotted), key=True)
        return self


class PulseOrBlock(Block[PulseOfBlock]):
    """A pulse, or a block of pulses."""


class PulseSettings(Block[PulseOrBlock]):
    """``pulse``: switch lines within a step, with the exact times of the timing box."""


class PulseStep(Step):
    """Plays pulses of lines as one program of the timing box, so the computer cannot delay any of them.

    The lines that the profile turns on in the step `pulse` are on throughout.
    """

    notes = ()

    def __init__(self, settings: PulseSettings) -> None:
        self.played = [pulse for pulse in settings.played() if pulse.duration_s]
        self.places = {pulse.place: pulse for pulse in settings.played()}
        self.duration_s = sum(pulse.duration_s for pulse in self.played)

    @property
    def pulses(self) -> Mapping[str, Sequence[tuple[float, float]]]:
        """Line -> when it is on, from the beginning of the step, in seconds."""
        spans, end_s = defaultdict[str, list[tuple[float, float]]](list), 0.0
        for pulse in self.played:
            start_s, end_s = end_s, end_s + pulse.duration_s
            for line in pulse.lines:
                spans[line].append((start_s, end_s))
        return spans

    def check_devices(
        self,
        devices: Mapping[str, object],
        context: StepContext,
    ) -> Mapping[str, str | Problem]:
        """Report lines that a pulse cannot switch, and durations that the box cannot make."""
        if "lines" not in devices:
            fault, expected = (
                "no device of this profile can time pulses",
                "a timing box (`lines` in the profile)",
            )
            return {"": Problem(fault, expected=expected, hint="see docs/how-to/pulses.md")}
        known = {spec.name: spec for spec in context.lines}
        problems: dict[str, Problem] = {}
        for place, pulse in self.places.items():
            for number, line in enumerate(pulse.lines):
                if problem := _wrong_line(line, known):
                    problems[f"{place}lines.{number}"] = problem
            if problem := _wrong_duration(pulse.duration_s, context.lines_facts):
                problems[f"{place}duration"] = problem
        return problems

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry."""
        duration_s = self.duration_s + context.margin_s("pulse")
        by, pulses = TimedBy("lines", context.lines_facts.resolution_s), self.pulses
        return [TimelineEntry("pulse", duration_s, duration_s, kind="pulse", timed_by=by, pulses=pulses)]

    def run(self, shot: Shot) -> None:
        """Fire the program, and wait for its end."""
        with shot.lines_on("pulse", self.duration_s, pulses=self.pulses):
            shot.clock.sleep(self.duration_s)
        shot.record_duration(self.duration_s, self.duration_s)


def _wrong_line(line: str, known: Mapping[str, LineSpec]) -> Problem | None:
    """Why a pulse cannot switch a line, or None if it can."""
    free = [name for name, spec in known.items() if not spec.triggers]
    if line not in known:
        return Problem(f"there is no line '{line}'", expected=one_of(free), hint=did_you_mean(line, free))
    if role := known[line].triggers.replace("_", " "):
        return Problem(f"'{line}' triggers the {role}", expected=one_of(free))
    return None


def _wrong_duration(duration_s: float, facts: LinesFacts) -> Problem | None:
    """Why the box cannot make a pulse of this duration, or None if it can."""
    tick_s = facts.resolution_s
    n_ticks = duration_s / tick_s if tick_s else 0.0
    is_too_short = 0 < duration_s < facts.shortest_s * (1 - ROUNDING)
    if not is_too_short and abs(n_ticks - round(n_ticks)) <= ROUNDING:
        return None
    duration, shortest, tick = (format_quantity(t, "time", 9) for t in (duration_s, facts.shortest_s, tick_s))
    steps = f", in steps of {tick}" if tick_s else ""
    return Problem(
        f"the timing box cannot make a pulse of {duration}", expected=f"at least {shortest}{steps}"
    )
