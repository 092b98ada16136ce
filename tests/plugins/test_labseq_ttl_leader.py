"""A leader at the timing box: `go` by an edge that is really put on the simulated pin."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from labseq_ttl.go_lines import HIGH, GoLines
from labseq_ttl.protocol import CHANNELS, OUTPUTS
from labseq_ttl.settings import GoSettings, TtlSettings
from pydantic import ValidationError

import labseq
from labseq.errors import StopRequested
from labseq.plugin import ConfigError, DeviceError, DeviceTimeoutError, LeaderLink, LineSpec
from labseq.sequencer.lines import line_program
from labseq.testing.contracts.instruments import SPECS
from tests.profiles import virtual_without_lines

from .labseq_ttl_rig import FIRMWARE, Firmware, make_rig

FREE = [channel for channel in CHANNELS if channel not in {spec.channel for spec in SPECS}]
BUSY, READY, FAILED = FREE[-3:]
GO = {"busy": BUSY, "ready": READY, "failed": FAILED, "deadline": 2.0}


@pytest.fixture(scope="module", params=[FIRMWARE])
def running() -> Generator[Firmware]:
    """One simulated processor for all tests."""
    firmware = Firmware()
    yield firmware
    firmware.close()


class Pins:
    """A leader's view of the firmware: `go`, and the levels of its outputs."""

    def __init__(self, firmware: Firmware, deadline_ms: int = 0) -> None:
        self.firmware = firmware
        firmware.simavr.reset()
        while not (firmware.line() or "").startswith("!boot"):
            pass
        firmware.ask("a polarity 0")
        self.lower()
        assert (
            firmware.ask(f"a lead {1 << BUSY:x} {1 << READY:x} {1 << FAILED:x} {deadline_ms:x}") == "a ok 00"
        )
        firmware.drop_course()

    def lower(self) -> None:
        self.firmware.simavr.lower()
        self.firmware.ask("a id")

    def go(self) -> str:
        self.firmware.simavr.start()
        return self.firmware.line() or ""

    def state(self) -> list[str]:
        return self.firmware.ask("a leader").split()[2:]

    def outputs(self) -> list[tuple[int, set[str]]]:
        """Clock cycle, and which of the leader's outputs were on from then on; "go" for its edge."""
        self.firmware.ask("a id")
        course: list[tuple[int, set[str]]] = []
        while (words := self.firmware.simavr._look(0.0)) is not None:
            if words[0] == "start":
                course.append((int(words[1]), {"go"}))
            elif words[0].isdecimal():
                levels = int(words[1], 16)
                pins = {"busy": BUSY, "ready": READY, "failed": FAILED}
                course.append((int(words[0]), {name for name, pin in pins.items() if levels >> pin & 1}))
        return course


def test_the_box_raises_busy_at_the_edge_and_the_answer_afterwards(running: Firmware) -> None:
    pins = Pins(running)
    assert pins.go().split()[2] == "0001"
    assert pins.state() == ["02", "0001", "00", "01"]
    assert running.ask("a answer 1") == "a ok 02 00"
    (went, go), (raised, busy), *_, (_, ready) = pins.outputs()
    assert (go, busy, ready) == ({"go"}, {"busy"}, {"ready"})
    assert (raised - went) / 16e6 < 50e-6
    pins.go()
    assert running.ask("a answer 0") == "a ok 02 00"
    assert [names for _, names in pins.outputs()][-1] == {"failed"}
    assert pins.state() == ["01", "0002", "00", "01"]


def test_an_edge_while_it_is_busy_is_reported_and_starts_nothing(running: Firmware) -> None:
    pins = Pins(running)
    pins.go()
    running.simavr.start()
    running.simavr.command("skip 160000")
    running.put(0, [(0, 4), (3000, 0)])
    running.ask("a arm 0 2")
    running.ask("a fire")
    assert (running.line() or "").startswith("!done")
    assert pins.state() == ["02", "0001", "01", "01"]
    assert running.ask("a answer 1") == "a ok 02 01"
    assert pins.state() == ["01", "0001", "00", "01"]
    assert pins.go().split()[2] == "0002"


def test_a_level_that_is_high_when_it_begins_to_listen_is_no_go(running: Firmware) -> None:
    pins = Pins(running)
    running.ask("a deaf")
    running.simavr.start()
    running.simavr.command("skip 160000")
    assert running.ask("a lead 0 40 80 0") == "a ok 01"
    assert pins.state() == ["01", "0000", "00", "01"]
    assert pins.go().split()[2] == "0001"


def test_the_box_keeps_the_deadline_by_itself(running: Firmware) -> None:
    pins = Pins(running, deadline_ms=500)
    pins.go()
    running.simavr.command("skip 16000000")
    while pins.state()[0] != "03":
        pass
    (went, _), (_, busy), *_, (failed_at, failed) = pins.outputs()
    assert (busy, failed) == ({"busy"}, {"busy", "failed"})
    assert 0.43 < (failed_at - went) / 16e6 <= 0.5
    assert running.ask("a answer 1") == "a ok 03 00"
    assert pins.outputs()[-1][1] == {"failed"}


def test_a_go_without_an_answer_has_failed_when_labseq_ends_or_is_silent(running: Firmware) -> None:
    pins = Pins(running)
    pins.go()
    running.ask("a deaf")
    assert pins.outputs()[-1][1] == {"failed"}
    assert running.ask("a answer 1") == "a no deaf"
    pins = Pins(running)
    pins.go()
    running.ask("a timeout 64")
    running.simavr.command("skip 4000000")
    assert (running.line() or "").startswith("!alone")
    assert pins.outputs()[-1][1] == {"failed"}
    running.ask("a timeout 0")


def test_a_program_cannot_wait_for_the_leaders_edge(running: Firmware) -> None:
    Pins(running)
    running.put(0, [(0, 4), (100, 0)])
    running.ask("a arm 0 2")
    assert running.ask("a await") == "a no led"


@pytest.mark.parametrize("after_ticks", [2_000, 131_000])
def test_an_edge_during_a_program_raises_busy_and_moves_no_edge(running: Firmware, after_ticks: int) -> None:
    pins = Pins(running)
    line = 1 << int(SPECS[0].channel)
    edges = [(0, 0), *((4_000 + 7 * i, line * (i % 2)) for i in range(22))]
    running.put(0, edges)
    running.ask(f"a arm 0 {len(edges):x}")
    running.drop_course()
    running.simavr.command(f"start {after_ticks * 8}")
    running.ask("a fire")
    assert [(running.line() or "").split()[0] for _ in range(2)] in (["!done", "!go"], ["!go", "!done"])
    course = [(cycle, levels or 0) for cycle, levels in running.simavr.course()]
    first = course[0][0]
    changes = [
        cycle - first
        for (cycle, levels), (_, before) in zip(course[1:], course, strict=False)
        if (levels ^ before) & line
    ]
    due, expected = 0, list[int]()
    for (ticks, mask), (_, before) in zip(edges[1:], edges, strict=False):
        due += 8 * ticks
        if mask != before:
            expected.append(due)
    assert len(changes) == len(expected)
    assert max(abs(came - wanted) for came, wanted in zip(changes, expected, strict=True)) <= 3
    assert any(levels >> BUSY & 1 for _, levels in course) or after_ticks > 90_000
    assert pins.state()[0] == "02"
    running.ask("a answer 1")


class Led:
    """The driver on a simulated box, with a leader that raises `go` by itself."""

    def __init__(self, **settings: Any) -> None:
        rig = make_rig(go=settings.pop("go", GO), **settings)
        assert isinstance(rig.lines, GoLines)
        assert isinstance(rig.lines, LeaderLink)
        self.lines, self.clock, self._rig = rig.lines, rig.clock, rig

    @property
    def box(self) -> Any:
        return self._rig.box


@pytest.fixture
def rig() -> Generator[Led]:
    made = Led()
    made.lines.open()
    yield made
    made.lines.close()


@pytest.mark.parametrize("box", ["model", FIRMWARE])
def test_go_comes_by_the_pin_and_is_answered(box: str) -> None:
    made = Led(box=box)
    made.lines.open()
    try:
        for state, n_go_signals in (("ready", 1), ("failed", 2)):
            assert made.lines.wait_for("go", 10.0) == ""
            assert made.lines._opened().leader().n_go_signals == n_go_signals
            assert made.lines.report(state, {"shot": 0}) == state
            assert made.lines.report(state, {"shot": 0}) == ""  # it has its answer
            if box == "model":
                assert made.box.signals == 1 << (READY if state == "ready" else FAILED)
    finally:
        made.lines.close()


def test_safe_state_leaves_the_leader_its_outputs_and_it_is_reported(rig: Led) -> None:
    rig.lines.wait_for("go", 10.0)
    rig.lines.safe_state()
    assert (rig.box.on, rig.box.signals) == (0, 1 << BUSY)
    assert rig.lines.report("failed", {}) == "failed"


def test_a_shot_that_is_late_is_reported_once(rig: Led) -> None:
    assert not isinstance(make_rig().lines, LeaderLink)
    rig.lines.wait_for("go", 10.0)
    rig.box.pass_deadline()
    assert rig.box.signals == 1 << BUSY | 1 << FAILED
    assert rig.lines.report("ready", {}) == "late"
    assert rig.box.signals == 1 << FAILED
    assert "not over at the deadline" in rig.lines.new_events()[-1]


class NoLeader(Led):
    """A box like a real one: only the test raises `go`."""

    def __init__(self) -> None:
        super().__init__()
        self.lines.open()
        self.lines.access.raise_go = lambda timeout_s: timeout_s  # type: ignore[method-assign]


def test_a_go_that_came_too_early_has_failed_and_the_next_counts() -> None:
    made = NoLeader()
    made.box.start()
    made.box.pass_deadline()
    with pytest.raises(DeviceTimeoutError, match=r"no rising edge .* within 100 ms \(it is high"):
        made.lines.wait_for("go", 0.1)
    assert "no step waited for `go`" in made.lines.new_events()[-1]
    assert made.box.signals == 1 << FAILED
    made.box.start()
    assert made.lines.wait_for("go", 1.0) == ""
    made.clock.stop.request()
    with pytest.raises(StopRequested):
        made.lines.wait_for("go", 60.0)
    with made.clock.stop.held():
        made.lines.close()


def test_a_go_that_never_comes_is_reported_with_the_level_of_the_input() -> None:
    made = NoLeader()
    assert made.lines.new_events() == [HIGH]
    made.box.lower()
    with pytest.raises(DeviceTimeoutError, match=r"no rising edge .* within 100 ms \(it is low\);"):
        made.lines.wait_for("go", 0.1)
    made.lines.close()


def test_a_word_of_the_box_that_got_lost_is_asked_for() -> None:
    made = NoLeader()
    made.box.start()
    made.box.reset_input_buffer()
    assert made.lines.wait_for("go", 1.0) == ""
    made.lines.close()


def test_a_reset_in_a_shot_is_an_error_and_the_leader_receives_failed() -> None:
    made = NoLeader()
    made.box.start()
    made.lines.wait_for("go", 1.0)
    made.box.reset()
    with pytest.raises(DeviceError, match="the box was reset"):
        made.lines.compile(line_program(SPECS, "image", 1e-3))
    made.lines.safe_state()
    assert made.lines.report("failed", {}) == "failed"
    assert made.box.signals == 1 << FAILED
    made.lines.close()


def test_an_edge_while_labseq_is_busy_is_refused_and_reported(rig: Led) -> None:
    rig.lines.wait_for("go", 10.0)
    rig.box.start()
    rig.lines.report("ready", {})
    assert rig.lines.new_events()[-1] == "`go` came while labseq was busy, and was refused"
    assert rig.lines._opened().leader().n_go_signals == 1


def test_an_unknown_signal_and_a_closed_box_are_refused() -> None:
    made = Led()
    with pytest.raises(DeviceError, match="not open"):
        made.lines.wait_for("go", 1.0)
    made.lines.open()
    with pytest.raises(DeviceError, match="unknown signal 'start'; expected 'go'"):
        made.lines.wait_for("start", 1.0)
    made.lines.close()
    made.lines.close()


@pytest.mark.parametrize(
    ("go", "message"),
    [
        ({"ready": 5}, "'failed' has no output"),
        ({"ready": 5, "failed": 5}, "'ready' and 'failed' are both on output 5"),
        ({"ready": 5, "failed": 8}, "expected an output of the box"),
    ],
)
def test_wrong_outputs_are_refused(go: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GoSettings.model_validate(go)


def test_outputs_that_are_lines_are_refused() -> None:
    with pytest.raises(ConfigError, match=rf"on channel {READY}, which is 'ready' of the leader"):
        make_rig((LineSpec("mot", READY, ("load",)),), go=GO)


def test_outputs_may_be_active_low() -> None:
    driver: Any = make_rig(go={**GO, "active_low": True}).lines
    assert driver._polarity & OUTPUTS >= 1 << BUSY | 1 << READY | 1 << FAILED


def test_the_start_input_is_for_one_of_two() -> None:
    with pytest.raises(ValidationError, match="`go` and start programs"):
        TtlSettings.model_validate({"port": "/dev/ttyACM0", "start": "external", "go": GO})


ROOT = Path(__file__).parents[2]


def test_a_run_is_led_through_the_box(tmp_path: Path) -> None:
    text = virtual_without_lines()
    profile = tmp_path / "led.yaml"
    lines = "{use: ttl, go: {busy: 5, ready: 6, failed: 7}, channels: {mot: {channel: 3, on: [load]}}}"
    profile.write_text(f"{text}\nlines: {lines}\n", "utf-8")
    sequence = tmp_path / "s.yaml"
    follow = (ROOT / "sequences" / "follow.yaml").read_text("utf-8")
    sequence.write_text(follow.replace("profile: follower", "profile: ./led.yaml"), "utf-8")
    with labseq.Session.open(sequence, shots=2, seed=1, output=tmp_path / "data") as session:
        run = session.run()
    assert run.status == "complete"
    for shot in run.shots:
        assert list(shot.readings["lines.answer"]) == ["ready"]
        assert shot.filling_fraction > 0.9
