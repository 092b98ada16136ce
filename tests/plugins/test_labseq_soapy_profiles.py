"""Profiles with a radio, as a run meets them: what is right plays, what is wrong is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from labseq_soapy import labseq_register
from labseq_soapy_sim import build

import labseq
from labseq.errors import LabseqError
from labseq.registry import Registry

from .labseq_soapy_rig import need_radio

PROFILE = """labseq: 1
name: bench
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: STATIC
mobile_tweezers: {use: virtual}
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
SIMULATED = "{use: soapy, device: simulated, sample_rate: 12.5 MHz, row_gain: 3, column_gain: 3}"


def run(folder: Path, static: str) -> labseq.Run:
    folder.mkdir(exist_ok=True)
    (folder / "p.yaml").write_text(PROFILE.replace("STATIC", static), encoding="utf-8")
    (folder / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    with labseq.Session.open(folder / "s.yaml", shots=2, seed=1, output=folder / "runs") as session:
        return session.run()


def test_a_simulated_radio_gives_the_same_atoms_as_the_virtual_tweezers(tmp_path: Path) -> None:
    need_radio()
    played, told = run(tmp_path / "radio", SIMULATED), run(tmp_path / "virtual", "{use: virtual}")
    assert (played.status, played.simulated, len(played.shots)) == ("complete", True, 2)
    for one, other in zip(played.shots, told.shots, strict=True):
        assert np.array_equal(one.occupancies, other.occupancies)


@pytest.mark.parametrize(
    ("static", "exit_code", "text"),
    [
        (
            "{use: soapy, device: simulated, sample_rate: 8 MHz}",
            2,
            "p.yaml:5:18: static_tweezers: row tones: the outermost tone is 3.6 MHz",
        ),
        ("{use: soapy, row_channel: 1}", 2, "row_channel and column_channel are both 1"),
        ("{use: soapy, max_depth: 0.5}", 2, "p.yaml:5:42: max_depth is 0.5; expected at least 1"),
        (
            "{use: soapy, device: 'simulated,sped=1'}",
            2,
            "p.yaml:5:39: the simulated radio has no argument 'sped'; expected one of",
        ),
        (
            "{use: soapy, device: 'simulated, speed=0'}",
            2,
            "p.yaml:5:39: speed of the simulated radio is '0'; expected a number, at least 0.0001",
        ),
        (
            "{use: soapy, device: 'simulated,fault=fire'}",
            2,
            "fault of the simulated radio is 'fire'; expected",
        ),
        ("{use: soapy, device: 'simulated,record=many'}", 2, "record of the simulated radio is 'many'"),
        ("{use: soapy, device: 'driver=none'}", 3, "'driver=none' cannot be opened"),
    ],
)
def test_mistakes_are_reported_with_their_place(
    tmp_path: Path, static: str, exit_code: int, text: str
) -> None:
    need_radio()
    with pytest.raises(LabseqError) as caught:
        run(tmp_path, static)
    assert caught.value.exit_code == exit_code
    assert text in str(caught.value)


def test_where_it_cannot_be_compiled_a_dry_run_takes_the_virtual_tweezers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(build, "_INCLUDES", ())
    registry = Registry()
    labseq_register(registry)
    assert registry.get("static_tweezers", "soapy").simulated is None
