from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

import labseq
from labseq.assembly.planning import PlanRequest
from labseq.errors import ConfigError
from labseq.plans.waveform import (
    PlannedWaveform,
    WaveformRequest,
    check_samples_file,
    plan_waveform,
    save_samples,
)

REQUEST = PlanRequest("random:6x6@0.7", "{pattern: checkerboard, rows: 4, cols: 4}", seed=3)


@pytest.fixture(scope="module")
def made() -> PlannedWaveform:
    return plan_waveform(WaveformRequest(REQUEST, "1-2", "250 MHz"))


def test_numpy_reads_what_the_awg_would_play(made: PlannedWaveform, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(b"an older one")
    save_samples(path, made)
    whole = labseq.render(made.program, 250e6).samples
    with np.load(path, allow_pickle=False) as file:
        samples, batch_start = file["samples"], file["batch_start"]
        assert samples.dtype == np.int16
        assert np.array_equal(samples, whole[:, made.samples.start : made.samples.stop])
        assert file["sample_rate_hz"] == 250e6
        assert file["volts_per_sample"].tolist() == pytest.approx([1.6 / 32767] * 2)
        assert file["batch"].tolist() == [1, 2]
        assert set(file["segment_batch"].tolist()) == {1, 2}
        kind, start, batch = file["segment_kind"], file["segment_start"], file["segment_batch"]
    assert start[0] == 0
    assert batch_start.tolist() == start[np.flatnonzero(np.diff(batch, prepend=0))].tolist()
    pauses = [(a, b) for a, b, k in zip(start, start[1:], kind, strict=False) if k == 0]
    assert not any(samples[:, a:b].any() for a, b in pauses)
    assert all(samples[:, a : a + 100].any(axis=1).any() for a in batch_start)
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.npy", "a.npy: this is not the name of an NPZ file; expected a file that ends in .npz"),
        ("gone/a.npz", "gone: there is no such folder; expected an existing folder"),
        ("folder.npz", "folder.npz: this is a folder"),
        ("device.npz", "device.npz: this is not an ordinary file"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "device.npz").symlink_to("/dev/null")
    with pytest.raises(ConfigError) as caught:
        check_samples_file(tmp_path / name)
    assert message in str(caught.value)


def test_a_full_disk_leaves_the_old_file_and_no_half_one(
    made: PlannedWaveform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "a.npz").write_bytes(b"an older one")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match=r"a\.npz: the samples cannot be written: No space left on device"):
        save_samples(tmp_path / "a.npz", made)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"an older one"]
