"""The samples of a waveform as an NPZ file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from labseq.bench.waveform import PlannedWaveform
from labseq.errors import ConfigError, Problem
from labseq.files import whole_file
from labseq.messages import visible
from labseq.model import SegmentKind
from labseq.motion.rendering import FULL_SCALE, N_CHANNELS
from labseq.text_files import check_output

SUFFIX: Final = ".npz"
FILE_CHUNK: Final = 1 << 20
"""Number of samples that are rendered and written together."""


def check_samples_file(path: Path) -> None:
    """Check name and folder of a file of samples before anything is planned.

    Raises:
        ConfigError: It has another ending than .npz, its folder does not exist, or the path
            is not an ordinary file.
    """
    check_output(path, "an NPZ file", SUFFIX)


def save_samples(path: Path, waveform: PlannedWaveform) -> None:
    """Write the samples to a file, which appears only when it is complete.

    ``numpy.load`` then gives ``samples``, int16 (2, n), channel 0 for the row axis, and, counted
    in samples, where its batches and segments start; see :func:`arrays_of`. The samples are
    rendered and written piece by piece. Nothing is compressed: samples hardly can be.

    Args:
        path: The file; an older one of that name is replaced.
        waveform: The waveform.

    Raises:
        ConfigError: It cannot be written, for example to a full disk; or :func:`check_samples_file`
            refuses it.
    """
    check_samples_file(path)
    try:
        with whole_file(path) as file:
            _write(file, waveform)
    except OSError as error:
        what = f"the samples cannot be written: {error.strerror or error}"
        expected = f"{waveform.n_bytes / 1e6:.1f} MB of room and the right to write there"
        raise ConfigError(Problem(what, visible(str(path)), expected=expected)) from error


def arrays_of(waveform: PlannedWaveform) -> dict[str, NDArray[Any]]:
    """Everything except the samples; indices of batches count from 0.

    Returns:
        Name -> array: ``sample_rate_hz``; ``volts_per_sample``, float64 (2,), volts across 50 Ohm of
        a sample of 1; ``batch``, int32 (n_batches,), the batches; ``batch_start``, int64, first
        sample of each that has tones; ``segment_batch``, ``segment_kind`` (0 pause, 1 pick-up,
        2 transport, 3 drop-off) and ``segment_start`` of each segment.
    """
    program, segments, batches = waveform.program, waveform.segments, waveform.batches
    part = slice(segments.start, segments.stop)
    kind, batch = program.kind[part], program.batch[part]
    start = waveform.renderer.first_sample[part] - waveform.samples.start
    on = np.flatnonzero(kind != SegmentKind.IDLE)
    volts = waveform.moves.motion.rf.full_scale_v / FULL_SCALE
    return {
        "sample_rate_hz": np.array(waveform.renderer.sample_rate_hz),
        "volts_per_sample": np.full(N_CHANNELS, volts),
        "batch": np.array(batches, np.int32),
        "batch_start": start[on[np.searchsorted(batch[on], batches)]],
        "segment_batch": batch,
        "segment_kind": kind,
        "segment_start": start,
    }


def _write(file: IO[bytes], waveform: PlannedWaveform) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, values in arrays_of(waveform).items():
            with archive.open(f"{name}.npy", "w") as member:
                npy.write_array(member, values, allow_pickle=False)
        with archive.open("samples.npy", "w", force_zip64=True) as member:
            _write_samples(member, waveform)


def _write_samples(member: IO[bytes], waveform: PlannedWaveform) -> None:
    samples = waveform.samples
    shape = N_CHANNELS, len(samples)
    npy.write_array_header_1_0(member, {"descr": "<i2", "fortran_order": False, "shape": shape})
    out = np.empty(FILE_CHUNK, np.int16)
    for channel in range(N_CHANNELS):
        for start in range(samples.start, samples.stop, FILE_CHUNK):
            piece = out[: min(FILE_CHUNK, samples.stop - start)]
            waveform.renderer.write(channel, start, piece)
            member.write(piece.astype("<i2", copy=False).data)
