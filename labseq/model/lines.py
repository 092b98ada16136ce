"""Digital lines that switch light and send triggers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, NonNegativeInt, model_validator
from pydantic.dataclasses import dataclass as settings

from labseq.model.grid import read_only
from labseq.settings import IN_SI, Duration, OwnName, Text, setting_error

IDLE: Final = "idle"
"""Kind of step for the time between steps and between shots."""


Span: TypeAlias = tuple[float, float]
"""Start and end, in seconds."""

Pulses: TypeAlias = Mapping[str, Sequence[Span]]
"""Line -> times when it is on, from the beginning of a step."""

NO_PULSES: Final[Pulses] = {}


def _has_slash(name: str) -> str:
    if "/" not in name:
        raise ValueError("expected a whole number, or a name with a slash such as 'Dev1/port0/line3'")
    return name


Channel: TypeAlias = Annotated[
    NonNegativeInt | Annotated[str, AfterValidator(_has_slash)], Field(union_mode="left_to_right")
]
"""An output of a timing box: its number, or a name such as those of National Instruments."""


_TRIGGERED: Final = {"camera": "image", "mobile_tweezers": "rearrange"}
"""Role -> the kind of step that begins with its trigger."""


@settings(frozen=True, slots=True, config=IN_SI)
class LineSpec:
    """A line: its output on the timing box, and when it is on."""

    name: OwnName
    channel: Annotated[
        Channel,
        Field(description="number of the output on the timing box, or a name such as `Dev1/port0/line3`"),
    ]
    on: Annotated[
        tuple[Text, ...],
        Field(
            description="kinds of step during which it is on: `load`, `image`, `rearrange`, `ramp`, "
            "`release`, `pulse`, `wait`, and `idle` for the time between steps and between shots"
        ),
    ] = ()
    lead_s: Annotated[Duration, Field(description="how long before such a step it is turned on")] = 0.0
    lag_s: Annotated[Duration, Field(description="how long after such a step it is turned off")] = 0.0
    pulse_s: Annotated[
        Duration,
        Field(
            le=1.0,
            description="a pulse of this length at the beginning of such a step, instead of being on "
            "throughout",
        ),
    ] = 0.0
    triggers: Annotated[
        Literal["", "camera", "mobile_tweezers"],
        Field(
            description="the role whose trigger input it is wired to. Its exposures or moves begin with the "
            "line"
        ),
    ] = ""
    blinding: Annotated[
        bool, Field(description="its light would damage a camera with EM gain and is never on in an exposure")
    ] = False
    active_low: Annotated[bool, Field(description="the output is low while the line is on")] = False
    turns_off: Annotated[
        Literal["", "static_tweezers"],
        Field(
            description="the role whose light is off while the line is on. With `static_tweezers` the box "
            "times the step `release`, and the line is on in no other step"
        ),
    ] = ""

    @model_validator(mode="after")
    def _check_timing(self) -> Self:
        if self.turns_off and set(self.on) != {"release"}:
            what = "a line that turns the static tweezers off is on at other times"
            raise setting_error(what, "`on: [release]`", at=("on",))
        extra = next((key for key in ("lead", "lag", "pulse") if getattr(self, f"{key}_s")), "")
        if self.turns_off and extra:
            what = f"{extra} is set for a line that turns the static tweezers off"
            raise setting_error(what, "none, as it is on as long as the release", at=(extra,), key=True)
        if self.pulse_s and self.lag_s:
            raise setting_error(
                "both lag and pulse are set", "one of them, as a pulse ends by itself", at=("lag",), key=True
            )
        if self.pulse_s and IDLE in self.on:
            raise setting_error(
                "a pulse has 'idle' among its steps", "kinds of step with a beginning", at=("on",)
            )
        if self.triggers and set(self.on) != {kind := _TRIGGERED[self.triggers]}:
            what = f"a line that triggers the {self.triggers.replace('_', ' ')} is on at other times"
            raise setting_error(what, f"`on: [{kind}]`", at=("on",))
        if self.triggers and self.lead_s:
            raise setting_error(
                "lead is set for a trigger", "none, as the step begins with it", at=("lead",), key=True
            )
        return self


def lines_of(specs: Iterable[LineSpec], kind: str) -> list[LineSpec]:
    """The lines that a kind of step turns on. None for idle, which has no leads and lags."""
    return [spec for spec in specs if kind in spec.on and kind != IDLE]


def margin_s(specs: Iterable[LineSpec], kind: str) -> float:
    """Time that leads and lags of lines add to a step, in seconds."""
    taking_part = lines_of(specs, kind)
    lead_s = max((spec.lead_s for spec in taking_part), default=0.0)
    return lead_s + max((spec.lag_s for spec in taking_part if not spec.pulse_s), default=0.0)


@dataclass(frozen=True, slots=True)
class LinesFacts:
    """Facts about a timing box that are known before it is opened.

    Attributes:
        channels: Its outputs, as in ``LineSpec.channel``. Empty if not known before it is open.
        resolution_s: Step of its clock. Edges are at multiples of it.
        shortest_s: Shortest time between two edges.
        max_edges: Maximum number of edges in a program.
        latency_s: Time from the call of ``fire`` to the first edge.
    """

    channels: tuple[int | str, ...]
    resolution_s: float = 0.0
    shortest_s: float = 0.0
    max_edges: int = 2**31
    latency_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LineProgram:
    """The states of all lines during one step.

    Attributes:
        kind: Kind of the step, such as "image".
        lines: Names of the n_lines lines.
        t_s: float64 (n_edges,), times of the edges after the firing, in seconds, rising from 0.
        on: bool (n_edges, n_lines), the states after each edge. The last states stay.
        begin_s: When the step itself begins, after all leads.
        duration_s: End of the program, lags included. The last edge is not later.
    """

    kind: str
    lines: tuple[str, ...]
    t_s: NDArray[np.float64]
    on: NDArray[np.bool_]
    begin_s: float
    duration_s: float

    def __post_init__(self) -> None:
        t_s = read_only(np.asarray(self.t_s, np.float64), np.float64, (-1,), "t_s")
        on = read_only(np.asarray(self.on, np.bool_), np.bool_, (len(t_s), len(self.lines)), "on")
        if len(t_s) == 0 or t_s[0] != 0.0 or not (np.diff(t_s) > 0).all():
            raise ValueError("the edges of a line program must begin at 0 and rise")
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "on", on)

    def spans(self, line: str) -> list[tuple[float, float]]:
        """Intervals in which a line is on, as (start, end) in seconds from the start of the program.

        The last state is counted until the end of the program.
        """
        column = self.on[:, self.lines.index(line)]
        ends = [*self.t_s[1:].tolist(), max(self.duration_s, float(self.t_s[-1]))]
        spans: list[tuple[float, float]] = []
        for start, end, is_on in zip(self.t_s.tolist(), ends, column.tolist(), strict=True):
            if is_on and spans and spans[-1][1] == start:
                spans[-1] = (spans[-1][0], end)
            elif is_on and end > start:
                spans.append((start, end))
        return spans

    def changes(self) -> list[tuple[str, bool, float]]:
        """Line, new state and time of each change, line by line.

        Before the program the lines are in their state at its end.
        """
        changed = self.on != np.vstack([self.on[-1:], self.on[:-1]])
        columns, edges = np.nonzero(changed.T)
        return [
            (self.lines[column], bool(self.on[edge, column]), float(self.t_s[edge]))
            for column, edge in zip(columns.tolist(), edges.tolist(), strict=True)
        ]

    def rising(self, line: str) -> list[float]:
        """Times at which a line switches on, in seconds from the start of the program. 0 if it starts on."""
        return [start for start, _ in self.spans(line)]
