"""Frames that are lost: what is said of them, and that the others still come."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, strategies as st

from labseq import DeviceTimeoutError, TransientError

from .cameras import Bench

GAP = "the camera's frame numbers have a gap"


def outcomes(bench: Bench, n_reads: int) -> list[int | str]:
    """Number of each frame read, or which were reported as lost instead."""
    found: list[int | str] = []
    for _ in range(n_reads):
        try:
            found.append(bench.read().number)
        except TransientError as error:
            assert error.device == "cam"
            lost = re.search(r"frames? (\d+(?: to \d+)?) .*lost.* series of \d: (.*)", str(error))
            found.append(f"{lost[1]}, {lost[2]}" if lost else str(error))
    return found


def test_a_gap_in_the_numbers_is_reported_once_and_the_next_frame_follows() -> None:
    bench = Bench(lose={1: ""})
    bench.fire(3)
    assert outcomes(bench, 3) == [0, f"1, {GAP}", 2]
    with pytest.raises(DeviceTimeoutError, match="all 3 frames"):
        bench.read(0.0)


def test_several_frames_in_a_gap_are_reported_together() -> None:
    bench = Bench(lose={0: "", 1: "", 2: ""})
    bench.fire(5)
    assert outcomes(bench, 3) == [f"0 to 2, {GAP}", 3, 4]


def test_a_frame_that_the_camera_reports_as_lost_is_reported_with_its_reason() -> None:
    bench = Bench(lose={0: "17 packets are missing", 2: "bad checksum"})
    bench.fire(3)
    assert outcomes(bench, 3) == ["0, 17 packets are missing", 1, "2, bad checksum"]


def test_a_frame_held_back_behind_a_gap_is_dropped_by_the_next_series() -> None:
    bench = Bench(lose={0: ""})
    bench.fire(2)
    assert outcomes(bench, 1) == [f"0, {GAP}"]
    bench.camera.arm(1, 0.01, "software")
    with pytest.raises(DeviceTimeoutError, match="was not triggered"):
        bench.read(0.0)


@given(st.dictionaries(st.integers(0, 9), st.sampled_from(["", "torn"])))
def test_every_frame_that_came_is_read_in_order_whatever_else_is_lost(lose: dict[int, str]) -> None:
    bench = Bench(lose=lose)
    bench.fire(10)
    read: list[int] = []
    for _ in range(20):
        try:
            read.append(bench.read(0.1).number)
        except TransientError:
            pass
        except DeviceTimeoutError:
            break
    assert read == [number for number in range(10) if number not in lose]
