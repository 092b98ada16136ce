from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from labseq.console.events import LogLines, event_text, scanned_names
from labseq.recording.results import ResultsLog, results_file


def lines_of(events: Any) -> list[str]:
    stream = io.StringIO()
    log = LogLines(stream)
    for name, values in events:
        log.event(name, values)
    log.close()
    return stream.getvalue().splitlines()


def test_a_run_in_lines(fake: Any) -> None:
    assert lines_of(fake.script(fake.run())) == [
        "compiling kernels, about 6 s; later runs find them in the cache",
        "compiled in 6 s",
        "data/2026-01-02/0001_compact-225: 20 shots, seed 1, profile virtual, simulated",
        "shot 0  defect-free after 2 cycles  filling 100.0 %  1.9 s",
        "shot 1  defect-free after 2 cycles  filling 100.0 %  1.9 s",
    ]


def test_what_goes_wrong_is_reported(fake: Any) -> None:
    failed = fake.row(status="failed", error="TransientError: no light", attempt=1)
    events = [
        ("warning", {"text": "the laser is warm"}),
        ("shot_repeated", {"row": failed}),
        ("shot_finished", {"row": failed}),
        ("safe_state", {"device": "camera", "ok": True, "error": ""}),
        ("safe_state", {"device": "camera", "ok": False, "error": "camera: mute"}),
        ("closed", {"device": "shutter", "ok": False, "error": "shutter: jammed"}),
        ("something_new", {}),
    ]
    assert lines_of(events) == [
        "warning: the laser is warm",
        "shot 0: attempt 1 failed, trying again: TransientError: no light",
        "shot 0  failed: TransientError: no light",
        "warning: camera could not be brought to its safe state: camera: mute",
        "warning: shutter could not be closed: shutter: jammed",
    ]


def test_a_measured_result_has_a_line_when_it_comes(tmp_path: Path, fake: Any) -> None:
    """After its shot, whatever comes meanwhile; those of other shots and what failed have none."""
    resolved = {"measure": [{"value": "analysis.heat.n"}, {"value": "loading"}]}
    stream = io.StringIO()
    log = LogLines(stream)
    log.event("run_starting", {"record": replace(fake.run(), resolved=resolved), "run_dir": str(tmp_path)})
    log.event("shot_finished", {"row": fake.row(0)})
    results = ResultsLog(results_file(tmp_path, "heat"), {"analysis": "heat"})
    for shot, n in ((0, 3.25), (1, 4.0), (2, "none")):
        results.write(shot, {"n": n})
    log.event("shot_finished", {"row": fake.row(2)})
    log.event("shot_finished", {"row": fake.row(3, status="failed")})
    results.write(3, {"n": 5.0})
    log.event("shot_finished", {"row": fake.row(4)})
    results.write(4, {"n": 6})
    log.event("run_finished", {"status": "complete"})
    lines = [line for line in stream.getvalue().splitlines() if "heat" in line]
    assert lines == ["shot 0  analysis.heat.n 3.25", "shot 4  analysis.heat.n 6"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"success": True, "seen": -1}, "defect-free  filling 100.0 %"),
        (
            {"success": False, "seen": 3, "filling": 223 / 225},
            "2 defects (defect-free after 4 cycles)  filling 99.1 %",
        ),
        ({"success": False, "seen": -1, "filling": 224 / 225}, "1 defect  filling 99.6 %"),
        ({"success": False, "seen": -1, "filling": 1.0}, "surplus atoms  filling 100.0 %"),
        ({"success": False, "seen": -1, "filling": math.nan}, "not judged: no image"),
    ],
)
def test_a_shot_as_text(fake: Any, changes: Any, words: str) -> None:
    text = event_text("shot_finished", {"row": fake.row(2, **changes)}, fake.run())
    assert text == f"shot 2  {words}  1.9 s"


def test_a_shot_that_was_interrupted_needs_no_reason(fake: Any) -> None:
    row = fake.row(0, status="interrupted", error="StopRequested: stopped by Ctrl-C")
    assert event_text("shot_finished", {"row": row}, fake.run()) == "shot 0  interrupted"
    scan = {"addresses": ["a.b", "c.d"], "written": [["5 ms", "7"]], "point_of_shot": [0]}
    text = event_text("shot_finished", {"row": row}, replace(fake.run(), scan=scan))
    assert text == "shot 0  b 5 ms, d 7  interrupted"


def test_a_scanned_address_is_named_by_its_end() -> None:
    ends = {"shot.probe.offset.0": "offset.0", "planner.degree_of_parallelism": "degree_of_parallelism"}
    assert scanned_names({"addresses": list(ends)}) == list(ends.values())
    same = ["shot.2.rearrange.window", "shot.4.rearrange.window"]
    assert scanned_names({"addresses": same}) == same
