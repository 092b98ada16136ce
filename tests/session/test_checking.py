"""What is known of a run before anything is opened."""

from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.session.check import N_LOADINGS, CheckReport, check

ROOT = Path(__file__).parents[2]
COMPACT = ROOT / "sequences" / "compact_225.yaml"


def checked(*overrides: str, **options: Any) -> CheckReport:
    return check(labseq.Session.open(COMPACT, overrides=overrides, **options))


def test_a_good_sequence_has_no_warnings():
    report = checked()
    assert report.warnings == ()
    assert report.rehearsal is not None
    assert (report.rehearsal.n_loadings, report.rehearsal.n_filled) == (N_LOADINGS, N_LOADINGS)
    assert 0.02 < report.rehearsal.duration_s.mean() < 0.06
    assert report.n_images == 12
    assert report.shot_bytes == pytest.approx(12 * 2 * 512 * 512, rel=0.02)


def test_durations_span_from_no_cycle_to_all():
    report = checked("profile.camera.readout=0 s")
    assert report.shortest_shot_s == pytest.approx(0.5 + 2 * 0.045)
    assert report.longest_shot_s == pytest.approx(0.5 + 2 * 0.045 + 10 * (0.06 + 0.045))
    always = checked("profile.camera.readout=0 s", "shot.2.rearrange.stop_when=never")
    assert always.shortest_shot_s == pytest.approx(0.5 + 2 * 0.045 + 10 * 0.045)


def test_a_run_takes_no_longer_and_no_less_than_said(tmp_path: Path):
    report = checked()
    with labseq.Session.open(COMPACT, shots=5, seed=3, output=tmp_path) as session:
        run = session.run()
    for shot in run.shots:
        end_s = max(t.t_start_s + t.duration_s for t in shot.timing)
        assert report.shortest_shot_s - 1e-9 <= end_s <= report.longest_shot_s + 1e-9
        assert report.shot_bytes is not None
        assert shot.file.stat().st_size <= report.shot_bytes * 1.02


def test_a_window_that_most_plans_do_not_fit():
    (warning,) = checked("shot.2.rearrange.window=30 ms").warnings
    assert "too short for most plans" in warning.what
    assert warning.source.startswith("--set shot.2.rearrange.window")


def test_a_later_window_that_is_over_before_the_first_batch():
    (warning,) = checked("shot.2.rearrange={cycles: 2, window: [60 ms, 10 ms]}").warnings
    assert "a window of 10 ms is over before the first batch is" in warning.what


def test_warnings_have_their_place_in_the_file(tmp_path: Path):
    text = COMPACT.read_text(encoding="utf-8").replace("window: 60 ms", "window: 20 ms")
    path = tmp_path / "short.yaml"
    path.write_text(text, encoding="utf-8")
    (warning,) = check(labseq.Session.open(path)).warnings
    line = text.splitlines()[warning.line - 1]
    assert line[warning.column - 1 :].startswith("20 ms")


def test_an_exposure_that_the_camera_cannot_make():
    (warning,) = checked("shot.1.image.exposure=11 s").warnings
    assert str(warning).endswith("an exposure of 11 s is more than the camera can do; expected at most 10 s")


def test_a_target_that_most_loadings_cannot_fill():
    (warning,) = checked("profile.simulation.loading=0.5").warnings
    assert "loadings allow to fill the target" in warning.what


def test_a_dry_run_tells_what_was_not_checked():
    report = checked("profile.camera={use: cannon}", dry_run="full")
    assert any("settings were not checked" in warning.what for warning in report.warnings)


def test_without_a_rearrangement_nothing_is_planned(tmp_path: Path):
    path = tmp_path / "image.yaml"
    path.write_text(
        "labseq: 1\nname: look\nshots: 1\n"
        "target: {pattern: compact, rows: 2, cols: 2}\n"
        "shot:\n  - image: {}\n",
        encoding="utf-8",
    )
    assert check(labseq.Session.open(path)).rehearsal is None


@pytest.mark.parametrize("frames", ["last", "none"])
def test_the_disk_space_follows_the_frames_that_are_kept(frames: str):
    size = checked(f"record_frames={frames}").shot_bytes
    assert size is not None
    assert size < (700_000 if frames == "last" else 100_000)


def test_a_planner_that_fails_is_a_warning(tmp_path: Path):
    folder = tmp_path / "plugins"
    folder.mkdir()
    (folder / "broken.py").write_text(
        "import labseq\nLABSEQ_API = 1\n"
        "class Broken:\n"
        "    def __init__(self, settings, context): pass\n"
        "    def plan(self, occupancy, target): raise KeyError('typo')\n"
        "@labseq.plugin.hookimpl\n"
        "def labseq_register(registry): registry.planner('broken', Broken)\n",
        encoding="utf-8",
    )
    text = COMPACT.read_text(encoding="utf-8")
    text = text.replace("{use: psca, degree_of_parallelism: 7}", "{use: broken}")
    path = tmp_path / "broken.yaml"
    path.write_text(text + "plugin_folders: [plugins]\n", encoding="utf-8")
    (warning,) = check(labseq.Session.open(path)).warnings
    assert "raised KeyError: 'typo'" in warning.what
    assert warning.line == next(i for i, line in enumerate(text.splitlines(), 1) if "broken" in line)


def test_a_rearrangement_that_no_image_follows():
    (warning,) = checked("shot=[{load: {}}, {image: {}}, {rearrange: {cycles: 3}}]").warnings
    assert "no image follows the last rearrangement" in warning.what


def test_cycles_that_are_all_made_need_no_image_after_them():
    assert not checked("shot=[{load: {}}, {image: {}}, {rearrange: {cycles: 3, stop_when: never}}]").warnings


def test_a_degree_of_parallelism_that_the_profile_does_not_allow():
    (warning,) = checked("planner.degree_of_parallelism=700").warnings
    assert warning.source == "--set planner.degree_of_parallelism=700"
    assert "the profile allows 20 mobile tweezers at once" in warning.what
