"""Settings of the built-in steps of a shot."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.config.fields import Text, empty_is, misfit
from labseq.config.settings import Duration, Settings

Exposure: TypeAlias = Annotated[Duration, Field(gt=0)]
"""Seconds, more than 0; "45 ms"."""


class LoadSettings(Settings):
    """``load``: fill the static tweezers with atoms."""

    duration: Duration = Field(default=0.5, description="how long atoms load")


class ImageSettings(Settings):
    """``image``: take a picture and find the atoms on it."""

    exposure: Exposure = Field(default=45e-3, description="exposure time of the camera")


class RearrangeSettings(Settings):
    """``rearrange``: plan, check, move and image, again and again."""

    cycles: int = Field(default=1, ge=1, le=100, description="most cycles of plan, move and image")
    window: Duration | tuple[Duration, ...] = Field(
        default=60e-3,
        description="most time for the moves of one cycle, overheads included; a list gives one per cycle",
    )
    exposure: Exposure = Field(default=45e-3, description="exposure time of the image that ends a cycle")
    stop_when: Literal["defect_free", "never"] = Field(
        default="defect_free", description="whether to leave out further cycles once the target is met"
    )
    window_mode: Literal["early", "fixed"] = Field(
        default="early", description="whether the image follows the last batch, or the end of the window"
    )

    @model_validator(mode="after")
    def _one_window_per_cycle(self) -> Self:
        if isinstance(self.window, tuple) and len(self.window) != self.cycles:
            entries = "1 entry" if len(self.window) == 1 else f"{len(self.window)} entries"
            default = "" if "cycles" in self.model_fields_set else ", its default"
            what = f"the list has {entries}, but cycles is {self.cycles}{default}"
            raise misfit(what, f"{self.cycles}, one per cycle", at=("window",))
        return self

    def window_of(self, cycle: int) -> float:
        """The window of a cycle, in seconds.

        Args:
            cycle: Counted from 1.
        """
        return self.window[cycle - 1] if isinstance(self.window, tuple) else self.window


class WaitSettings(Settings):
    """``wait``: let time pass."""

    duration: Duration = Field(description="how long to wait")


class DeviceSettings(Settings):
    """``device``: have a named device of the profile carry out a command."""

    name: Text = Field(description="name of the device in the profile")
    do: Text = Field(description="command of the device")
    arguments: Annotated[dict[str, str | int | float | bool | None], empty_is({})] = Field(
        default={}, description="arguments of the command"
    )
    timeout: Exposure = Field(default=10.0, description="how long the command may take")
