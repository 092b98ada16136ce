"""Numbers of the pages, for shots and times that are known."""

from __future__ import annotations

import asyncio
import json
import math
import os
import time
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from labseq.model import ShotRecord
from labseq.model.estimate import Rate, mean
from labseq.web.live import Channel
from tests.recording.records import START, make_shot

from .clients import Client, client_of, path_of, write_run


def shot(index: int, filling: float, seen: int) -> ShotRecord:
    """A shot without images, which are not read for these numbers."""
    success = filling == 1.0
    known = make_shot(index, n_images=0, batches=(), filling_fraction=filling, success=success)
    return replace(known, seen_defect_free_cycle=seen)


def state_of(run_dir: Path) -> Any:
    return client_of(run_dir.parent.parent).get(f"{path_of(run_dir)}/state").json()


def test_figures_and_trend_leave_out_what_was_not_judged(tmp_path: Path) -> None:
    fillings = [1.0, 0.5, 1.0, math.nan, 0.75, 1.0, *([0.25] * 5), 1.0]
    seen = [0, -1, 2, 0, -1, -1, *([-1] * 5), 1]
    writer = write_run(tmp_path, 0, n_shots=12)
    for i, (filling, cycle) in enumerate(zip(fillings, seen, strict=True)):
        writer.write_shot(shot(i, filling, cycle))
    state = state_of(writer.run_dir)
    filling, defect_free = state["measured"]
    figures, (first, second) = state["figures"], filling["trend"]
    assert (figures["n_defect_free"], figures["n_judged"], figures["n_seen"]) == (4, 11, 4)
    assert (first["shot"], first["n"], second["shot"], second["n"]) == (2.5, 5, 8.5, 6)
    assert first["value"] == pytest.approx((1 + 0.5 + 1 + 0.75 + 1) / 5)
    assert first["interval"] == pytest.approx(mean([1, 0.5, 1, 0.75, 1]).interval)
    first, second = defect_free["trend"]
    assert (first["value"], second["value"]) == pytest.approx((3 / 5, 1 / 6))
    assert first["interval"] == pytest.approx(Rate(3, 5).interval)


def test_time_left_is_that_of_the_shots_since_the_run_was_resumed(tmp_path: Path) -> None:
    writer = write_run(tmp_path, 6, n_shots=10)
    events = [
        {"event": "run_starting", "t_s": 0.0, "values": {"n_before": 4}},
        {"event": "shot_started", "t_s": 10.0, "values": {}},
        {"event": "shot_finished", "t_s": 30.0, "values": {}},
    ]
    (writer.run_dir / "events.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in events))
    run = state_of(writer.run_dir)["run"]
    assert run["time_left_s"] == pytest.approx((30 - 10) / 2 * 4)


@pytest.mark.parametrize(
    ("period_s", "silent_s", "is_alarm"),
    [(1.0, 100.0, False), (1.0, 140.0, True), (60.0, 140.0, False), (60.0, 640.0, True)],
)
def test_silence_is_an_alarm_when_it_is_much_longer_than_a_shot(
    tmp_path: Path, period_s: float, silent_s: float, is_alarm: bool
) -> None:
    """Two minutes at least, and ten times the time of a shot."""
    writer = write_run(tmp_path, 0, n_shots=9)
    for i in range(3):
        start = datetime.fromisoformat(START) + timedelta(seconds=i * period_s)
        writer.write_shot(replace(shot(i, 1.0, 0), t_start_utc=start.isoformat(timespec="microseconds")))
    written_s = time.time() - silent_s
    os.utime(writer.run_dir / "index.jsonl", (written_s, written_s))
    titles = [alarm["title"] for alarm in state_of(writer.run_dir)["alarms"]]
    assert any("No shot for" in title for title in titles) is is_alarm


def test_shots_are_listed_from_the_newest(client: Client, run_dir: Path) -> None:
    def listed(query: str) -> list[tuple[int, int, bool]]:
        answer = client.get(f"{path_of(run_dir)}/shots{query}").json()
        assert answer["n_lines"] == 5
        return [(one["shot"], one["attempt"], one["counts"]) for one in answer["shots"]]

    all_lines = [(3, 0, True), (2, 1, True), (2, 0, False), (1, 0, True), (0, 0, True)]
    assert listed("") == all_lines
    assert listed("?first=1&n=2") == all_lines[1:3]


def test_a_browser_that_has_the_present_state_is_only_told_that_it_still_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("labseq.web.live.HEARTBEAT_S", 0.01)
    channel = Channel(lambda: {"run": {"status": "complete"}, "shot": {"shot": 3}})

    async def visit() -> None:
        states: Any = channel.states("")
        told = await anext(states)
        while told.startswith(":"):
            told = await anext(states)
        head, _, state = told.partition("id: ")
        known = state.partition("\n")[0]
        assert head.startswith("event: shot\ndata: {")
        again: Any = channel.states(known)
        assert (await anext(again)).startswith(":")
        other: Any = channel.states("00000000")
        assert await anext(other) == told
        assert channel.n_viewers == 3
        for one in (states, again, other):
            await one.aclose()
        assert channel.n_viewers == 0

    asyncio.run(asyncio.wait_for(visit(), 60.0))
