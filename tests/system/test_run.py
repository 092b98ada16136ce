"""The command line as users run it, in processes of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.cli import main

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"


def labseq_command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "labseq", *map(str, arguments)]


def call(*arguments: str | Path, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        labseq_command(*arguments),
        capture_output=True,
        text=True,
        encoding="utf-8",
        cwd=cwd,
        env={**os.environ, "PYTHONUTF8": "1", **environment},
        timeout=120,
        check=False,
    )


def run_json(cwd: Path, *arguments: str | Path) -> dict[str, Any]:
    done = call("run", SEQUENCE, "--json", *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def test_run_then_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = run_json(tmp_path, "--shots", "2", "--seed", "1")
    run_dir = Path(answer["run_dir"])
    assert (answer["shots"], answer["status"]) == (2, "complete")
    assert 0.9 < answer["filling_fraction"] <= 1.0
    assert answer["defect_free"] in {0.0, 0.5, 1.0}
    assert (tmp_path / run_dir).parents[1] == tmp_path / "data"
    assert len(list((tmp_path / run_dir / "shots").glob("*.h5"))) == 2

    shown = call("show", "--json", cwd=tmp_path)
    assert Path(json.loads(shown.stdout).pop("run_dir")) == (tmp_path / run_dir)
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["show", str(tmp_path / run_dir)])
    assert "shots             2 of 2" in capsys.readouterr().out


def test_without_a_terminal_there_are_plain_lines(tmp_path: Path) -> None:
    done = call("run", SEQUENCE, "--shots", "1", "--seed", "3", "--output", tmp_path / "out", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\x1b" not in done.stdout
    lines = done.stdout.splitlines()
    assert any("1 shot, seed 3, profile virtual, simulated" in line for line in lines)
    assert any(line.startswith("shot 1/1  ") for line in lines)
    assert any(line.startswith("run  ") and "out" in line for line in lines)


def test_the_lab_in_a_dry_run(tmp_path: Path) -> None:
    done = call("run", SEQUENCE, "--profile", "lab", "--dry-run", "--shots", "1", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "virtual twin" not in done.stderr  # every driver's own code runs, on its simulated counterpart
    run = labseq.open_run(tmp_path / json.loads(done.stdout)["run_dir"])
    assert run.simulated
    assert run.shots[0].frames.shape[1:] == (512, 512)


def test_check_opens_and_writes_nothing(tmp_path: Path) -> None:
    done = call("check", SEQUENCE, "--set", "planner.degree_of_parallelism=5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in (
        "compact-225",
        "225 atoms",
        "psca",
        "cycle 10: image",
        "12 images at most",
        "60 ms",
        "uses 5",
    ):
        assert words in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_plugins_are_listed_with_their_faults(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("LABSEQ_API = 1\nimport no_such_package\n", "utf-8")
    done = call("plugins", cwd=tmp_path, LABSEQ_PLUGIN_PATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line}
    assert "loaded" in rows["labseq_psca"]
    assert "planner:psca" in rows["labseq_psca"]
    assert "camera:virtual" in rows["labseq_virtual"]
    assert "failed" in rows["broken"]
    assert "ModuleNotFoundError: No module named 'no_such_package'" in rows["broken:"]


def test_a_wrong_sequence(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(SEQUENCE.read_text("utf-8").replace("shots: 20", "shoots: 20"), "utf-8")
    line = wrong.read_text("utf-8").splitlines().index("shoots: 20") + 1
    done = call("run", wrong, "--json", cwd=tmp_path)
    assert done.returncode == 2
    assert f"{wrong}:{line}:1: " in done.stderr
    answer = json.loads(done.stdout)
    assert (answer["run_dir"], answer["status"]) == (None, "failed")
    message, _, excerpt = done.stderr.strip().partition("\n")
    assert answer["error"] == message
    assert "^^^^^^" in excerpt


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals between processes")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped(tmp_path: Path, number: int, code: int) -> None:
    command = labseq_command("run", SEQUENCE, "--shots", "100000", "--json", "--seed", "1")
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        while not child.stderr.readline().startswith("shot 1/"):
            assert child.poll() is None
        child.send_signal(number)
        out, err = child.communicate(timeout=60)
    answer = json.loads(out)
    assert (child.returncode, answer["status"]) == (code, "stopped")
    assert answer["shots"] >= 1
    assert err.rstrip().endswith(answer["error"])
    assert labseq.open_run(tmp_path / answer["run_dir"]).status == "stopped"
