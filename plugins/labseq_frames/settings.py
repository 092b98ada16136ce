"""Settings of the camera that plays back frames."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from labseq.plugin import Duration, FilePath, Settings


class FramesSettings(Settings):
    """Frames from files, in the place of a camera's."""

    path: FilePath = Field(
        description="what is played, relative to this file: the folder of a run, a TIFF stack, a folder of "
        "PNG or of TIFF files, or a pattern such as `frames/*.png`; files in the natural order of their names"
    )
    images: Literal["all", "first"] = Field(
        default="all",
        description="of a run: all frames of all shots in order, or only the first image of each shot",
    )
    at_end: Literal["stop", "repeat"] = Field(
        default="stop",
        description="after the last frame: end the run with an error that says how many there were, or "
        "begin again with the first",
    )
    readout: Duration = Field(
        default=0.0, description="time from the end of an exposure until its frame can be read"
    )
    time_stamps: Literal["session", "recorded"] = Field(
        default="session",
        description="start of the exposure that a frame tells: on the clock of this session, or as it was "
        "recorded, on the clock of that one, where that is known",
    )
