from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from labseq.cli.check import BAR_WIDTH, check_sequence, lines_table, timeline_table
from labseq.model import TimedBy, TimelineEntry

SEQUENCE = str(Path(__file__).parents[2] / "sequences" / "compact_225.yaml")
TIMELINE = [
    ("load", [TimelineEntry("load", 0.5, 0.5)]),
    ("image", [TimelineEntry("image", 0.045, 0.045, 1, timed_by=TimedBy("camera"))]),
    (
        "sort",
        [
            TimelineEntry("cycle 0: move", 0.06, 0.06, timed_by=TimedBy("lines", 0.5e-6)),
            TimelineEntry("cycle 0: image", 0.045, 0.045, 1),
        ],
    ),
    ("device", [TimelineEntry("shutter: open", 0.0, 0.0)]),
]


def test_a_line_is_drawn_where_it_is_on() -> None:
    lines = {"imaging": [(0.0, 0.25), (0.5, 0.75)], "mot": []}
    assert [line.rstrip() for line in lines_table(lines, 1.0, "#", 8)] == [
        "line       times on  at most",
        "imaging           2   500 ms  ##  ##",
        "mot               0      0 s",
    ]
    assert lines_table({}, 1.0, "#") == []


def test_a_check_names_the_devices_that_it_did_not_ask_and_what_stays_on(
    capsys: pytest.CaptureFixture[str],
) -> None:
    warm = "profile.mobile_tweezers.keep_warm={row_frequency: 82.2 MHz, column_frequency: 117.8 MHz}"
    stream = ["profile.mobile_tweezers.mode=stream", "profile.mobile_tweezers.trigger=software"]
    lines = "profile.lines={use: virtual, channels: {}}"
    overrides = [*stream, lines, warm, "profile.static_tweezers.after_run=on"]
    check_sequence(Path(SEQUENCE), "lab", overrides, "off", as_json=False)
    shown = capsys.readouterr().out
    rows = {line.split(maxsplit=1)[0]: line for line in shown.splitlines() if line}
    assert "camera, static_tweezers, mobile_tweezers, shutter: " in rows["not"]
    assert "stays on after the run" in rows["static_tweezers"]
    assert "82.2 MHz (2 mW) and 117.8 MHz (2 mW)" in rows["mobile_tweezers"]
    check_sequence(Path(SEQUENCE), "lab", [], "full", as_json=False)
    shown = capsys.readouterr().out
    assert "not opened" not in shown
    assert "when nothing plays" not in shown


@pytest.mark.parametrize(
    ("overrides", "variant", "algorithm"),
    [
        ([], "variant fewest", "generalised PSCA, with fewer batches than variant: paper"),
        (["planner.variant=paper"], "variant paper", "PSCA as in the text of Tian et al."),
        (["planner={use: grid}"], "", None),
    ],
)
def test_a_check_names_the_algorithm_where_the_planner_has_several(
    overrides: list[str], variant: str, algorithm: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    check_sequence(Path(SEQUENCE), None, overrides, "off", as_json=False)
    lines = capsys.readouterr().out.splitlines()
    rows = {name: text.strip() for name, _, text in (line.partition(" ") for line in lines)}
    assert rows.get("algorithm") == algorithm
    assert variant in rows["planner"]


def test_timeline_table() -> None:
    assert timeline_table(TIMELINE, "#") == [
        "step                       start  at most  timed by",
        "0 load                       0 s   500 ms  computer to 1 ms  " + "#" * 23,
        "1 image                   500 ms    45 ms  camera            " + " " * 23 + "##",
        "2 sort    cycle 0: move   545 ms    60 ms  lines to 500 ns   " + " " * 25 + "###",
        "          cycle 0: image  605 ms    45 ms  computer to 1 ms  " + " " * 28 + "##",
        "3 device  shutter: open   650 ms      0 s                    " + " " * 29 + "#",
    ]


@given(st.lists(st.floats(0, 1e3), min_size=1, max_size=30))
def test_bars_follow_one_another_and_stay_in_their_column(durations_s: list[float]) -> None:
    bars = [TimelineEntry("bar", duration_s, duration_s) for duration_s in durations_s]
    lines = timeline_table([("step", bars)], "#")[1:]
    column = max(line.find("#") for line in lines)
    if not sum(durations_s):
        assert column == -1
        return
    first = min(line.index("#") for line in lines)
    assert all(len(line) - first <= BAR_WIDTH for line in lines)
    starts = [line.index("#") for line in lines]
    assert starts == sorted(starts)
