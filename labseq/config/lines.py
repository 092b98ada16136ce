"""The lines of a profile: what switches light and sends triggers."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, Field, NonNegativeInt, model_validator

from labseq.config.devices import device_name
from labseq.config.fields import Choice, Text, setting_error
from labseq.config.settings import Duration, Settings
from labseq.model.lines import LineSpec

LINES_KEYS: Final = ("channels", "mutually_exclusive")
"""Keys of ``lines`` that belong to the core, not to the plugin."""

MAX_PULSE_S: Final = 1.0


class ChannelSettings(Settings):
    """One line: its output on the timing box, and when it is on."""

    channel: NonNegativeInt = Field(description="output of the timing box")
    on: tuple[Text, ...] = Field(
        default=(),
        description="kinds of step during which it is on: `load`, `image`, `rearrange`, `ramp`, `wait`; "
        "`idle`: between steps, and before and after a shot",
    )
    lead: Duration = Field(default=0.0, description="how long before such a step it is turned on")
    lag: Duration = Field(default=0.0, description="how long after such a step it is turned off")
    pulse: Annotated[Duration, Field(le=MAX_PULSE_S)] = Field(
        default=0.0,
        description="a pulse of this length at the beginning of such a step, instead of being on throughout",
    )
    triggers: Literal["", "camera"] = Field(
        default="",
        description="the role whose trigger input it is wired to: its exposures begin with the line",
    )
    blinding: bool = Field(
        default=False, description="its light would harm a camera with EM gain: never on during an exposure"
    )
    active_low: bool = Field(default=False, description="the output is low while the line is on")

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.pulse and self.lag:
            raise setting_error(
                "lag is set beside pulse", "one of the two: a pulse ends by itself", at=("lag",), key=True
            )
        if self.pulse and "idle" in self.on:
            raise setting_error(
                "a pulse has 'idle' among its steps", "kinds of step, which have a beginning", at=("on",)
            )
        if self.triggers == "camera" and set(self.on) != {"image"}:
            raise setting_error("a line that triggers the camera is on at other times", "`on: [image]`", at=("on",))
        if self.triggers and self.lead:
            raise setting_error("lead is set for a trigger", "none: the step begins with it", at=("lead",), key=True)
        return self

    def spec(self, name: str) -> LineSpec:
        """The same for the core."""
        return LineSpec(
            name,
            self.channel,
            frozenset(self.on),
            self.lead,
            self.lag,
            self.pulse,
            self.triggers,
            self.blinding,
            self.active_low,
        )


def _distinct(channels: dict[str, ChannelSettings]) -> dict[str, ChannelSettings]:
    for (first, a), (second, b) in combinations(channels.items(), 2):
        if a.channel == b.channel:
            what = f"'{first}' and '{second}' are both on channel {a.channel}"
            raise setting_error(what, "a channel for each line", at=(second, "channel"))
    triggers = [name for name, channel in channels.items() if channel.triggers == "camera"]
    if len(triggers) > 1:
        what = f"'{triggers[0]}' and '{triggers[1]}' both trigger the camera"
        raise setting_error(what, "one line for that", at=(triggers[1], "triggers"))
    for name in channels:
        device_name(name, "a line")
    return channels


class LinesChoice(Choice):
    """The timing box, and what is wired to it."""

    channels: Annotated[dict[str, ChannelSettings], AfterValidator(_distinct)] = Field(
        default={}, description="name of each line -> its channel, and when it is on"
    )
    mutually_exclusive: tuple[tuple[Text, Text], ...] = Field(
        default=(), description="pairs of lines that must never be on at the same time"
    )

    @model_validator(mode="after")
    def _never_together(self) -> Self:
        for number, pair in enumerate(self.mutually_exclusive):
            for place, name in enumerate(pair):
                if name not in self.channels:
                    known = ", ".join(f"'{line}'" for line in self.channels) or "none is declared"
                    raise setting_error(f"there is no line '{name}'", known, at=("mutually_exclusive", number, place))
            first, second = (self.channels[name] for name in pair)
            if both := sorted(set(first.on) & set(second.on)):
                what = (
                    f"'{pair[0]}' and '{pair[1]}' must never be on together, but both are during '{both[0]}'"
                )
                raise setting_error(what, "one of them off then", at=("channels", pair[1], "on"))
        return self

    def specs(self) -> tuple[LineSpec, ...]:
        """The lines for the core, in the order of their channels."""
        specs = [channel.spec(name) for name, channel in self.channels.items()]
        return tuple(sorted(specs, key=lambda spec: spec.channel))
