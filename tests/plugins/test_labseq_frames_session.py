"""Whole runs on frames of an earlier one: what is in the plugin's README and in the how-to."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import labseq

ROOT = Path(__file__).parents[2]
README = (ROOT / "plugins" / "labseq_frames" / "README.md").read_text()
LOOK, REPLAY = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
COMPACT = ROOT / "sequences" / "compact_225.yaml"
THRESHOLD = 1630.0


def run(sequence: Path, output: Path, **options: Any) -> labseq.Run:
    with labseq.Session.open(sequence, output=output, **options) as session:
        return session.run()


@pytest.fixture
def look(tmp_path: Path) -> Path:
    sequence = tmp_path / "look.yaml"
    sequence.write_text(LOOK)
    return sequence


def playing(folder: Path, path: Path, **camera: Any) -> str:
    """The README's profile, with other files in it; their path is relative to it."""
    profile = yaml.safe_load(REPLAY)
    profile["camera"] |= {"path": path.relative_to(folder).as_posix(), **camera}
    file = folder / "replay.yaml"
    file.write_text(yaml.safe_dump(profile))
    return str(file)


def occupancies(done: labseq.Run) -> list[Any]:
    return [shot.occupancies.tolist() for shot in done.shots]


def test_an_equal_detector_sees_on_recorded_frames_what_it_saw_then(tmp_path: Path, look: Path) -> None:
    earlier = run(look, tmp_path / "data", seed=1)
    profile = playing(tmp_path, earlier.path)
    again = run(look, tmp_path / "data", seed=2, profile=profile)
    assert [shot.frames.tobytes() for shot in again.shots] == [s.frames.tobytes() for s in earlier.shots]
    assert occupancies(again) == occupancies(earlier)
    assert again.record["devices"]["camera"]["run_id"] == earlier.record["run_id"]


def test_another_threshold_is_tried_on_the_same_frames(tmp_path: Path, look: Path) -> None:
    earlier = run(look, tmp_path / "data", seed=1)
    profile = playing(tmp_path, earlier.path)
    higher = [f"profile.detector.threshold={2 * THRESHOLD}"]
    stricter = run(look, tmp_path / "data", profile=profile, overrides=higher)
    before, after = np.array(occupancies(earlier)), np.array(occupancies(stricter))
    assert not np.any(after & ~before)  # a higher threshold only loses atoms
    assert 0 < after.sum() < before.sum()


def test_a_whole_experiment_is_planned_again_as_it_was(tmp_path: Path) -> None:
    earlier = run(COMPACT, tmp_path / "data", seed=3, shots=2)
    again = run(COMPACT, tmp_path / "data", seed=4, shots=2, profile=playing(tmp_path, earlier.path))
    assert occupancies(again) == occupancies(earlier)
    for one, other in zip(earlier.shots, again.shots, strict=True):
        assert [plan.moves.tolist() for plan in one.plans] == [plan.moves.tolist() for plan in other.plans]
        assert (one.success, one.filling_fraction) == (other.success, other.filling_fraction)


def test_first_images_alone_leave_the_loadings(tmp_path: Path, look: Path) -> None:
    earlier = run(COMPACT, tmp_path / "data", seed=3, shots=2)
    profile = playing(tmp_path, earlier.path, images="first")
    loadings = run(look, tmp_path / "data", shots=2, profile=profile)
    assert [shot[0] for shot in occupancies(loadings)] == [shot[0] for shot in occupancies(earlier)]


def test_a_run_ends_safely_when_the_frames_are_over(tmp_path: Path, look: Path) -> None:
    earlier = run(look, tmp_path / "data", seed=1, shots=2)
    profile = playing(tmp_path, earlier.path)
    with (
        labseq.Session.open(look, output=tmp_path / "more", profile=profile, shots=5) as session,
        pytest.raises(labseq.DeviceError, match="camera: all 2 frames") as caught,
    ):
        session.run()
    assert caught.value.exit_code == 3
    assert session.run_dir is not None
    kept = labseq.open_run(session.run_dir)
    assert (kept.status, len(kept.shots)) == ("failed", 2)
    repeated = run(look, tmp_path / "data", profile=playing(tmp_path, earlier.path, at_end="repeat"))
    assert occupancies(repeated) == [occupancies(earlier)[i % 2] for i in range(5)]


def test_frames_that_are_not_there_are_refused_at_the_start(tmp_path: Path, look: Path) -> None:
    profile = playing(tmp_path, tmp_path / "nowhere")
    with (
        labseq.Session.open(look, output=tmp_path / "data", profile=profile) as session,
        pytest.raises(labseq.ConfigError, match=r"camera: .*nowhere: no such file or folder") as caught,
    ):
        session.run()
    assert caught.value.exit_code == 2


def test_a_dry_run_plays_the_frames_too(tmp_path: Path, look: Path) -> None:
    earlier = run(look, tmp_path / "data", seed=1, shots=2)
    again = run(look, tmp_path / "data", profile=playing(tmp_path, earlier.path), shots=2, dry_run="full")
    assert occupancies(again) == occupancies(earlier)
