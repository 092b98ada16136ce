"""Whole runs on frames of an earlier one: what is on the page about the camera `frames`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import labseq

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how-to" / "replay-frames.md").read_text()
LOOK, REPLAY = re.findall(r"<!-- file: \S+ -->\n```yaml\n(.*?)```", PAGE, re.DOTALL)
COMPACT = ROOT / "sequences" / "compact_225.yaml"
THRESHOLD = 1630.0


class Lab:
    """A folder with the page's sequence, and runs in it whose frames are played again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.look = folder / "look.yaml"
        self.look.write_text(LOOK)
        self.looked = self.run(self.look, seed=1, shots=3)
        self.rearranged = self.run(COMPACT, seed=3, shots=2)

    def run(self, sequence: Path, **options: Any) -> labseq.Run:
        with labseq.Session.open(sequence, output=self.folder / "data", **options) as session:
            return session.run()

    def playing(self, path: Path, **camera: Any) -> str:
        """The page's profile, with other files in it; their path is relative to it."""
        profile = yaml.safe_load(REPLAY)
        profile["camera"] |= {"path": path.relative_to(self.folder).as_posix(), **camera}
        file = self.folder / "replay.yaml"
        file.write_text(yaml.safe_dump(profile))
        return str(file)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("frames"))


def occupancies(done: labseq.Run) -> list[Any]:
    return [shot.occupancies.tolist() for shot in done.shots]


def test_an_equal_detector_sees_on_recorded_frames_what_it_saw_then(lab: Lab) -> None:
    """Also in a dry run."""
    earlier, profile = lab.looked, lab.playing(lab.looked.path)
    again = lab.run(lab.look, seed=2, shots=3, profile=profile, dry_run="full")
    assert [shot.frames.tobytes() for shot in again.shots] == [s.frames.tobytes() for s in earlier.shots]
    assert occupancies(again) == occupancies(earlier)
    assert again.record["devices"]["camera"]["run_id"] == earlier.record["run_id"]
    higher = [f"profile.detector.threshold={2 * THRESHOLD}"]
    stricter = lab.run(lab.look, shots=3, profile=profile, overrides=higher)
    before, after = np.array(occupancies(earlier)), np.array(occupancies(stricter))
    assert not np.any(after & ~before)  # a higher threshold only loses atoms
    assert 0 < after.sum() < before.sum()


def test_a_whole_experiment_is_planned_again_as_it_was(lab: Lab) -> None:
    earlier = lab.rearranged
    # the planner compares plans by their time, too, which the overhead of the profile `virtual` is part of
    same = ["profile.mobile_tweezers.overhead_per_batch=0.5 ms"]
    again = lab.run(COMPACT, seed=4, shots=2, profile=lab.playing(earlier.path), overrides=same)
    assert occupancies(again) == occupancies(earlier)
    for one, other in zip(earlier.shots, again.shots, strict=True):
        assert [plan.moves.tolist() for plan in one.plans] == [plan.moves.tolist() for plan in other.plans]
        assert (one.success, one.filling_fraction) == (other.success, other.filling_fraction)
    loadings = lab.run(lab.look, shots=2, profile=lab.playing(earlier.path, images="first"))
    assert [shot[0] for shot in occupancies(loadings)] == [shot[0] for shot in occupancies(earlier)]


def test_a_run_ends_safely_when_the_frames_are_over(lab: Lab, tmp_path: Path) -> None:
    profile = lab.playing(lab.looked.path)
    with (
        labseq.Session.open(lab.look, output=tmp_path, profile=profile, shots=5) as session,
        pytest.raises(labseq.DeviceError, match="camera: all 3 frames") as caught,
    ):
        session.run()
    assert caught.value.exit_code == 3
    assert session.run_dir is not None
    kept = labseq.open_run(session.run_dir)
    assert (kept.status, len(kept.shots)) == ("failed", 3)
    profile = lab.playing(lab.looked.path, at_end="repeat")
    repeated = lab.run(lab.look, profile=profile, shots=5)
    assert occupancies(repeated) == [occupancies(lab.looked)[i % 3] for i in range(5)]
