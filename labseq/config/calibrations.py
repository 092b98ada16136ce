"""Which calibrations a profile goes by."""

from __future__ import annotations

from typing import Annotated, Any, Final, cast

from pydantic import Field, model_validator

from labseq.config.fields import Text, empty_is
from labseq.config.settings import FilePath, Settings
from labseq.model import CALIBRATION_KINDS

OFF: Final = "off"
"""In place of an id, or of a folder: none."""


class CalibrationChoices(Settings):
    """A calibration of each kind that takes the place of the one that is in use otherwise."""

    sites: Text | None = Field(
        default=None, description="where the sites are on the frames: an id, or `off` for none"
    )
    thresholds: Text | None = Field(default=None, description="the detector's thresholds: an id, or `off`")
    tweezers: Text | None = Field(
        default=None, description="amplitudes of the static tweezers' tones: an id, or `off`"
    )
    frequencies: Text | None = Field(
        default=None, description="tones of the mobile tweezers: an id, or `off`"
    )
    overlay: Text | None = Field(
        default=None, description="how the mobile tweezers stand on the static ones: an id, or `off`"
    )

    def of(self, kind: str) -> str | None:
        """The choice for a kind: an id, "off", or None for what is in use."""
        return cast("str | None", getattr(self, kind))


class CalibrationSettings(Settings):
    """Where the profile's calibrations are kept, and which of them count.

    Just a folder, or `off` for none at all, may stand in place of the mapping.
    """

    folder: FilePath | None = Field(
        default=None,
        description="folder of the calibrations, relative to this file; without it `calibrations/NAME` "
        "beside a file `NAME.yaml`",
    )
    use: Annotated[CalibrationChoices, empty_is({})] = Field(
        default=CalibrationChoices(),
        description="calibrations that count in place of those put to use by `labseq calibration use`",
    )

    @model_validator(mode="before")
    @classmethod
    def _may_be_one_word(cls, value: Any) -> Any:
        if value == OFF:
            return {"use": dict.fromkeys(CALIBRATION_KINDS, OFF)}
        return {"folder": value} if isinstance(value, str) else value
