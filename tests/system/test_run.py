"""The command line as users run it: runs, a wrong sequence, a stop."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import labseq
from labseq.cli import main

pytestmark = pytest.mark.system

SEQUENCE = Path(__file__).resolve().parents[2] / "sequences" / "compact_225.yaml"


def test_run_then_show(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., tuple[int, str, str]],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call("run", str(SEQUENCE), "--json", "--shots", "2", "--seed", "1")
    assert (code, out.count("\n")) == (0, 1), err
    answer = json.loads(out)
    run_dir = tmp_path / answer["run_dir"]
    assert (answer["shots"], answer["status"]) == (2, "complete")
    assert 0.9 < answer["filling_fraction"] <= 1.0
    assert answer["defect_free"] in {0.0, 0.5, 1.0}
    assert run_dir.parents[1] == tmp_path / "data"
    assert len(list((run_dir / "shots").glob("*.h5"))) == 2
    code, out, err = call("show", str(run_dir))
    assert code == 0, err
    assert "shots             2 of 2" in out


def test_without_a_terminal_there_are_plain_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["run", str(SEQUENCE), "--shots", "1", "--seed", "3", "--output", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    assert err == ""
    assert "\x1b" not in out
    lines = out.splitlines()
    assert any("1 shot, seed 3, profile virtual, simulated" in line for line in lines)
    assert any(line.startswith("shot 0  ") for line in lines)
    assert any(line.startswith("run  ") and "out" in line for line in lines)


def test_check_opens_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["check", str(SEQUENCE), "--set", "planner.degree_of_parallelism=5"])
    out = capsys.readouterr().out
    for words in ("compact-225", "225 atoms", "cycle 9: image", "12 images at most", "60 ms", "uses 5"):
        assert words in out
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_sequence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(SEQUENCE.read_text("utf-8").replace("shots: 20", "shoots: 20"), "utf-8")
    line = wrong.read_text("utf-8").splitlines().index("shoots: 20") + 1
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["run", str(wrong), "--json"])
    out, err = capfd.readouterr()
    assert f"{wrong}:{line}:1: " in err
    answer = json.loads(out)
    assert (answer["run_dir"], answer["status"]) == (None, "failed")
    message, _, excerpt = err.strip().partition("\n")
    assert answer["error"] == message
    assert "^^^^^^" in excerpt


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals between processes")
def test_a_run_that_is_stopped(tmp_path: Path) -> None:
    arguments = ["run", str(SEQUENCE), "--shots", "100000", "--json", "--seed", "1"]
    with subprocess.Popen(
        [sys.executable, "-m", "labseq", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    ) as child:
        assert child.stderr is not None
        while not child.stderr.readline().startswith("shot 0  "):
            assert child.poll() is None
        child.send_signal(signal.SIGTERM)
        out, err = child.communicate(timeout=180)
    answer = json.loads(out)
    assert (child.returncode, answer["status"]) == (143, "stopped")
    assert answer["shots"] >= 1
    assert err.rstrip().endswith(answer["error"])
    assert labseq.open_run(tmp_path / answer["run_dir"]).status == "stopped"
