"""Profiles with the Spectrum driver, as a run meets them: what is right plays, what is wrong is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from labseq_spcm.simulator import vendor_library_found

import labseq
from labseq.errors import LabseqError

PROFILE = """labseq: 1
name: bench
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: MOBILE
detector: {use: threshold, frame: [128, 128], centre_px: [63.5, 63.5], pixel_size: 0.35 um}
simulation: {use: virtual, image: {frame: [128, 128], centre_px: [63.5, 63.5]}}
"""
SEQUENCE = """labseq: 1
name: small
profile: p.yaml
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca, degree_of_parallelism: 2}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms}
  - image: {exposure: 45 ms}
"""


def run(folder: Path, mobile: str) -> labseq.Run:
    (folder / "p.yaml").write_text(PROFILE.replace("MOBILE", mobile), encoding="utf-8")
    (folder / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    with labseq.Session.open(folder / "s.yaml", shots=1, seed=1, output=folder / "runs") as session:
        return session.run()


@pytest.mark.parametrize(
    "mobile",
    [
        "{use: spcm, card: simulated, sample_rate: 250 MHz}",
        "{use: spcm, card: simulated, mode: fifo, sample_rate: 250 MHz}",
        "{use: spcm, card: simulated, mode: dds, max_row_tones: 16, max_column_tones: 5}",
    ],
)
def test_a_simulated_card_plays_in_virtual_time(tmp_path: Path, mobile: str) -> None:
    done = run(tmp_path, mobile)
    assert (done.status, done.simulated, len(done.shots)) == ("complete", True, 1)


@pytest.mark.parametrize(
    ("mobile", "exit_code", "text"),
    [
        ("card: simulated, serial: 99", 3, "has the serial number 12345; expected 99: name another one"),
        ("card: simulated, sample_rate: 755 MHz", 2, "p.yaml:6:60: sample_rate: the card's clock has a gap"),
        ("card: simulated, sample_rate: 150 MHz", 2, "sample_rate is 150 MHz; the limit is above 236 MHz"),
        ("card: simulated, sample_rate: .nan", 2, "p.yaml:6:60: sample_rate is .nan; expected a finite"),
        ("card: simulated, mode: fifo, sample_rate: 1 GHz", 2, "the bus carries at most 700 MHz"),
        ("card: simulated, mode: dds", 2, "set max_row_tones and max_column_tones to at most 16 and 5"),
        ("card: simulated, rf: {full_scale: 3 V}", 2, "rf.full_scale is 3 V; the limit is the card's 80 mV"),
        ("card: simulated, rf: {full_scale: 450 mV}", 2, "the card's output relay may switch, for 10 ms"),
        ("card: simulated, row_channel: 1", 2, "row_channel and column_channel are both 1; expected 0 and 1"),
        pytest.param(
            *("card: /dev/spcm0", 3, "the Python package 'spcm' finds no driver library"),
            marks=pytest.mark.skipif(vendor_library_found(), reason="the vendor's library is installed here"),
        ),
    ],
)
def test_mistakes_are_told_with_what_is_expected(
    tmp_path: Path, mobile: str, exit_code: int, text: str
) -> None:
    with pytest.raises(LabseqError) as told:
        run(tmp_path, f"{{use: spcm, {mobile}}}")
    assert text in str(told.value)
    assert told.value.exit_code == exit_code
