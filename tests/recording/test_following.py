"""A run in progress, followed shot by shot."""

from __future__ import annotations

from labseq.recording import RunWriter
from labseq.recording.folders import INDEX_FILE
from labseq.recording.reader import Follower


def test_every_shot_that_counts_comes_once(tmp_path, make_run, make_shot):
    writer = RunWriter.create(tmp_path, make_run())
    follower = Follower(writer.run_dir)
    assert list(follower.new()) == []
    writer.write_shot(make_shot(shot_index=0))
    writer.write_shot(make_shot(shot_index=1, status="failed"))
    assert [shot.index for shot in follower.new()] == [0]
    writer.write_shot(make_shot(shot_index=1, attempt=1))
    writer.write_shot(make_shot(shot_index=2))
    (one, two) = follower.new()
    assert (one.index, one.attempt, two.index) == (1, 1, 2)
    assert len(two.occupancies) == len(make_shot().images)
    assert list(follower.new()) == []


def test_half_a_line_is_not_looked_at_before_it_is_whole(tmp_path, make_run, make_shot):
    writer = RunWriter.create(tmp_path, make_run())
    writer.write_shot(make_shot(shot_index=0))
    index = writer.run_dir / INDEX_FILE
    whole = index.read_bytes()
    follower = Follower(writer.run_dir)
    index.write_bytes(whole[:40])
    assert list(follower.new()) == []
    index.write_bytes(whole)
    assert [shot.index for shot in follower.new()] == [0]


def test_damaged_lines_are_passed_over(tmp_path, make_run, make_shot):
    writer = RunWriter.create(tmp_path, make_run())
    writer.write_shot(make_shot(shot_index=0))
    index = writer.run_dir / INDEX_FILE
    index.write_bytes(b'{"shot": 1\n' + index.read_bytes())
    assert [shot.index for shot in Follower(writer.run_dir).new()] == [0]


def test_a_folder_without_an_index_has_no_shots(tmp_path):
    assert list(Follower(tmp_path).new()) == []
