from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import labseq
from labseq.bench.waveform import (
    PlannedWaveform,
    WaveformRequest,
    check_samples_file,
    plan_waveform,
    save_samples,
)
from labseq.errors import ConfigError
from labseq.session.planning import PlanRequest

REQUEST = PlanRequest("random:6x6@0.7", "checkerboard:4x4", seed=3)


@pytest.fixture(scope="module")
def made() -> PlannedWaveform:
    return plan_waveform(WaveformRequest(REQUEST, "2-3", "250 MHz"))


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
        kind, start = file["segment_kind"], file["segment_start"]
    assert start[0] == 0
    assert batch_start.tolist() == start[kind == 1].tolist()
    pauses = [(a, b) for a, b, k in zip(start, start[1:], kind, strict=False) if k == 0]
    assert not any(samples[:, a:b].any() for a, b in pauses)
    assert all(samples[:, a : a + 100].any(axis=1).any() for a in batch_start)
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.npy", "a.npy: this is no name of an NPZ file; expected a file that ends in .npz"),
        ("a", "this is no name of an NPZ file"),
        ("gone/a.npz", "gone: there is no such folder; expected one that exists"),
        ("folder.npz", "folder.npz: this is a folder"),
        ("device.npz", "device.npz: this is not an ordinary file"),
    ],
)
def test_a_file_that_makes_no_sense_is_told_before(
    made: PlannedWaveform, tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "device.npz").symlink_to("/dev/null")
    for refuse in (check_samples_file, lambda path: save_samples(path, made)):
        with pytest.raises(ConfigError) as caught:
            refuse(tmp_path / name)
        assert words in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"folder.npz", "device.npz"}


FULL = r"""
import resource, sys
from pathlib import Path
from labseq.errors import ConfigError
from labseq.session.planning import PlanRequest
from labseq.bench.waveform import WaveformRequest, plan_waveform
from labseq.bench.waveform import save_samples

request = PlanRequest("random:6x6@0.7", "checkerboard:4x4", seed=3)
made = plan_waveform(WaveformRequest(request, "2-3", "250 MHz"))
for n_bytes in (0, 1000, 100_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, resource.RLIM_INFINITY))
    try:
        save_samples(Path("a.npz"), made)
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
    sys.stderr.write(f"{[path.name for path in Path().iterdir()]}\n")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_a_full_disk_leaves_the_old_file_and_no_half_one(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"an older one")
    command = [sys.executable, "-c", FULL]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    told = "a.npz: the samples cannot be written: File too large; expected "
    lines = done.stderr.splitlines()
    assert [line.startswith(told) for line in lines[::2]] == [True] * 3
    assert lines[1::2] == ["['a.npz']"] * 3
    assert (tmp_path / "a.npz").read_bytes() == b"an older one"
