"""Whole runs that another control system leads."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq import ConfigError, DeviceTimeoutError, Session, StopRequested
from labseq.config.yaml_nodes import compose
from labseq.session.check import check

from .labseq_follow_rig import TcpPeer

ROOT = Path(__file__).parents[2]
FOLLOW = ROOT / "sequences" / "follow.yaml"
ANY_PORT = "profile.devices.leader.port=0"
PATIENT = "profile.devices.leader.deadline=60 s"
LOST = "profile.camera={use: virtual, readout: 5 ms, faults: {transient: 1.0}}"
SMALL = "target={pattern: compact, rows: 3, cols: 3}"
NO_LEADER = "follow.yaml:12:17: the profile has no device that receives signals of another control system"
GUIDE = (ROOT / "docs" / "how-to" / "follow.md").read_text()
PROGRAMS = re.findall(r"^```python\n(.*?)^```$", GUIDE, re.DOTALL | re.MULTILINE)


class Led:
    """Observer that lets somebody lead once labseq listens, in a thread of its own.

    Args:
        lead: Given labseq's address.
        stop_at: Event at which the run is asked to stop.
    """

    def __init__(self, lead: Callable[[str], object], stop_at: str = "") -> None:
        self.session: Session | None = None
        self.thread: threading.Thread | None = None
        self._lead = lead
        self._stop_at = stop_at

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        assert self.session is not None
        if name == "run_started":
            devices = json.loads(Path(values["run_dir"], "run.json").read_text())["devices"]
            self.thread = threading.Thread(target=self._lead, args=(devices["leader"]["address"],))
            self.thread.start()
        if name == self._stop_at:
            self.session.stop_flag.request()


def run_led(
    lead: Callable[[str], object], folder: Path, *overrides: str, shots: int = 2, stop_at: str = ""
) -> labseq.Run:
    observer = Led(lead, stop_at)
    options: dict[str, Any] = {"shots": shots, "seed": 1, "output": folder, "observer": observer}
    with Session.open(FOLLOW, overrides=[ANY_PORT, PATIENT, *overrides], **options) as session:
        observer.session = session
        try:
            return session.run()
        finally:
            if observer.thread is not None:
                observer.thread.join()


def events(run_dir: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run_dir / "events.jsonl").read_text().splitlines()]


def test_the_leader_of_the_guide_drives_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, *_ = PROGRAMS

    def lead(address: str) -> None:
        exec(code.replace("5750", address.rpartition(":")[2]).replace("shots(3)", "shots(2)"), {})

    done = run_led(lead, tmp_path, shots=2)
    said = [line for line in capsys.readouterr().out.splitlines() if line]
    assert done.status == "complete"
    assert said == [
        f"ready shot={shot.index} success={int(shot.success)} filling={shot.filling_fraction:.4g}"
        for shot in done.shots
    ]
    assert [shot.file.name for shot in done.shots] == ["shot_000000.h5", "shot_000001.h5"]
    assert [shot.readings["leader.go"] for shot in done.shots] == [["0"], ["1"]]
    assert [shot.readings["leader.answer"] for shot in done.shots] == [["ready"]] * 2
    assert min(shot.filling_fraction for shot in done.shots) > 0.94
    logged = [event["values"].get("text", "") for event in events(done.path)]
    assert "go 1" in logged
    assert any(re.fullmatch(r"127\.0\.0\.1:\d+ leads", text) for text in logged)


def test_the_client_of_the_guide_drives_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, code, *_ = PROGRAMS

    def lead(address: str) -> None:
        exec(code.replace("Leader()", f"Leader(port={address.rpartition(':')[2]})"), {})

    (shot,) = run_led(lead, tmp_path, shots=1).shots
    first, *rows = capsys.readouterr().out.splitlines()
    assert first == f"0 {shot.file} {shot.target.n_defects(shot.occupancies[-1])}"
    assert len(rows) > 5


def test_a_run_that_is_stopped_tells_its_leader_why(tmp_path: Path) -> None:
    said: list[str] = []

    def lead(address: str) -> None:
        peer = TcpPeer(address)
        said.extend([peer.hear(), peer.ask("go"), peer.hear(), peer.hear()])
        peer.leave()

    with pytest.raises(StopRequested):
        run_led(lead, tmp_path, stop_at="image")
    assert said == ["hello labseq 3 deadline=60", "busy", "failed shot=0 reason=stopped by Ctrl-C", ""]


def test_a_shot_that_fails_tells_its_leader_why(tmp_path: Path) -> None:
    said: list[str] = []

    def lead(address: str) -> None:
        peer = TcpPeer(address)
        said.extend([peer.hear(), peer.ask("go"), peer.hear(), peer.ask("go"), peer.hear(), peer.hear()])
        peer.leave()

    with pytest.raises(labseq.TransientError):
        run_led(lead, tmp_path, LOST, "attempts=2")
    first, second = said[2], said[4]
    assert [said[1], said[3], said[5]] == ["busy", "busy", ""]
    for answer in (first, second):
        assert answer.startswith("failed shot=0 reason=")
        assert "frame" in answer, "it says what was lost"


def test_a_go_that_never_comes_ends_the_run_in_the_safe_state(tmp_path: Path) -> None:
    overrides = [ANY_PORT, "shot.0.wait.timeout=50 ms"]
    with Session.open(FOLLOW, output=tmp_path, overrides=overrides) as session:
        with pytest.raises(DeviceTimeoutError, match=r"no 'go' within 50 ms .*no leader") as caught:
            session.run()
        assert caught.value.exit_code == 3
        assert session.run_dir is not None
        made_safe = [e["values"]["ok"] for e in events(session.run_dir) if e["event"] == "safe_state"]
        # camera, both tweezers and lines; leader, shutter and synthesizer
        assert made_safe == [True] * 7


def test_a_dry_run_needs_no_leader_and_no_time(tmp_path: Path) -> None:
    with Session.open(FOLLOW, dry_run="full", shots=2, seed=1, output=tmp_path) as session:
        done = session.run()
        assert session.assembly.virtual_time
    assert [shot.readings["leader.answer"] for shot in done.shots] == [["ready"], ["ready"]]
    assert all(shot.occupancies[0].mean() > 0.6 for shot in done.shots), "the leader has loaded"


def test_a_second_wait_does_not_load_again(tmp_path: Path) -> None:
    second = "shot.3={wait: {for: go, timeout: 10 s}}"
    with Session.open(
        FOLLOW, dry_run="full", shots=1, seed=1, output=tmp_path, overrides=[second]
    ) as session:
        done = session.run()
    assert done.shots[0].readings["leader.answer"] == ["ready", "ready"]
    assert done.shots[0].readings["simulation.n_defects_true"] < 10, "the atoms are those that were moved"


@pytest.mark.parametrize(
    ("overrides", "dry_run", "message"),
    [
        (
            ["profile.devices={shutter: {use: virtual}}"],
            "off",
            f"{NO_LEADER}; add `leader: {{use: tcp_leader}}` to its `devices`",
        ),
        ([], "fast", "a full dry run simulates it and sends `go`, a fast dry run leaves it out"),
        (["shot.0.wait.device=shutter"], "off", "'shutter' cannot receive signals of another control system"),
        (
            ["shot.0.wait.device=artiq"],
            "off",
            "'artiq' cannot receive signals of another control system; expected 'leader'",
        ),
    ],
)
def test_who_cannot_lead_is_reported_before_anything_is_opened(
    overrides: list[str], dry_run: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        check(Session.open(FOLLOW, overrides=overrides, dry_run=dry_run, output=tmp_path))
    assert not [*tmp_path.iterdir()]


def test_a_deadline_that_a_shot_may_miss_is_a_warning() -> None:
    with Session.open(FOLLOW, overrides=[SMALL, "profile.devices.leader.deadline=1 s"]) as session:
        (warning,) = check(session).warnings
    facts = ("follow.yaml:12:17: ", "1.2 s", "'leader'", "within 1 s", "raise 'deadline'")
    assert all(fact in str(warning) for fact in facts)


def test_the_profile_is_the_virtual_lab_with_a_leader() -> None:
    folder = ROOT / "hardware_profiles"
    ours, virtual = (compose((folder / f"{name}.yaml").read_text(), "") for name in ("follower", "virtual"))
    assert ours is not None
    assert virtual is not None
    led = ours.plain()
    del led["devices"]["leader"]
    assert led | {"name": "virtual"} == virtual.plain()


def test_the_guide_names_every_line_of_the_protocol() -> None:
    source = (ROOT / "plugins" / "labseq_follow" / "protocol.py").read_text()
    for word in re.findall(r'"reason": "([^"]+)"', source):
        assert f"failed reason={word}" in GUIDE
