from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any

import pytest

from labseq.console.events import LogLines, event_text


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
