"""The camera that plays back frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Mapping
from contextlib import suppress
from typing import Any, Final

from labseq import (
    CameraFacts,
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    Frame,
    LimitError,
    Trigger,
)
from labseq.errors import Problem
from labseq.units import format_quantity
from labseq_frames.picture import BadFramesError, Picture, told
from labseq_frames.settings import FramesSettings
from labseq_frames.sources import Source, find_source

MAX_EXPOSURE_S: Final = 3600.0
"""Longest exposure that may be asked for, in seconds: none makes a difference to what is in a file."""


class FramesCamera:
    """Frames from files, with a real camera's manners.

    Each trigger takes the next frame, whatever the exposure; it can be read when exposure and
    read-out have passed on the clock. A frame tells the exposure that it was recorded with,
    or else the one that was asked for.

    Args:
        settings: Which files, and what to do after the last frame.
        context: Name and clock.
    """

    def __init__(self, settings: FramesSettings, context: Context) -> None:
        self._name = context.name or "camera"
        self._clock = context.clock
        self._settings = settings
        self._source: Source | None = None
        self._pictures: Generator[Picture] | None = None
        self._damage: BadFramesError | None = None
        self._shape: tuple[int, int] | None = None
        self._has_looked = False
        self._n_played = 0
        self._exposure_s = 0.0
        self._n_triggers_left = 0
        self._exposing_until_s = 0.0
        self._frames: deque[tuple[float, Frame]] = deque()

    @property
    def facts(self) -> CameraFacts:
        """Read-out time, longest exposure, and the shape of the first frame if there is one.

        The first use before :meth:`open` looks at the files; what is wrong with them is told by that.
        """
        if not self._has_looked:
            self._has_looked = True
            with suppress(BadFramesError):
                self._look()
        return CameraFacts(self._settings.readout, MAX_EXPOSURE_S, self._shape)

    def open(self) -> None:
        """Find the files and read the first frame; the series begins with that.

        Raises:
            ConfigError: There is no such file, or something is wrong with one; says which and what.
        """
        if self._source is not None:
            return
        try:
            self._source = self._look()
        except BadFramesError as error:
            raise ConfigError(
                Problem(error.what, f"{self._name}: {error.path}", expected=error.expected, hint=error.hint)
            ) from error
        self._has_looked = True
        self._n_played = 0

    def close(self) -> None:
        """Close the files; legal in any state. After the next :meth:`open` the first frame comes again."""
        self.safe_state()
        self._rewind()
        self._source = None

    def safe_state(self) -> None:
        """Stop exposing and drop the frames not yet read; they are not played again."""
        self._frames.clear()
        self._n_triggers_left = 0
        self._exposing_until_s = 0.0

    def describe(self) -> Mapping[str, Any]:
        """Settings, what they led to, and the size of the frames."""
        found = {} if self._source is None else self._source.describe()
        settings = self._settings.model_dump(mode="json")
        return {"model": "frames from files", **found, "frame_shape": self._shape, **settings}

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of exposures; frames not yet read are dropped.

        Raises:
            LimitError: No frames, or an exposure that no camera makes.
            DeviceError: Not open, or a trigger that needs a wire.
        """
        self._check_open()
        if n_frames < 1:
            raise LimitError(f"{self._name}: number of frames", n_frames, "at least 1")
        if not 0 < exposure_s <= MAX_EXPOSURE_S:
            limit = f"more than 0 and at most {format_quantity(MAX_EXPOSURE_S, 'time')}"
            came = format_quantity(exposure_s, "time")
            raise LimitError(f"{self._name}: exposure", came, limit, "choose another exposure")
        if trigger != "software":
            text = f"frames from files have no wire for the {trigger} trigger; expected 'software'"
            raise DeviceError(self._name, text)
        self._frames.clear()
        self._exposure_s = exposure_s
        self._n_triggers_left = n_frames

    def trigger(self) -> None:
        """Take the next frame; its exposure begins now.

        Raises:
            DeviceError: Not armed, all exposures made, still exposing; no frame is left, or the
                next one is damaged or of another size.
        """
        self._check_open()
        now_s = self._clock.now()
        if self._n_triggers_left == 0:
            raise DeviceError(self._name, "triggered, but not armed for another frame; call arm() first")
        if now_s < self._exposing_until_s:
            text = f"triggered during an exposure that ends at {self._exposing_until_s:.6f} s"
            raise DeviceError(self._name, text)
        picture = self._next()
        self._n_triggers_left -= 1
        self._exposing_until_s = now_s + self._exposure_s
        exposure_s = self._exposure_s if picture.exposure_s is None else picture.exposure_s
        recorded_s = picture.t_start_s if self._settings.time_stamps == "recorded" else None
        t_start_s = now_s if recorded_s is None else recorded_s
        frame = Frame(picture.image, exposure_s, t_start_s, self._name)
        self._frames.append((self._exposing_until_s + self._settings.readout, frame))

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
        """
        self._check_open()
        missing_s = self._frames[0][0] - self._clock.now() if self._frames else float("inf")
        if missing_s > timeout_s:
            self._clock.sleep(timeout_s)
            reason = "is not ready" if self._frames else "was not triggered"
            text = f"no frame within {format_quantity(timeout_s, 'time')}: the next one {reason}"
            raise DeviceTimeoutError(self._name, text, timeout_s)
        self._clock.sleep(max(0.0, missing_s))
        return self._frames.popleft()[1]

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
            hint = "take fewer shots, or set `when_over: repeat`"
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
        if picture is None and self._settings.when_over == "repeat":
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

    def _rewind(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._pictures = self._damage = None

    def _check_open(self) -> None:
        if self._source is None:
            raise DeviceError(self._name, "not open; call open() first")


def _shape_of(picture: Picture) -> tuple[int, int]:
    height, width = picture.image.shape
    return height, width
