"""Averages over the shots of a run at one image: frames, occupancies and detector signals."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.data.shot import Shot
from labseq.errors import RecordingError

Floats = NDArray[np.float64]


def average_frame(shots: Sequence[Shot], image: int = 0) -> tuple[Floats, int]:
    """The mean of the frames of an image, float64 (height, width) in adu, and the number of frames.

    Args:
        shots: Shots without this frame, or with another frame size than the first, are left out.
        image: Index of the image in the shot. -1 for the last.

    Raises:
        RecordingError: No shot has the frame because frames were not kept, or files are damaged.
    """
    total, n = np.empty(0), 0
    for entry, index in _entries(shots, image):
        for camera in entry["camera"].values() if "camera" in entry else ():
            (at,) = np.nonzero(camera["image"][()] == index)
            if len(at) and (not n or camera["frames"].shape[1:] == total.shape):
                frame = camera["frames"][at[0]].astype(np.float64)
                total, n = (total + frame if n else frame), n + 1
    if not n:
        raise _missing_error(shots, "frame", image)
    return total / n, n


def loading_map(shots: Sequence[Shot], image: int = 0) -> tuple[Floats, int]:
    """The fraction of the shots with an atom on each site, float64 (n_rows, n_cols), and their number.

    Args:
        shots: Shots without this image are left out.
        image: Index of the image in the shot. -1 for the last.

    Raises:
        RecordingError: No shot has the image, or files are damaged.
    """
    occupancies = [entry["detection/occupancy"][index] for entry, index in _entries(shots, image)]
    if not occupancies:
        raise _missing_error(shots, "image", image)
    return np.asarray(np.mean(occupancies, axis=0), np.float64), len(occupancies)


def signals_of(shots: Sequence[Shot], image: int = 0) -> tuple[Floats, Floats, str]:
    """The detector's signals and thresholds, each float64 (n_shots, n_rows, n_cols), and their unit.

    Args:
        shots: Shots without this image, or without signals from the detector, are left out.
        image: Index of the image in the shot. -1 for the last.

    Raises:
        RecordingError: No shot has signals, or files are damaged.
    """
    from labseq.recording.read_hdf5 import read_attribute  # h5py takes 0.1 s to import

    signals, thresholds, unit = list[Any](), list[Any](), ""
    for entry, index in _entries(shots, image):
        detection = entry["detection"]
        if "signal" in detection and "threshold" in detection:
            signals.append(detection["signal"][index])
            thresholds.append(detection["threshold"][()])
            unit = str(read_attribute(detection["signal"], "units"))
    if not signals:
        raise _missing_error(shots, "signal of the detector", image)
    return np.array(signals), np.array(thresholds), unit


def _entries(shots: Sequence[Shot], image: int) -> Generator[tuple[Any, int]]:
    """The group ``/entry`` of each shot that has the image, with the image's index."""
    from labseq.recording.shot_file import opened  # h5py takes 0.1 s to import

    for shot in shots:
        # an average over many shots is still good without the damaged ones
        with suppress(RecordingError), opened(shot.file) as entry:
            n_images = len(entry["detection/occupancy"])
            if -n_images <= image < n_images:
                yield entry, image % n_images


def _missing_error(shots: Sequence[Shot], kind: str, image: int) -> RecordingError:
    run_dir = shots[0].file.parent.parent if shots else "the run"
    return RecordingError(run_dir, f"has no {kind} of image {image} in its shots")
