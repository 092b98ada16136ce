"""The firmware of the timing box, run by simavr: its edges cycle by cycle, and what it does with any line."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Generator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from labseq_ttl.lines import LATENCY_S
from labseq_ttl.protocol import CHANNELS, EDGES, OUTPUTS, SHORTEST, SLOTS, framed, unframed
from labseq_ttl_sim.model import ModelBox

from .labseq_ttl_rig import FIRMWARE as WITH_FIRMWARE, Firmware
from .labseq_ttl_simavr import APART_CYCLES, CYCLES_PER_TICK, FIRMWARE

CLOCK_HZ = 16e6
ERROR_CYCLES = 3
"""What the polling loop (2) and the second port (1) make of an edge: 0.19 us."""

masks = st.lists(st.sampled_from(CHANNELS), unique=True).map(lambda on: sum(1 << channel for channel in on))
programs = st.lists(
    st.tuples(st.one_of(st.integers(SHORTEST, 80), st.integers(SHORTEST, 100_000)), masks),
    min_size=EDGES - 1,
    max_size=EDGES - 1,
)
any_bytes = st.binary(max_size=200)
few = settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module", params=[WITH_FIRMWARE])
def running() -> Generator[Firmware]:
    """One simulated processor for all tests."""
    firmware = Firmware()
    yield firmware
    firmware.close()


@pytest.fixture
def firmware(running: Firmware) -> Firmware:
    """After a reset."""
    running.ask("a polarity 0")
    running.simavr.reset()
    while not (running.line() or "").startswith("!boot"):
        pass
    running.drop_course()
    return running


def play(firmware: Firmware, edges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Play a program; cycles since the first edge, and levels of the outputs from then on."""
    firmware.put(0, edges)
    assert firmware.ask(f"a arm 0 {len(edges):x}").startswith("a ok")
    assert firmware.ask("a fire") == "a ok"
    assert (firmware.line() or "").startswith("!done")
    course = firmware.simavr.course()
    return [(cycle - course[0][0], (levels or 0) & OUTPUTS) for cycle, levels in course]


def levels_at(course: list[tuple[int, int]], cycle: int) -> int:
    return [levels for at, levels in course if at <= cycle][-1]


def assert_on_time(course: list[tuple[int, int]], edges: list[tuple[int, int]], polarity: int = 0) -> None:
    """Shortly after each edge the outputs are as planned, and shortly before as before."""
    due, before = 0, edges[0][1]
    for ticks, mask in edges:
        due += ticks * CYCLES_PER_TICK
        if due:
            assert levels_at(course, due - ERROR_CYCLES) == before ^ polarity
        assert levels_at(course, due + ERROR_CYCLES) == mask ^ polarity
        before = mask
    assert len(course) <= 2 * len(edges)


@few
@given(rest=programs, first=masks, polarity=masks)
def test_every_edge_of_any_program_is_on_time(
    running: Firmware, rest: list[tuple[int, int]], first: int, polarity: int
) -> None:
    assert running.ask(f"a polarity {polarity:x}") == "a ok"
    edges = [(0, first), *rest]
    assert_on_time(play(running, edges), edges, polarity)


def test_edges_stay_on_time_over_seconds(firmware: Firmware) -> None:
    edges = [(0, 4), (1_000_000, 8), (SHORTEST, 0x1EFC), (999_999, 0), (20_000_001, 0x200), (SHORTEST, 0)]
    assert_on_time(play(firmware, edges), edges)


def test_edges_as_near_as_they_may_be_are_on_time(firmware: Firmware) -> None:
    edges = [(0, 4), *((SHORTEST, 0x1EFC if i % 2 else 0) for i in range(EDGES - 1))]
    assert_on_time(play(firmware, edges), edges)


def test_every_distance_around_the_ones_that_change_its_ways_is_kept(firmware: Firmware) -> None:
    for around in (32, 64, 0x4000, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x18000):
        edges = [(0, 0), *((around - 11 + i, 0x204 if i % 2 else 0) for i in range(EDGES - 1))]
        assert_on_time(play(firmware, edges), edges)


def test_the_two_ports_switch_one_cycle_after_the_other(firmware: Firmware) -> None:
    course = play(firmware, [(0, 0), (100, OUTPUTS), (100, 0)])
    changes = [cycle for (_, before), (cycle, after) in pairwise(course) if before != after]
    assert [b - a for a, b in zip(changes[::2], changes[1::2], strict=True)] == [1, 1]
    assert APART_CYCLES > 1


def test_the_latency_is_as_the_driver_says(firmware: Firmware) -> None:
    firmware.put(0, [(0, 4), (100, 0)])
    firmware.ask("a arm 0 2")
    firmware.ask("a fire")
    received = first = 0
    while not first:
        word, value = firmware.simavr._next_line()
        if word == "line":
            received = int(value)
        elif int(value, 16) & 0x2000:
            first = int(word)
    assert 0.5 * LATENCY_S < (first - received) / CLOCK_HZ <= LATENCY_S


def test_a_program_begins_a_fixed_time_after_the_start_input(firmware: Firmware) -> None:
    latencies: list[int] = []
    for _ in range(5):
        firmware.put(0, [(0, 4), (100, 0)])
        firmware.ask("a arm 0 2")
        assert firmware.ask("a await") == "a ok"
        firmware.write(b"deaf until it is over\n")
        firmware.simavr.start()
        assert (firmware.line() or "").startswith("!done")
        start = first = 0
        while not first:
            word, value = firmware.simavr._next_line()
            if word == "start":
                start = int(value)
            elif word.isdecimal() and int(value, 16) & 0x2000:
                first = int(word)
        firmware.drop_course()
        latencies.append(first - start)
    assert max(latencies) - min(latencies) <= CYCLES_PER_TICK + ERROR_CYCLES
    assert 20e-6 < min(latencies) / CLOCK_HZ < 22e-6


def test_the_stop_byte_ends_a_program_in_its_middle(firmware: Firmware) -> None:
    firmware.put(0, [(0, 0x14), (2_000_000, 0)])
    firmware.ask("a polarity 10")
    firmware.ask("a arm 0 2")
    firmware.drop_course()
    firmware.write(framed("a fire") + b"\n" * 400 + b"!")
    assert firmware.line() == "a ok"
    assert firmware.line() == f"!off {firmware.ask('a state').split()[3]}"
    course = firmware.simavr.course()
    after = firmware.simavr._next_line()
    assert [(levels or 0) & OUTPUTS for _, levels in course][-1] == 0x04
    assert int(after[1], 16) & OUTPUTS == 0x10 or int(firmware.simavr._next_line()[1], 16) & OUTPUTS == 0x10
    assert firmware.ask("a state").split()[2:] == ["idle", *firmware.ask("a state").split()[3:]]
    assert firmware.ask("a fire") == "a no unarmed"


def test_all_lines_are_at_their_off_levels_from_a_reset_on(firmware: Firmware) -> None:
    firmware.ask("a polarity 204")
    firmware.ask("a serial 2a")
    firmware.ask("a set 1efc")
    firmware.drop_course()
    firmware.simavr.reset()
    assert (firmware.line() or "").startswith("!boot")
    words = [firmware.simavr._next_line() for _ in range(3)]
    assert words[0][0] == "reset"
    assert int(words[-1][1], 16) & OUTPUTS == 0x204
    assert firmware.ask("a state").split()[-2:] == ["0000", "0204"]
    assert firmware.ask("a id").split()[4] == "002a"


def test_the_watchdog_resets_a_firmware_that_hangs(firmware: Firmware) -> None:
    firmware.ask("a set 14")
    firmware.simavr.command("hang")
    said = firmware.line() or ""
    assert re.fullmatch(r"!boot [0-9a-f]{4} 08", said)
    assert firmware.ask("a state").split()[-2] == "0000"


def test_a_box_that_hears_nothing_turns_all_lines_off(firmware: Firmware) -> None:
    firmware.ask("a set 14")
    firmware.ask("a timeout 64")
    firmware.simavr.command("skip 4000000")
    assert (firmware.line() or "").startswith("!alone")
    assert firmware.ask("a state").split()[-2] == "0000"
    firmware.ask("a timeout 0")
    firmware.ask("a set 14")
    firmware.simavr.command("skip 4000000")
    assert firmware.ask("a state").split()[-2] == "0014"


@few
@given(st.lists(any_bytes, max_size=8))
def test_no_bytes_hang_it(running: Firmware, noise: list[bytes]) -> None:
    for part in noise:
        running.write(part.replace(b"!", b"?"))
    running.write(b"\n")
    assert running.ask("z id").startswith("z ok labseq-ttl 02")


hexes = st.integers(0, 2**34).map(lambda n: f"{n:x}") | st.sampled_from(["0", "7", "a", "18", "204", "g", ""])
arguments = st.lists(hexes, max_size=6).map(" ".join)
names = st.sampled_from([*(name for name in ModelBox()._commands if name != "await"), "bogus", ""])
edge_words = st.tuples(st.integers(0, 2000), masks).map(lambda edge: f"{edge[0]:x} {edge[1]:x}")
sensible = st.one_of(
    st.tuples(st.integers(0, SLOTS), st.integers(0, 3), st.lists(edge_words, min_size=1, max_size=3)).map(
        lambda put: f"put {put[0]:x} {put[1]:x} {' '.join(put[2])}"
    ),
    st.tuples(st.sampled_from(["get", "arm"]), st.integers(0, SLOTS), st.integers(0, 4)).map(
        lambda words: " ".join(map(str, words))
    ),
    st.sampled_from(["fire", "state", "off", "set 4", "id"]),
    st.sampled_from(["lead 20 40 80 0", "lead 0 40 0 fffff", "answer 1", "answer 0", "deaf", "leader"]),
)
questions = st.one_of(sensible, st.tuples(names, arguments).map(" ".join).map(str.strip))


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(asked=st.lists(questions, max_size=12))
def test_the_model_answers_as_the_firmware_does(running: Firmware, asked: list[str]) -> None:
    model = ModelBox()
    fresh = [f"put {slot:x} 0 0 0" for slot in range(SLOTS)]
    ready = ["polarity 0", "serial 0", "timeout 0", "off", "deaf", *fresh]
    for question in (*ready, *(q for q in asked if len(framed(f"a {q}")) < 96)):
        assert plain(running.ask(f"a {question}")) == plain(ask(model, f"a {question}")), question


def ask(model: ModelBox, question: str) -> str:
    model.read(4096)
    model.write(framed(question))
    return unframed(model.read(4096).split(b"\n")[0]) or ""


def plain(answer: str) -> str:
    """Without what only the one or the other has done in its life."""
    words = answer.split()
    if words[1:3] == ["ok", "labseq-ttl"]:
        del words[5:]
    elif words[2:3] in (["idle"], ["armed"]):
        del words[3:5]
    elif len(words) == 3 and len(words[2]) == 4:  # arm
        del words[2]
    return " ".join(words)


@pytest.mark.parametrize("end", ["edge", "stop"])
def test_the_model_waits_for_its_start_as_the_firmware_does(firmware: Firmware, end: str) -> None:
    model = ModelBox()
    for question in ("put 0 0 0 4 64 0", "arm 0 2", "await"):
        assert plain(firmware.ask(f"a {question}")) == plain(ask(model, f"a {question}"))
    for box in (firmware, model):
        box.write(framed("a set 4"))  # it is deaf until the edge
    if end == "edge":
        firmware.simavr.start()
        model.start()
    else:
        firmware.write(b"!")
        model.write(b"!")
    said = firmware.line() or ""
    assert said.split()[0] == (unframed(model.read(4096).split(b"\n")[0]) or "").split()[0]
    assert said.startswith("!done" if end == "edge" else "!off")
    for question in ("state", "fire"):
        assert plain(firmware.ask(f"a {question}")) == plain(ask(model, f"a {question}"))


PROTOCOL = Path(FIRMWARE).with_name("PROTOCOL.md").read_text()


def test_the_examples_of_the_protocol_are_true() -> None:
    model = ModelBox()
    model.read(4096)
    said: list[str] = []
    for direction, line in re.findall(r"^([<>]) (.*)$", PROTOCOL, re.MULTILINE):
        if direction == ">":
            assert not said
            model.write(f"{line}\n".encode())
            said = model.read(4096).decode().splitlines()
        else:
            assert line == said.pop(0)
    assert not said


def test_the_protocol_names_every_command() -> None:
    assert set(re.findall(r"^\| `([a-z]+)", PROTOCOL, re.MULTILINE)) == set(ModelBox()._commands)


@pytest.mark.needs("avr-gcc")
def test_the_firmware_is_that_of_its_source(tmp_path: Path) -> None:
    version = subprocess.run(["avr-gcc", "-dumpversion"], capture_output=True, text=True, check=True).stdout
    if not version.startswith("5.4"):
        pytest.skip(f"labseq_ttl.hex was built by avr-gcc 5.4, not {version.strip()}")
    for source in (*FIRMWARE.parent.glob("*.[ch]"), FIRMWARE.with_name("Makefile")):
        shutil.copy(source, tmp_path)
    subprocess.run(["make", "-s", "-C", str(tmp_path)], check=True)
    assert (tmp_path / FIRMWARE.name).read_bytes() == FIRMWARE.read_bytes(), "run `make` in its folder"
