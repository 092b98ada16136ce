"""The client for other control systems, against the real follower."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import labseq_client
import numpy as np
import pytest
from labseq_client import Answer, LabseqError, Leader

from .labseq_follow_rig import MAX_WAIT_S, TcpPeer, led, listening, token_file
from .test_labseq_follow_session import run_led

FILE = Path(labseq_client.__file__)
BARE = """
import sys
sys.modules["numpy"] = None  # as if it were not installed
from labseq_client import Leader
with Leader(port=int(sys.argv[1])) as labseq:
    labseq.go("bare")
    answer = labseq.wait(60.0)
print([[int(atom) for atom in row] for row in answer.after])
print(sorted({name.split(".")[0] for name in sys.modules} & {"labseq", "labseq_follow"}))
"""


def leader(address: str) -> Leader:
    return Leader(port=int(address.rpartition(":")[2]), timeout_s=MAX_WAIT_S)


def test_it_is_python_3_7_and_needs_the_standard_library_alone() -> None:
    tree = ast.parse(FILE.read_text(), feature_version=(3, 7))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported - {"numpy"} <= set(sys.stdlib_module_names)


def test_what_it_sees_is_what_the_files_hold(tmp_path: Path) -> None:
    answers: list[Answer] = []

    def lead(address: str) -> None:
        with leader(address) as labseq:
            for number in range(2):
                labseq.go(f"run {number}")
                answers.append(labseq.wait(MAX_WAIT_S))

    done = run_led(lead, tmp_path, "shot.2.rearrange.cycles=2", shots=2)
    for answer, shot in zip(answers, done.shots, strict=True):
        assert (answer.is_ready, answer.shot, answer.success) == (True, shot.index, shot.success)
        assert Path(str(answer.file)) == shot.file
        assert shot.readings["leader.go"] == [f"run {shot.index}"]
        assert [image["name"] for image in answer.images] == [image.name for image in shot.images]
        assert len(answer.images) == len(shot.occupancies) > 2
        for number, seen in enumerate(shot.occupancies):
            np.testing.assert_array_equal(answer.occupancy(number), seen)
        assert [image["judged"] for image in answer.images][:2] == [True, False]
        assert answer.images[-1]["judged"]
        assert answer.facts["defects"] == 225 * (1 - float(answer.filling or 0)) or not answer.success
        starts = [image["start_s"] for image in answer.images]
        assert 0 < answer.facts["taken_s"] <= starts[0]
        assert starts == sorted(starts)
        assert starts[-1] < answer.facts["done_s"]
        exposures = [stage["start_s"] for stage in answer.facts["stages"] if stage["name"] == "expose"]
        np.testing.assert_allclose(exposures, starts, atol=0.05)


def test_without_numpy_occupancies_are_lists(tmp_path: Path) -> None:
    lines: list[str] = []

    def lead(address: str) -> None:
        command = [sys.executable, "-c", BARE, address.rpartition(":")[2]]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, cwd=FILE.parent)
        lines.extend(ended.stdout.splitlines() or [ended.stderr])

    done = run_led(lead, tmp_path, "shot.2.rearrange.cycles=1", shots=1)
    assert lines == [str(done.shots[0].occupancies[-1].astype(int).tolist()), "[]"]


def test_an_abort_ends_a_shot_before_its_moves_and_the_run_goes_on(tmp_path: Path) -> None:
    answers: list[Answer] = []

    def lead(address: str) -> None:
        with leader(address) as labseq:
            for _ in range(3):
                labseq.go()
                answers.append(labseq.abort())
            labseq.go()
            answers.append(labseq.wait(MAX_WAIT_S))

    done = run_led(lead, tmp_path, "attempts=1", "shot.2.rearrange.cycles=2", shots=1)
    assert [answer.is_ready for answer in answers] == [False, False, False, True]
    assert all("aborted" in answer.reason for answer in answers[:3])
    assert (done.status, len(done.shots)) == ("complete", 1)


def test_an_abort_while_the_shot_goes_on_moves_no_atoms(tmp_path: Path) -> None:
    with led() as (device, peer):
        peer.say("go")
        device.wait_for("go", 20.0)
        device.check_interlocks()
        assert [peer.hear(), peer.ask("abort\nstate?")] == ["busy", "state busy"]
        with pytest.raises(Exception, match="leader: the leader aborted the shot"):
            device.check_interlocks()
        assert device.report("failed", {"shot": 0, "reason": "aborted"}) == "failed"
        device.check_interlocks()
        assert peer.hear() == "failed shot=0 reason=aborted"
        assert peer.ask("abort") == "error no shot to abort"


def test_it_raises_with_the_reason_of_labseq() -> None:
    with listening() as device:
        address = device.describe()["address"]
        first = leader(address)
        with pytest.raises(LabseqError, match="another leader is connected; one at a time"):
            leader(address)
        with pytest.raises(LabseqError, match="the first line must be 'hello' and the token"):
            Leader(port=int(address.rpartition(":")[2]), token="0" * 32)
        assert first.state() == "idle"
        with pytest.raises(LabseqError, match="the line is too long"):
            first.go("x" * 4000)
        with pytest.raises(RuntimeError, match="call go"):
            first.wait()
        first.go("1\nabort")
        with pytest.raises(RuntimeError, match="wait"):
            first.go()
        device.close()
        assert first.wait(MAX_WAIT_S).reason == "labseq ends"
        with pytest.raises(ConnectionError, match="closed"):
            first.go()
        first.close()


def test_the_text_form_can_be_read_by_eye(tmp_path: Path) -> None:
    heard: list[str] = []

    def lead(address: str) -> None:
        peer = TcpPeer(address, f"{token_file().read_text().strip()} version=3")
        heard.extend([peer.hear(), peer.ask("go"), peer.hear()])
        peer.leave()

    done = run_led(lead, tmp_path, "shot.2.rearrange.cycles=1", shots=1)
    hello, busy, ready = heard
    assert (hello, busy) == ("hello labseq 3 deadline=60 rows=20 cols=20", "busy")
    word, *pairs = ready.split()
    said: dict[str, Any] = dict(pair.split("=", 1) for pair in pairs)
    shot = done.shots[0]
    assert (word, said["shot"], said["judged"]) == ("ready", "0", "1,0,1")
    for key, seen in (("before", shot.occupancies[0]), ("after", shot.occupancies[-1])):
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(said[key]), np.uint8))
        np.testing.assert_array_equal(bits[:400].reshape(20, 20), seen)
    assert int(said["atoms"]) == shot.occupancies[-1].sum()
    assert f"run={done.path}" in ready
