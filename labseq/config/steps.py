"""Settings of the built-in steps of a shot."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.config.fields import Text, empty_is, setting_error
from labseq.config.settings import Duration, Fraction, Length, Settings

Exposure: TypeAlias = Annotated[Duration, Field(gt=0)]
"""Seconds, more than 0; "45 ms"."""


PositiveLength: TypeAlias = Annotated[Length, Field(gt=0)]
"""Metres, more than 0; "0.9 um"."""


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
            raise setting_error(what, f"{self.cycles}, one per cycle", at=("window",))
        return self

    def window_of(self, cycle: int) -> float:
        """The window of a cycle, in seconds.

        Args:
            cycle: Counted from 1.
        """
        return self.window[cycle - 1] if isinstance(self.window, tuple) else self.window


class ProbeSettings(Settings):
    """``probe``: pick atoms up, hold them and set them down, beside their sites."""

    offset: tuple[Length, Length] = Field(
        default=(0.0, 0.0),
        description="[along a row, from row to row]: how far beside their sites the tweezers shall stand",
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off; a slow one leads atoms back to their sites"
    )
    pattern: Literal["same", "cross"] = Field(
        default="same",
        description="the offset of each site: the same for all, or in four groups of sites forwards and "
        "backwards along a row, forwards and backwards from row to row",
    )
    sites: Literal["seen", "all"] = Field(
        default="seen", description="which sites are probed: where the last image saw an atom, or all"
    )


class CheckSitesSettings(Settings):
    """``check_sites``: see on the last image whether the sites have moved on the camera."""

    every: int = Field(default=1, ge=1, description="check every so many shots, from the first")
    limit_px: float = Field(default=0.5, gt=0, description="largest shift that is let pass, in pixels")
    spot_px: float = Field(
        default=1.2, gt=0, description="width (1 sigma of a Gaussian) of an atom's image, in pixels"
    )
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger shift is a warning or stops the run"
    )


class CheckOverlaySettings(Settings):
    """``check_overlay``: see by a probe whether the mobile tweezers still stand on the sites."""

    every: int = Field(default=20, ge=1, description="check every so many shots, from the first")
    offset: PositiveLength = Field(
        default=0.9e-6, description="offset of the probe in each of four directions: on the bump's edge"
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off; a slow one leads atoms back to their sites"
    )
    exposure: Exposure = Field(default=45e-3, description="exposure time of the image after it")
    limit: PositiveLength = Field(default=100e-9, description="largest offset that is let pass, on each axis")
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger offset is a warning or stops the run"
    )
    half_width: PositiveLength = Field(
        default=0.93e-6,
        description="distance at which half of the probed atoms survive, where no calibration tells it",
    )
    edge: PositiveLength = Field(
        default=0.23e-6, description="width (1 sigma) of the bump's edge, where no calibration tells it"
    )


class EqualiseSettings(Settings):
    """``equalise``: make the static tweezers even, in a closed loop."""

    device: Text = Field(
        default="trap_camera", description="device of the profile that measures the power of each tweezer"
    )
    value: Text = Field(
        default="spot_powers", description="its value with the powers, an array of rows and columns"
    )
    spread: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.005, description="rms of the part that rows and columns can even out, that is aimed at"
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8, description="how much of it a round takes out"
    )
    max_sum: Annotated[float, Field(gt=0)] = Field(
        default=1.0, description="most that the amplitudes of an axis may add up to, of full scale"
    )
    max_averages: int = Field(default=100, ge=2, description="most measurements that a round averages")
    max_rounds: int = Field(default=25, ge=1, description="most rounds")


class RampSettings(Settings):
    """``ramp``: make the static tweezers shallower or deeper, without a jump."""

    device: Literal["static_tweezers"] = Field(
        default="static_tweezers", description="what is ramped: so far the static tweezers alone"
    )
    depth: Fraction = Field(description="depth at the end, as a fraction of the nominal one")
    duration: Exposure = Field(default=5e-3, description="how long the ramp takes; it is linear")


class WaitSettings(Settings):
    """``wait``: let time pass, or wait until another control system says to go on."""

    duration: Duration | None = Field(default=None, description="how long to wait")
    signal: Literal["go"] | None = Field(
        default=None, alias="for", description="what to wait for, in the place of `duration`"
    )
    timeout: Exposure | None = Field(
        default=None, description="how long that may take; if it does not come, the run ends"
    )
    device: Text | None = Field(
        default=None,
        description="device of the profile that it comes through; needed if several could be meant",
    )

    @model_validator(mode="after")
    def _is_for_one_thing(self) -> Self:
        if self.signal is None:
            if extra := next((key for key in ("timeout", "device") if key in self.model_fields_set), None):
                raise setting_error(
                    f"'{extra}' stands here without 'for'", "'for: go' beside it", at=(extra,), key=True
                )
            if self.duration is None:
                raise setting_error(
                    "a wait says neither how long nor for what", "'duration', or 'for' and 'timeout'"
                )
        elif self.duration is not None:
            raise setting_error("'duration' and 'for' stand together", "one of them", at=("duration",), key=True)
        elif self.timeout is None:
            raise setting_error("a wait for 'go' has no 'timeout'", "how long it may take", at=("for",), key=True)
        return self


class DeviceSettings(Settings):
    """``device``: have a named device of the profile carry out a command."""

    name: Text = Field(description="name of the device in the profile")
    do: Text = Field(description="command of the device")
    arguments: Annotated[dict[str, str | int | float | bool | None], empty_is({})] = Field(
        default={}, description="arguments of the command"
    )
    timeout: Exposure = Field(default=10.0, description="how long the command may take")
