"""One shot for the pages: images, moves of each cycle, times and readings, and frames as 8-bit PNG."""

from __future__ import annotations

import io
import itertools
import math
import zlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.model import CycleRecord, ImageRecord, TargetPattern
from labseq.plain import to_plain
from labseq.recording.shot_file import iter_frames
from labseq.web.runs import text_of
from labseq.web.series import finite

_RANGE: Final = (0.01, 0.998)
"""Fractions of the pixels that are drawn below black and below white."""


def shot_values(shot: Shot, record_frames: str) -> dict[str, Any]:
    """A shot as JSON-ready values.

    Args:
        record_frames: Which frames the run keeps: "all", "last" or "none".

    Raises:
        RecordingError: The shot's file is missing or damaged.
    """
    images, target = shot.images, shot.target
    recorded = {"all": range(len(images)), "last": range(len(images))[-1:]}.get(record_frames, range(0))
    return {
        "shot": shot.index,
        "attempt": shot.attempt,
        "status": shot.status,
        "error": text_of(shot.row.error),
        "t_start_utc": text_of(shot.row.t_start_utc, 40),
        "filling": finite(shot.filling_fraction),
        "success": shot.row.success,
        "seen_defect_free_cycle": shot.seen_defect_free_cycle,
        "images": [_image(image, target, has_frame=i in recorded) for i, image in enumerate(images)],
        "cycles": [_cycle(cycle) for cycle in shot.cycles],
        "stages": [
            {
                "stage": text_of(stage.stage, 80),
                "step": stage.step,
                "cycle": stage.cycle,
                "t_start_s": finite(stage.t_start_s),
                "duration_s": finite(stage.duration_s),
                "host_s": finite(stage.host_s),
                "budget_s": finite(stage.budget_s),
                "over": bool(stage.over_budget),
            }
            for stage in shot.timing
        ],
        "sites_px": None if shot.sites_px is None else np.round(shot.sites_px, 1).tolist(),
        "readings": readings_of(shot.row.readings),
        "parameters": readings_of(shot.row.parameters),
        "calibrations": readings_of(shot.row.calibrations),
        "file": text_of(shot.row.file, 200),
        "bytes": shot.row.bytes,
    }


def readings_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Single values by name. Texts have limited length."""
    plain: dict[str, Any] = to_plain(values)
    return {
        text_of(name, 120): text_of(value, 200) if isinstance(value, str | list | dict) else value
        for name, value in list(plain.items())[:200]
    }


def _image(image: ImageRecord, target: TargetPattern, *, has_frame: bool) -> dict[str, Any]:
    return {
        "name": text_of(image.name, 80),
        "step": image.step,
        "cycle": image.cycle,
        "t_start_s": finite(image.t_start_s),
        "exposure_s": finite(image.exposure_s),
        "n_atoms": int(np.count_nonzero(image.occupancy)),
        "n_defects": target.n_defects(image.occupancy),
        "n_surplus": target.n_surplus(image.occupancy),
        "occupancy": rows_of(image.occupancy),
        "has_frame": has_frame,
    }


def rows_of(sites: NDArray[np.bool_]) -> list[str]:
    """Sites as a text of 0 and 1 per row."""
    return ["".join("1" if site else "0" for site in row) for row in sites.tolist()]


def _cycle(cycle: CycleRecord) -> dict[str, Any]:
    offsets, moves = cycle.plan.batch_offsets.tolist(), cycle.plan.moves.tolist()
    return {
        "step": cycle.step,
        "cycle": cycle.cycle,
        "t_start_s": finite(cycle.t_start_s),
        "window_s": finite(cycle.window_s),
        "moves_s": finite(cycle.moves_s),
        "late_s": finite(cycle.late_s),
        "n_batches": cycle.plan.n_batches,
        "n_batches_played": cycle.n_batches_played,
        "batches": [moves[first:end] for first, end in itertools.pairwise(offsets)],
    }


def frame_png(shot: Shot, image: int, width: int) -> tuple[bytes, int]:
    """The frame of an image as a grey 8-bit PNG, and the integer factor by which it is reduced.

    Args:
        width: Maximum height and width in pixels, at most 1024.

    Raises:
        RecordingError: The file is damaged, or has no such frame.
    """
    return _cached_png(shot.file, shot.row.sha256, image, min(width, 1024))


@lru_cache(maxsize=8)
def _cached_png(path: Path, _sha256: str, image: int, width: int) -> tuple[bytes, int]:
    for _, frame in iter_frames(path, image):
        factor = max(1, math.ceil(max(frame.image.shape) / max(1, width)))
        return encode_png(reduced(frame.image, factor)), factor
    raise RecordingError(path, f"has no frame of image {image}", "see 'record_frames' of the sequence")


def reduced(frame: NDArray[np.uint16], factor: int) -> NDArray[np.uint8]:
    """Convert a frame to 8 bit, with its darkest pixels black and its brightest white.

    Args:
        frame: uint16 (height, width).
        factor: Height and width of the squares of pixels that become one pixel.
    """
    height, length = (n - n % factor for n in frame.shape)
    if factor > 1 and height and length:
        blocks = frame[:height, :length].reshape(height // factor, factor, length // factor, factor)
        small: NDArray[np.float64] = blocks.mean(axis=(1, 3))
    else:
        small = frame.astype(np.float64)
    if not small.size:
        return np.zeros((1, 1), np.uint8)
    sample = np.sort(small.ravel()[:: max(1, small.size // 20_000)])
    low, high = (sample[round(share * (len(sample) - 1))] for share in _RANGE)
    return np.clip((small - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)


def encode_png(grey: NDArray[np.uint8]) -> bytes:
    """A grey PNG of uint8 (height, width)."""
    file = io.BytesIO()
    # frames are mostly noise, so better compression takes twice the time and saves nothing
    Image.fromarray(grey).save(file, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return file.getvalue()
