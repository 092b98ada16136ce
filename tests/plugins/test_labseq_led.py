"""Shots with values of another control system, its steps and its light; and shots that Python asks for."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_client import Answer, Image, LabseqError, Leader
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.devices import VirtualLines
from labseq_virtual.tweezers import VirtualMobileTweezers

import labseq
from labseq import ConfigError, Session
from labseq.plugin import Hardware
from labseq.session.check import check

from .labseq_follow_rig import MAX_WAIT_S, TcpPeer, token_file
from .test_labseq_client import FILE, leader
from .test_labseq_follow_session import ANY_PORT, FOLLOW, GUIDE, PATIENT, Led, events, run_led

SCAN = re.search(r"<!-- file: led_scan.yaml -->\n```yaml\n(.*?)^```$", GUIDE, re.DOTALL | re.MULTILINE)
PROGRAM = re.search(r"^```python\n(from itertools.*?)^```$", GUIDE, re.DOTALL | re.MULTILINE)
MAY_SET = "leader={may_set: [shot.2.rearrange.cycles, planner.degree_of_parallelism, target.rows]}"


SHORT_LIVED = ["profile.simulation.lifetime=300 ms", "profile.simulation.imaging_loss=0 %"]


def test_a_scan_by_the_leader_of_the_guide_is_fitted_as_any_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert SCAN is not None
    assert PROGRAM is not None
    program = PROGRAM[1]
    assert len(program.splitlines()) <= 40
    sequence = tmp_path / "led_scan.yaml"
    sequence.write_text(SCAN[1])

    def lead(address: str) -> None:
        code = program.replace("Leader()", f"Leader(port={address.rpartition(':')[2]})")
        fewer = code.replace('"50 ms", "100 ms", "200 ms"', '"100 ms"').replace("[*points] * 5", "points")
        exec(fewer, {})

    observer = Led(lead)
    options: dict[str, Any] = {"shots": 12, "seed": 1, "output": tmp_path, "observer": observer}
    with Session.open(sequence, overrides=[ANY_PORT, PATIENT, *SHORT_LIVED], **options) as session:
        observer.session = session
        done = session.run()
    assert len(capsys.readouterr().out.splitlines()) == 12
    assert {len({*column}) for column in zip(*done.scan["points"], strict=True)} == {3, 2}
    assert [shot.parameters["shot.sort.cycles"] for shot in done.shots][:4] == [1, 1, 2, 2]
    assert [shot.cycles[-1].cycle + 1 for shot in done.shots[:4]] == [1, 1, 2, 2], "and it was done"
    fits = done.fits("survival:before,after@target", "exponential", along="shot.hold.duration")
    assert len(fits) == 4
    decays = [fit.fit.parameters["decay"].value for fit in fits if fit.fit is not None]
    # holds are in real time: a busy computer makes some of them longer
    assert 0.1 < float(np.median(decays)) < 0.6


BAD = [
    ({"shots": 3}, "the leader may not set 'shots'; expected one of 'shot.2.rearrange.cycles'"),
    ({"shot.7.rearrange.cycles": 1}, "'shot' has no item '7'"),
    ({"planner.use": "lsap"}, "the leader may not set 'planner.use'"),
    ({"shot.2.rearrange.cycles": "many"}, "cycles is 'many'; expected a whole number"),
    ({"shot.2.rearrange.cycles": 0}, "cycles"),
    ({"target.rows": 30}, "the size of the target is 30 rows x 15 columns; the limit is the grid"),
    ({"target.rows": [3]}, "rows"),
]


def test_a_wrong_value_is_refused_before_anything_is_switched(tmp_path: Path) -> None:
    answers: list[Answer] = []

    def lead(address: str) -> None:
        with leader(address) as labseq:
            for values, reason in BAD:
                labseq.go("bad", values)
                answers.append(labseq.wait(MAX_WAIT_S))
                assert reason in answers[-1].reason
                assert (answers[-1].is_refused, answers[-1].images) == (True, [])
            with pytest.raises(LabseqError, match="target is 99 rows"):
                labseq.set({"target.rows": 99})
            labseq.set({"target.rows": 9})
            labseq.set({"shot.2.rearrange.cycles": 2})
            labseq.go("good", {"shot.2.rearrange.cycles": 1})
            answers.append(labseq.wait(MAX_WAIT_S))
            labseq.go()
            answers.append(labseq.wait(MAX_WAIT_S))

    done = run_led(lead, tmp_path, MAY_SET, shots=2)
    first, second = done.shots
    assert first.readings["leader.go"] == ["good"]
    assert first.readings["leader.answer"] == ["refused"] * len(BAD) + ["ready"]
    assert (first.target.n_atoms, second.target.n_atoms) == (9 * 15, 15 * 15)
    assert (len(first.cycles), first.parameters["target.rows"]) == (1, 9)
    assert second.parameters["target.rows"] == 15, "values are for one shot"
    for answer, shot in zip(answers[-2:], done.shots, strict=True):
        assert answer.facts["defects"] == shot.target.n_defects(shot.occupancies[-1])
        assert answer.filling == pytest.approx(shot.filling_fraction)
        assert shot.row.images.n_defects[-1] == answer.facts["defects"]


def test_values_are_for_sequences_that_allow_them(tmp_path: Path) -> None:
    said: list[str] = []

    def lead(address: str) -> None:
        peer = TcpPeer(address, f"{token_file().read_text().strip()} version=3")
        peer.hear()
        for line in ("go target.rows=3", '{"go": "a", "values": {"x": 1, "x": 2}}', '{"go": 3', '{"set": 1}'):
            peer.say(line)
            said.append(peer.hear())
            if said[-1] == "busy":
                said.append(peer.hear())
        said.append(peer.ask("done"))
        peer.ask("go")
        peer.hear()
        peer.leave()

    run_led(lead, tmp_path, "shot.2.rearrange.cycles=1", shots=1)
    hint = "add 'leader: {may_set: [target.rows]}' to it"
    assert said[0] == "busy"
    assert said[1].startswith("failed shot=0 ")
    assert f" refused=1 reason=the sequence does not let the leader set 'target.rows'; {hint}" in said[1]
    assert said[2:4] == ["busy", "failed refused=1 reason='x' is given twice"]
    assert said[4] == "busy"
    assert said[5].startswith("failed refused=1 reason=this is not JSON")
    assert said[6].startswith('error expected {"go": TEXT')
    assert said[7] == "error labseq has not asked for 'done'"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["leader={may_set: [shots]}"], "a leader cannot set 'shots'; expected an address in 'planner'"),
        (["leader={may_set: [shot.sort.cycles]}"], "'shot' has no item 'sort'"),
        (["leader={may_set: []}"], "may_set"),
        (
            [MAY_SET, "shots=2", "scan={planner.degree_of_parallelism: [3, 5]}"],
            "a scan and a leader cannot both set values",
        ),
    ],
)
def test_what_a_leader_cannot_set_is_reported_with_its_place(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        Session.open(FOLLOW, overrides=overrides)


WAIT, TURN = "{wait: {for: go, timeout: 60 s}}", "{leader: {step: science, timeout: 20 s}}"
SCIENCE = f"shot=[{WAIT}, {{image: {{}}}}, {TURN}, {{image: {{}}}}]"
ASKED = "profile.devices.leader.light=asked"
REPLIES = {"your": "done", "light": "lit", "dark": "dark"}


def test_the_leader_switches_its_light_sees_each_image_and_does_its_science(tmp_path: Path) -> None:
    done_by_leader: list[Any] = []

    def lead(address: str) -> None:
        with Leader(port=int(address.rpartition(":")[2]), timeout_s=MAX_WAIT_S, each_image=True) as labseq:
            labseq.go()

            def see(image: Image) -> None:
                done_by_leader.append((image.name, int(image.occupancy.sum())))

            answer = labseq.wait(MAX_WAIT_S, see, done_by_leader.append, done_by_leader.append)
            assert answer.is_ready

    (shot,) = run_led(lead, tmp_path, SCIENCE, ASKED, shots=1).shots
    n_before, n_after = (int(seen.sum()) for seen in shot.occupancies)
    image = [("step_1_image", n_before), ("step_3_image", n_after)]
    # the light is turned off while labseq detects; the image may be known before that is answered
    assert [one for one in done_by_leader if not isinstance(one, float)] == [image[0], "science", image[1]]
    assert [one for one in done_by_leader if isinstance(one, float)] == [0.045, 0.0, 0.045, 0.0]
    assert shot.readings["leader.science"] == [""]


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        (["shot.2.leader.timeout=300 ms"], "its step 'science' is not done"),
        (
            ["profile.devices.leader.light=asked", "profile.devices.leader.light_timeout=300 ms"],
            "light is not on",
        ),
    ],
    ids=["step", "light"],
)
def test_a_shot_in_which_the_leader_does_not_reply_is_taken_again_at_its_next_go(
    overrides: list[str], reason: str, tmp_path: Path
) -> None:
    said: list[str] = []

    def lead(address: str) -> None:
        peer = TcpPeer(address, f"{token_file().read_text().strip()} version=3")
        peer.say("go")
        has_failed = False
        while line := peer.hear():
            said.append(line)
            word = line.partition(" ")[0]
            if word == "failed":
                has_failed = True
                peer.say("go")
            elif has_failed and word in REPLIES:
                peer.say(REPLIES[word])
            elif word == "ready":
                break
        peer.leave()

    done = run_led(lead, tmp_path, SCIENCE, *overrides, "attempts=1", shots=1)
    failures = [line for line in said if line.startswith("failed shot=0")]
    assert reason in failures[0]
    assert said[-1].startswith("ready shot=0"), "the machine has not failed: labseq waits for the next go"
    assert (done.status, len(done.attempts)) == ("complete", len(failures))


KILLED = """
import sys
import labseq_client
def stay(asked):
    print(asked, flush=True)
    sys.stdin.read()
with labseq_client.Leader(port=int(sys.argv[1]), timeout_s=60) as labseq:
    labseq.go()
    on_light = stay if sys.argv[2] == "light" else lambda exposure_s: None
    labseq.wait(60, on_step=stay, on_light=on_light)
"""


def close(address: str, word: str) -> None:
    """Begin a shot, and close the connection when labseq asks for this."""
    peer = TcpPeer(address, f"{token_file().read_text().strip()} version=3")
    peer.say("go")
    while (asked := peer.hear().partition(" ")[0]) != word:
        if asked in REPLIES:
            peer.say(REPLIES[asked])
    peer.leave()


def kill(address: str, word: str) -> None:
    """The same in a process that is killed."""
    command = [sys.executable, "-c", KILLED, address.rpartition(":")[2], word]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=FILE.parent, stdin=pipe, stdout=pipe) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        process.kill()


@pytest.mark.parametrize(
    ("leave", "word", "reason"),
    [
        (kill, "your", "its step 'science' is not done"),
        (kill, "light", "its imaging light is not on"),
        (close, "dark", "its imaging light may be on"),
    ],
)
def test_a_shot_whose_leader_leaves_fails_and_another_leader_begins_again(
    leave: Callable[[str, str], None],
    word: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    made_safe: set[type[Hardware]] = set()
    devices = {VirtualCamera, VirtualMobileTweezers, VirtualLines}
    for device in devices:

        def note(self: Any, safe_state: Callable[[Any], None] = device.safe_state) -> None:
            made_safe.add(type(self))
            safe_state(self)

        monkeypatch.setattr(device, "safe_state", note)

    def lead(address: str) -> None:
        leave(address, word)
        while not asked:
            try:
                with leader(address) as labseq:
                    labseq.go()
                    assert made_safe == devices, "before another shot can begin"
                    answer = labseq.wait(MAX_WAIT_S, on_step=asked.append, on_light=asked.append)
                    assert answer.is_ready, answer.reason
            except LabseqError:  # labseq has not noticed yet, or makes the devices safe
                continue

    done = run_led(lead, tmp_path, SCIENCE, ASKED, "attempts=1", shots=1)
    logged = [event["values"]["shot"]["error"] for event in events(done.path) if "repeated" in event["event"]]
    assert logged == [f"ShotAbortedError: leader: {reason}: the leader left before it answered"]
    assert asked == [0.045, 0.0, "science", 0.045, 0.0], "another leader answers for its own shot alone"
    assert (done.status, len(done.shots)) == ("complete", 1)


def test_a_dry_run_of_its_steps_and_its_light_needs_no_leader(tmp_path: Path) -> None:
    changes = [SCIENCE, ASKED]
    with Session.open(FOLLOW, dry_run="full", shots=1, seed=1, output=tmp_path, overrides=changes) as session:
        assert not [one for one in check(session).warnings if "deadline" in str(one)]
        assert session.run().shots[0].readings["leader.answer"] == ["ready"]


def test_a_leader_may_only_listen(tmp_path: Path) -> None:
    answers: list[Answer] = []

    def listen(address: str) -> None:
        with Leader(port=int(address.rpartition(":")[2]), timeout_s=MAX_WAIT_S, all_shots=True) as labseq:
            answers.append(labseq.wait(MAX_WAIT_S))

    done = run_led(listen, tmp_path, "shot.0={load: {duration: 2 s}}", "shot.2.rearrange.cycles=1", shots=1)
    assert (answers[0].is_ready, answers[0].file) == (True, str(done.shots[0].file))
    np.testing.assert_array_equal(answers[0].after, done.shots[0].occupancies[-1])


def test_python_asks_for_shots_one_by_one(tmp_path: Path) -> None:
    options: dict[str, Any] = {"shots": 3, "seed": 1, "output": tmp_path, "overrides": [MAY_SET]}
    with Session.open("compact_225", **options) as session:
        results = [session.shot({"target.rows": rows, "shot.2.rearrange.cycles": 2}) for rows in (9, 12)]
        with pytest.raises(ConfigError, match="target is 40 rows"):
            session.shot({"target.rows": 40})
        results.append(session.shot())
        with pytest.raises(ConfigError, match="has taken all its shots"):
            session.shot()
        assert session.run_dir is not None
    done = labseq.open_run(session.run_dir)
    assert done.status == "complete"
    for result, shot in zip(results, done.shots, strict=True):
        np.testing.assert_array_equal(result.occupancies, shot.occupancies)
        assert (result.index, result.file, result.success) == (shot.index, shot.file, shot.success)
        assert result.defects[-1] == shot.target.n_defects(shot.occupancies[-1])
    assert [shot.target.n_atoms for shot in done.shots] == [135, 180, 225]
    with Session.open("compact_225", output=tmp_path) as session, pytest.raises(ConfigError, match="may_set"):
        session.shot({"target.rows": 3})


def test_a_served_run_is_led_until_the_block_ends(tmp_path: Path) -> None:
    with labseq.serve(FOLLOW, seed=1, output=tmp_path, overrides=[ANY_PORT, PATIENT]) as served:
        client = leader(served.address)
        client.go()
        assert client.wait(MAX_WAIT_S).is_ready
        client.close()
    host, _, port = served.address.rpartition(":")
    with pytest.raises(ConnectionError):
        socket.create_connection((host, int(port)))
    done = labseq.open_run(served.run_dir)
    assert (done.status, len(done.shots)) == ("stopped", 1)
    alone = labseq.serve("compact_225", output=tmp_path)
    with pytest.raises(ConfigError, match="no device of the profile has an address"), alone:
        pass
