"""The camera that plays back frames."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Mapping
from contextlib import suppress
from typing import Any, Final

from labseq.plugin import (
    CameraDriver,
    CameraFacts,
    ConfigError,
    Context,
    DeviceError,
    ExposureResult,
    Problem,
    Series,
)
from labseq_frames.picture import BadFramesError, Picture, told
from labseq_frames.settings import FramesSettings
from labseq_frames.sources import Source, find_source

MAX_EXPOSURE_S: Final = 3600.0
"""Longest exposure that may be asked for, in seconds: none makes a difference to what is in a file."""


class FramesCamera(CameraDriver):
    """Frames from files, with a real camera's manners.

    Each trigger takes the next frame, whatever the exposure; with the internal trigger reading does. It
    can be read when exposure and read-out have passed on the clock. A frame tells the exposure that it
    was recorded with, or else the one that was asked for.

    Args:
        settings: Which files, and what to do after the last frame.
        context: Name and clock.
    """

    def __init__(self, settings: FramesSettings, context: Context) -> None:
        super().__init__(context)
        self._settings = settings
        self._source: Source | None = None
        self._pictures: Generator[Picture] | None = None
        self._damage: BadFramesError | None = None
        self._shape: tuple[int, int] | None = None
        self._has_looked = False
        self._n_played = 0
        self._playing: Series | None = None
        self._armed_s = 0.0
        self._n_taken = 0
        self._coming: deque[tuple[float, ExposureResult]] = deque()

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, and the shape of the first frame if there is one.

        The first use before :meth:`open` looks at the files; what is wrong with them is told by that.
        """
        if not self._has_looked:
            self._has_looked = True
            with suppress(BadFramesError):
                self._look()
        readout_s, triggers = self._settings.readout, ("software", "internal")
        return CameraFacts(readout_s, MAX_EXPOSURE_S, self._shape, triggers=triggers)

    def describe(self) -> Mapping[str, Any]:
        """Settings, what they led to, and the size of the frames."""
        found = {} if self._source is None else self._source.describe()
        settings = self._settings.model_dump(mode="json")
        return {"model": "frames from files", **found, "frame_shape": self._shape, **settings}

    def _connect(self) -> None:
        """Find the files and read the first frame; the series begins with that.

        Raises:
            ConfigError: There is no such file, or something is wrong with one; says which and what.
        """
        try:
            self._source = self._look()
        except BadFramesError as error:
            raise ConfigError(
                Problem(error.what, f"{self._name}: {error.path}", expected=error.expected, hint=error.hint)
            ) from error
        self._has_looked = True
        self._n_played = 0

    def _disconnect(self) -> None:
        """Close the files; after the next :meth:`open` the first frame comes again."""
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
        """Frames not yet read are dropped; they are not played again."""
        self._coming.clear()
        self._playing = None

    def _expose(self, t_start_s: float) -> None:
        """Take the next frame.

        Raises:
            DeviceError: No frame is left, or the next one is damaged or of another size.
        """
        assert self._playing is not None
        picture = self._next()
        exposure_s = math.nan if picture.exposure_s is None else picture.exposure_s
        recorded_s = picture.t_start_s if self._settings.time_stamps == "recorded" else None
        told_s = t_start_s if recorded_s is None else recorded_s
        due_s = t_start_s + self._playing.exposure_s + self._settings.readout
        self._coming.append((due_s, ExposureResult(self._n_taken, picture.image, "", exposure_s, told_s)))
        self._n_taken += 1

    def _look(self) -> Source:
        """Find the frames and the size of the first one."""
        source = find_source(self._settings.path, self._settings.images)
        pictures = source.pictures()
        try:
            first = next(pictures, None)
        finally:
            pictures.close()
        if first is None:
            raise BadFramesError(self._settings.path, "holds no frames", "at least one")
        self._shape = _shape_of(first)
        return source

    def _next(self) -> Picture:
        if self._damage is not None:  # what comes behind it is not what comes next
            raise DeviceError(self._name, str(self._damage))
        try:
            picture = self._read_on()
        except BadFramesError as error:
            self._damage = error
            raise DeviceError(self._name, str(error)) from error
        if picture is None:
            text = f"all {self._n_played} frames of {self._settings.path} have been played"
            hint = "take fewer shots, or set `at_end: repeat`"
            raise DeviceError(self._name, f"{text}; {hint}")
        self._n_played += 1
        return picture

    def _read_on(self) -> Picture | None:
        """The next frame; None after the last.

        Raises:
            BadFramesError: It is damaged, or of another size than the first.
        """
        if self._pictures is None:
            self._pictures = self._started()
        picture = next(self._pictures, None)
        if picture is None and self._settings.at_end == "repeat":
            self._pictures = self._started()
            picture = next(self._pictures, None)
        if picture is not None and self._shape != _shape_of(picture):
            text = (
                f"the frame has {told(picture.image.shape)} pixels, the first one {told(self._shape or ())}"
            )
            raise BadFramesError(picture.place, text, hint="play them one size at a time")
        return picture

    def _started(self) -> Generator[Picture]:
        assert self._source is not None
        return self._source.pictures()


def _shape_of(picture: Picture) -> tuple[int, int]:
    height, width = picture.image.shape
    return height, width
