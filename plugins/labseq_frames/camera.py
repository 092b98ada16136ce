"""The camera that plays back frames."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final, Literal

from pydantic import Field

from labseq.plugin import CameraFacts, ConfigError, Context, DeviceError, Duration, FilePath, Problem
from labseq.plugin.camera import CameraDriver, ExposureResult, OrientationSettings, Series
from labseq_frames.files import BadFramesError, Picture, Source, find_source, format_shape

MAX_EXPOSURE_S: Final = 3600.0
"""Longest exposure, in seconds. Frames from files do not depend on it."""


class FramesSettings(OrientationSettings):
    """Frames from files instead of a camera."""

    path: FilePath = Field(
        description="files to play, relative to this file: the folder of a run, a TIFF stack, a .npy file, "
        "an array of a .npz or HDF5 file (`file.h5:Andor/Pictures`), a folder of PNG, TIFF or .npy files, or "
        "a pattern such as `frames/*.png`. Files come in the natural order of their names"
    )
    images: Literal["all", "first"] = Field(
        default="all",
        description="for a run, all frames of all shots in order, or only the first image of each shot",
    )
    at_end: Literal["stop", "repeat"] = Field(
        default="stop",
        description="after the last frame, end the run with an error that gives their number, or "
        "begin again with the first",
    )
    readout: Duration = Field(
        default=0.0, description="time from the end of an exposure until its frame can be read"
    )
    time_stamps: Literal["session", "recorded"] = Field(
        default="session",
        description="start of the exposure of a frame on the clock of this session, or as recorded, on the "
        "clock of the earlier session, if the file contains it",
    )


class FramesCamera(CameraDriver):
    """Frames from files, with the timing and error behaviour of a real camera.

    Each trigger takes the next frame, whatever the exposure. With the internal trigger each reading does. A
    frame can be read when exposure and read-out have passed on the clock. It has the exposure that it was
    recorded with if the file contains it, else the requested one.
    """

    def __init__(self, settings: FramesSettings, context: Context) -> None:
        super().__init__(context, settings.orientation)
        self._settings = settings
        self._source: Source | None = None
        self._pictures: Generator[Picture] | None = None
        self._damage: BadFramesError | None = None
        self._shape: tuple[int, ...] | None = None
        self._has_looked = False
        self._n_played = 0
        self._playing: Series | None = None
        self._armed_s = 0.0
        self._n_taken = 0
        self._coming: deque[tuple[float, ExposureResult]] = deque()

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, and the shape of the first frame if there is one.

        The first use before :meth:`open` reads the files. :meth:`open` reports their problems.
        """
        if not self._has_looked:
            with suppress(BadFramesError):
                self._look()
        readout_s = self._settings.readout
        return CameraFacts(readout_s, MAX_EXPOSURE_S, self._image_shape, triggers=("software", "internal"))

    def check_settings(self) -> Mapping[str, Problem]:
        """Whether the files can be played, as far as the headers show."""
        try:
            self._look()
        except BadFramesError as error:
            return {"path": replace(error.problem, what=str(replace(error.problem, expected="", hint="")))}
        return {}

    def describe(self) -> Mapping[str, Any]:
        """Settings, the files that were found, and the size of the frames."""
        about = {} if self._source is None else self._source.about
        settings = self._settings.model_dump(mode="json")
        return {"model": "frames from files", **about, "frame_shape": self._image_shape, **settings}

    @property
    def _image_shape(self) -> tuple[int, int] | None:
        """(height, width) of the images, None if no frame was found."""
        return None if self._shape is None else self._orientation.shape((self._shape[0], self._shape[1]))

    def _connect(self) -> None:
        try:
            self._source = self._look()
        except BadFramesError as error:
            source = f"{self._name}: {error.problem.source}"
            raise ConfigError(replace(error.problem, source=source)) from error
        self._n_played = 0

    def _look(self) -> Source:
        """Find the files and the shape of the first frame."""
        self._has_looked = True
        source = find_source(self._settings.path, self._settings.images)
        pictures = source.pictures()
        try:
            first = next(pictures, None)
        finally:
            pictures.close()
        if first is None:
            raise BadFramesError(self._settings.path, "holds no frames", "at least one")
        self._shape = first.image.shape
        return source

    def _disconnect(self) -> None:
        """Close the files. After the next :meth:`open` the first frame comes again."""
        if self._pictures is not None:
            self._pictures.close()
        self._pictures = self._damage = self._source = None

    def _start(self, series: Series) -> None:
        self._stop()
        self._playing, self._armed_s, self._n_taken = series, self._clock.now(), 0

    def _fire(self) -> None:
        self._expose(self._clock.now())

    def _take(self, timeout_s: float) -> ExposureResult | None:
        series = self._playing
        if series is not None and series.trigger == "internal" and not self._coming:
            self._expose(self._armed_s + self._n_taken * (series.exposure_s + self._settings.readout))
        missing_s = self._coming[0][0] - self._clock.now() if self._coming else math.inf
        self._clock.sleep(max(0.0, min(missing_s, timeout_s)))
        return None if missing_s > timeout_s else self._coming.popleft()[1]

    def _stop(self) -> None:
        """Drop unread frames, which are not played again."""
        self._coming.clear()
        self._playing = None

    def _expose(self, t_start_s: float) -> None:
        assert self._playing is not None
        due_s = t_start_s + self._playing.exposure_s + self._settings.readout
        picture = self._next()
        exposure_s = math.nan if picture.exposure_s is None else picture.exposure_s
        if self._settings.time_stamps == "recorded" and picture.t_start_s is not None:
            t_start_s = picture.t_start_s
        self._coming.append((due_s, ExposureResult(self._n_taken, picture.image, "", exposure_s, t_start_s)))
        self._n_taken += 1

    def _next(self) -> Picture:
        """The next frame.

        Raises:
            DeviceError: No frame is left, or the next one is damaged or of another size.
        """
        if self._damage is not None:  # the frame after the damaged one is not the next one
            raise DeviceError(self._name, str(self._damage))
        try:
            picture = self._read()
        except BadFramesError as error:
            self._damage = error
            raise DeviceError(self._name, str(error)) from error
        if picture is None:
            text = f"all {self._n_played} frames of {self._settings.path} have been played"
            hint = "take fewer shots, or set `at_end: repeat`"
            raise DeviceError(self._name, f"{text}; {hint}")
        self._n_played += 1
        return picture

    def _read(self) -> Picture | None:
        """Read the next frame, None after the last."""
        assert self._source is not None
        picture = None if self._pictures is None else next(self._pictures, None)
        if picture is None and (self._pictures is None or self._settings.at_end == "repeat"):
            self._pictures = self._source.pictures()
            picture = next(self._pictures, None)
        if picture is not None and picture.image.shape != self._shape:
            came, first = format_shape(picture.image.shape), format_shape(self._shape or ())
            text = f"the frame has {came} pixels, the first one {first}"
            raise BadFramesError(picture.place, text, hint="play frames of one size at a time")
        return picture
