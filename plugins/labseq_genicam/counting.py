"""Numbers of frames, from what cameras call them."""

from __future__ import annotations

from typing import Final

LAST_ID: Final = 65535
"""GigE cameras count frames from 1 to this and go on with 1, unless they use 64 bits."""


class FrameCounter:
    """Counts the frames of an acquisition, those that never came too.

    The first frame that comes is number 0. A frame that came in part is taken for the next one: what
    it is called cannot be relied upon.

    Example:
        >>> counter = FrameCounter()
        >>> [counter.number(frame_id) for frame_id in (65533, 65534, None, 1, 3)]
        [0, 1, 2, 3, 5]
        >>> counter.n_frames
        6
    """

    def __init__(self) -> None:
        self.n_frames = 0
        self._last: tuple[int, int] | None = None

    def number(self, frame_id: int | None) -> int:
        """The number of the frame that came now, from 0.

        Args:
            frame_id: What the camera called it; None for one that came in part.
        """
        number = self.n_frames
        if frame_id is not None and self._last is not None:
            last_number, last_id = self._last
            n_steps = frame_id - last_id
            number = last_number + (n_steps if n_steps >= 0 else n_steps + LAST_ID)
        if frame_id is not None:
            self._last = number, frame_id
        self.n_frames = number + 1
        return number
