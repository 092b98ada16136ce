"""The API agrees with what the library reads, of whole runs and of damaged ones."""

from __future__ import annotations

import json
import os
import shutil
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from labseq.analysis.statistics import statistics_of
from labseq.calibration_store import encode_entry
from labseq.data.described import read_entry
from labseq.data.entry import RunEntry
from labseq.data.follower import Follower
from labseq.data.reader import open_run
from labseq.files import write_file
from labseq.model import CalibrationEntry, SiteGrid, grid_facts
from labseq.model.estimate import mean
from labseq.plain import now
from labseq.web.history import RunHistory
from labseq.web.runs import Catalogue
from tests.pictures.pixels import decoded
from tests.recording import damages

from .clients import client_of, path_of, shot_of_frames, write_run


def answers(client: Any, path: str) -> Any:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_columns_are_the_index_as_the_library_reads_it(run_dir: Path) -> None:
    history, run = RunHistory(run_dir, Follower(run_dir), list), open_run(run_dir)
    for _ in range(2):  # nothing is read twice
        history.update()
    columns = history.columns()
    rows = [shot.row for shot in run.shots]
    assert columns.of_shots("filling").tolist() == [row.filling_fraction for row in rows]
    assert columns.of_shots("n_atom_moves").tolist() == [row.n_atom_moves for row in rows]
    assert columns.shot[columns.counted].tolist() == [shot.index for shot in run.shots]
    assert len(columns.shot) == len(run.shots) + len(run.attempts)
    assert columns.filling == mean([shot.filling_fraction for shot in run.shots])
    assert columns.losses.keys() == statistics_of(run.shots, run.target).losses.keys()
    assert history.row(history.line_of(3) or 0) == run.shots[3].row


def test_damaged_lines_are_counted_and_an_index_that_was_replaced_is_read_again(run_dir: Path) -> None:
    path, runs = run_dir / "index.jsonl", Catalogue(run_dir.parents[1])
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-1]) + b"{damaged\n" + lines[-1][:50])
    before = runs.open(run_dir.parent.name, run_dir.name)
    before.history.update()
    assert (len(before.history), before.history.n_damaged) == (len(lines) - 1, 1)
    with path.open("ab") as file:
        file.write(lines[-1][50:])
    before.history.update()
    assert len(before.history) == len(lines)
    write_file(path, b"".join(lines))
    after = runs.open(run_dir.parent.name, run_dir.name)
    after.history.update()
    assert (len(after.history), after.history.n_damaged) == (len(lines), 0)


def test_state_of_the_newest_run(client: Any, run_dir: Path) -> None:
    state = answers(client, "/api/v1/now")
    run = open_run(run_dir)
    assert state["run"]["id"] == f"{run_dir.parent.name}/{run_dir.name}"
    assert (state["run"]["n_done"], state["run"]["n_attempts"]) == (len(run.shots), len(run.attempts))
    assert state["figures"]["filling"] == pytest.approx(run.filling_fraction)
    assert state["figures"]["defect_free"] == pytest.approx(run.defect_free)
    last = run.shots[-1]
    assert [image["n_atoms"] for image in state["shot"]["images"]] == list(last.row.images.n_atoms)
    assert [len(cycle["batches"]) for cycle in state["shot"]["cycles"]] == [p.n_batches for p in last.plans]
    assert any("attempt" in alarm["title"] for alarm in state["alarms"])


def test_every_address_of_the_description_answers(client: Any, run_dir: Path) -> None:
    described = answers(client, "/api/v1/openapi.json")["paths"]
    values = {"day": run_dir.parent.name, "name": run_dir.name, "shot": "0", "image": "0", "kind": "sequence"}
    for path, methods in described.items():
        if path.endswith(("/events", "/motion/{cycle}")) or "{store}" in path:
            continue
        answer = client.get(path.format(**values))
        assert answer.status_code == 200, (path, answer.text)
        (kind,) = methods["get"]["responses"]["200"]["content"]
        assert answer.headers["content-type"].startswith(kind)
        assert methods["get"]["summary"]
    answer = client.get(f"/api/v1/runs/{run_dir.parent.name}/{run_dir.name}/shots/0/motion/99")
    assert (answer.status_code, answer.json()) == (404, {"error": "the shot has no cycle 99"})


def test_a_run_without_settings_has_no_motion(client: Any, run_dir: Path) -> None:
    """The motion of a run in the virtual lab is compared in a browser, see ``test_browser.py``."""
    answer = client.get(f"{path_of(run_dir)}/shots/0/motion/0")
    assert answer.status_code == 409
    assert "does not contain the settings of the shot" in answer.json()["error"]


def test_a_frame_is_shown_from_black_to_white_at_every_size(tmp_path: Path) -> None:
    """1 % of the pixels are black, 0.2 % white, those between in proportion."""
    ramp = np.arange(1001, dtype=np.uint16).reshape(7, 143)
    writer = write_run(tmp_path, 0, n_shots=1)
    writer.write_shot(shot_of_frames(ramp[::-1], ramp))
    address = f"{path_of(writer.run_dir)}/shots/0/frames/1.png"
    client = client_of(tmp_path)
    whole = client.get(f"{address}?width=143")
    assert whole.headers["x-reduced"] == "1"
    assert_allclose(decoded(whole.content), ((ramp - 10.0) * 255 / (998 - 10)).clip(0, 255), atol=1)
    small = client.get(f"{address}?width=50")
    means = np.array([[ramp[r : r + 3, c : c + 3].mean() for c in range(0, 141, 3)] for r in (0, 3)])
    _, low, *_, high = np.sort(means.ravel())
    assert small.headers["x-reduced"] == "3"
    assert_allclose(decoded(small.content), ((means - low) * 255 / (high - low)).clip(0, 255), atol=1)


def test_list_is_searched_by_name_status_and_comment(run_dir: Path, tmp_path: Path) -> None:
    root = run_dir.parent.parent
    write_run(root, 1, "kagome lattice").finish("stopped")
    (run_dir / "notes.json").write_text('{"comment": "new lens", "tags": ["good"]}')
    client = client_of(root)
    assert answers(client, "/api/v1/runs")["n_found"] == 2
    for query, expected in (
        ("q=kagome", ["kagome lattice"]),
        ("q=LENS good", ["größer µ"]),
        ("status=stopped", ["kagome lattice"]),
        ("q=kagome lens", []),
    ):
        assert [run["name"] for run in answers(client, f"/api/v1/runs?{query}")["runs"]] == expected


def test_a_search_reads_each_run_once_and_not_longer_than_a_page_waits(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, read = run_dir.parent.parent, list[Path]()
    for number in range(2, 6):
        shutil.copytree(run_dir, run_dir.with_name(f"{number:04}_copy"))

    def noting(folder: Path) -> RunEntry:
        read.append(folder)
        return read_entry(folder)

    monkeypatch.setattr("labseq.data.described.read_entry", noting)
    monkeypatch.setattr("labseq.data.catalogue.SETTLED_S", 0.0)
    monkeypatch.setattr("labseq.web.runs.SEARCH_S", -1.0)
    catalogue = Catalogue(root)
    answer = catalogue.search("complete", "", 0, 50)
    assert (answer["n_runs"], answer["n_found"], answer["n_unread"], read) == (5, 0, 5, [])
    monkeypatch.setattr("labseq.web.runs.SEARCH_S", 60.0)
    answer = catalogue.search("complete", "", 0, 2)
    assert (answer["n_found"], answer["n_unread"], len(answer["runs"])) == (5, 0, 2)
    read.clear()
    assert Catalogue(root).search("simulated", "complete", 0, 0)["n_found"] == 5
    assert read == []  # also after the server was started again


def test_a_run_that_grows_and_one_that_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq.web.state._OPEN_S", 0.0)
    writer = write_run(tmp_path, 2)
    client = client_of(tmp_path)
    path = path_of(writer.run_dir)
    assert answers(client, f"{path}/state")["run"]["n_done"] == 2
    from tests.recording.records import make_shot

    writer.write_shot(make_shot(2))
    state = answers(client, f"{path}/state")
    assert (state["run"]["n_done"], state["shot"]["shot"]) == (3, 2)
    writer.finish("failed", "no light")
    assert answers(client, f"{path}/state")["alarms"][0]["text"] == "no light"
    (writer.run_dir / "index.jsonl").write_text("")
    state = answers(client, f"{path}/state")
    assert (state["run"]["n_done"], state["shot"], state["stages"]) == (0, None, [])


def test_a_data_folder_that_vanishes_and_returns(run_dir: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("labseq.web.runs._LISTED_S", -1.0)
    root = run_dir.parent.parent
    client = client_of(root)
    assert answers(client, "/api/v1/now")["run"] is not None
    root.rename(tmp_path / "away")
    end_s = time.monotonic() + 30.0
    while not (state := answers(client, "/api/v1/now"))["error"]:  # the list of runs is kept for a moment
        assert time.monotonic() < end_s
    assert state["run"] is None
    assert "cannot be read" in state["error"]
    assert client.get("/api/v1/runs").status_code == 409
    assert "labseq_up 0" in client.get("/metrics").text
    (tmp_path / "away").rename(root)
    assert answers(client, "/api/v1/now")["run"] is not None


DAMAGES = [
    *("flipped_bit", "truncated_file", "empty_file", "torn_index", "unended_line"),
    *("no_record", "no_state", "pipe", "record_of_megabytes", "folder_for_file"),
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_runs_say_what_cannot_be_shown(damage: str, run_dir: Path) -> None:
    if hasattr(damages, damage):
        getattr(damages, damage)(run_dir)
    elif damage == "no_record":
        (run_dir / "run.json").write_bytes(b"{")
    elif damage == "no_state":
        (run_dir / "STATE").write_bytes(b"\xff\x00")
    elif damage == "record_of_megabytes":
        (run_dir / "run.json").write_bytes(b"[" * 20_000_000)
    elif damage == "folder_for_file":
        (run_dir / "index.jsonl").unlink()
        (run_dir / "index.jsonl").mkdir()
    elif hasattr(os, "mkfifo"):
        (run_dir / "shots" / "shot_000001.h5").unlink()
        os.mkfifo(run_dir / "shots" / "shot_000001.h5")
    client = client_of(run_dir.parent.parent)
    path = path_of(run_dir)
    pages = ("", "/state", "/statistics", "/shots", "/shots/1", "/shots/1/frames/0.png", "/files/sequence")
    for page in pages:
        answer = client.get(path + page)
        assert answer.status_code in (200, 404, 409), (page, answer.text)
        assert answer.status_code == 200 or answer.json()["error"]
    assert answers(client, "/api/v1/runs")["n_runs"] == 1
    assert answers(client, "/api/v1/now")["alarms"]


HOSTILE = "<script>alert(1)</script>\"'&\x00\x1b[2J\u202e\ud800" + "x" * 1_000_000


def test_hostile_texts_are_shortened_and_cleaned(tmp_path: Path) -> None:
    writer = write_run(tmp_path, 1, "plain")
    record = json.loads((writer.run_dir / "run.json").read_text())
    for key in ("name", "profile_path", "t_start_utc", "lattice", "record_frames"):
        record[key] = HOSTILE
    record["overrides"] = {HOSTILE[:50]: {"written": HOSTILE}}
    record["devices"] = {HOSTILE[:50]: HOSTILE[:9000], "camera": [1]}
    record["provenance"] = {"host": {"a": HOSTILE[:9000]}}
    record["scan"] = {"addresses": [HOSTILE[:90]], "points": 5, "written": None}
    (writer.run_dir / "run.json").write_text(json.dumps(record))
    (writer.run_dir / "notes.json").write_text(
        json.dumps({"comment": HOSTILE[:90_000], "tags": [HOSTILE[:99], 5]})
    )
    writer.finish("failed", HOSTILE[:90_000])
    client = client_of(tmp_path)
    for page in (path_of(writer.run_dir), "/api/v1/now", "/api/v1/runs", "/metrics"):
        answer = client.get(page)
        assert answer.status_code == 200, answer.text[:500]
        assert len(answer.content) < 200_000, page
        assert not set("\x00\x1b\u202e") & set(answer.text)


@pytest.mark.parametrize(
    "path",
    [
        "../x",
        "2026-11-20/..%2f..%2fetc",
        "2026-11-20/.",
        "%2e%2e/x",
        "2026-11-20/a%00b",
        "x/y",
        "2026-11-20/" + "y" * 900,
    ],
)
def test_no_path_leads_out_of_the_data_folder(path: str, client: Any, run_dir: Path) -> None:
    secret = run_dir.parent.parent.parent / "secret"
    shutil.copytree(run_dir, secret)
    for page in ("", "/files/sequence", "/shots/0"):
        assert client.get(f"/api/v1/runs/{path}{page}").status_code in (403, 404, 405)


def test_a_calibration_older_than_its_limit_is_an_alarm(run_dir: Path) -> None:
    from labseq.web.state import calibration_alarms

    quality, grid = {"error_m": 1e-8}, grid_facts(SiteGrid())
    values = {"offset_m": np.array([1e-8, 0.0])}
    taken = (now() - timedelta(days=3)).isoformat()
    old = CalibrationEntry("overlay", values, quality, grid, {}, taken)
    (run_dir / "calibration_overlay.json").write_bytes(encode_entry(old))
    record = {"calibrations": {"overlay": old.id, "sites": "gone"}}
    (found,) = calibration_alarms(run_dir, record, 86_400.0)
    assert found["title"] == "The calibration 'overlay' is 3 days old"
    assert calibration_alarms(run_dir, record, 7 * 86_400.0) == []


def test_a_clock_that_jumped_and_a_full_disk(run_dir: Path, monkeypatch: Any) -> None:
    record = json.loads((run_dir / "run.json").read_text())
    record["t_start_utc"] = "9999-12-31T23:59:59+14:00"
    (run_dir / "run.json").write_text(json.dumps(record))
    for free, is_alarmed in ((4_900_000_000, True), (5_100_000_000, False)):
        monkeypatch.setattr("labseq.web.state.free_bytes", lambda _, free=free: free)
        state = answers(client_of(run_dir.parent.parent), "/api/v1/now")
        assert ("The disk is nearly full" in [one["title"] for one in state["alarms"]]) == is_alarmed
