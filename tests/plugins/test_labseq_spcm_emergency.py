"""A simulated card outlives the process that dies, and a plain Python process switches it off."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from labseq_soapy_sim import Ring
from labseq_spcm import emergency as script
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import M4I6622, M4I6631, SampleSpan, SimulatedCard, installed, registers as r
from labseq_spcm_sim.library import _library
from labseq_spcm_sim.setup import Refusal

from labseq.plugin import Context, DeviceError
from labseq.testing.fakes import FakeClock

from .card_process import PLUGIN, TweezersOfProcess
from .card_process_emergency import ADDRESS, Connection
from .emergency import Done, outsider
from .labseq_soapy_rig import until
from .small_run import PROFILE, SEQUENCE

LABSEQ = """
import json, sys, threading
import numpy as np
from labseq.motion import tone_program
from labseq.plugin import Context, MotionSpec, Plan, SiteGrid
from labseq.plugin.motion import RfSpec
from labseq_spcm import card, replay_fifo
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream
from tests.plugins.card_process import TweezersOfProcess

# samples go through a pipe to another process: slow, and slower where others are busy
card.TRANSFER_TIMEOUT_S = replay_fifo.TRANSFER_TIMEOUT_S = 60.0
Stream._check_bus = lambda self: None
SpcmSettings.look_ahead_s = lambda self, rate_hz: 0.1
tones = np.linspace(12e6, 18e6, 5)
grid = SiteGrid(5, 5, row_frequency_hz=tones, column_frequency_hz=tones)
band = (10e6, 20e6)
plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, 1), (0, 3)])] * 75)

def tweezers(state, mode, speed_m_s, n_batches, trigger="software", fill=0.1, keep_warm=None):
    rf = RfSpec(row_band_hz=band, column_band_hz=band)
    motion = MotionSpec(speed_m_s=speed_m_s, eject_slots=0, rf=rf)
    card = f"simulated@{sys.argv[1]}/{state}"
    settings = dict(card=card, mode=mode, sample_rate=50e6, trigger=trigger, fill=fill, keep_warm=keep_warm)
    settings = SpcmSettings.model_validate(settings)
    device = TweezersOfProcess(settings, Context("mobile_tweezers", grid, motion=motion))
    device.open()
    if n_batches:
        device.prepare(tone_program(plan, grid, motion, n_batches))
    return device

parked = {"row_frequency": 10e6, "column_frequency": 10e6}
devices = {
    # it plays for 1 s after the kill, which is longer than the script takes
    "fifo": tweezers("fifo", "fifo", 1e-5, 75, fill=0.8),
    "armed": tweezers("armed", "replay", 0.130, 2, "external"),
    "played": tweezers("played", "replay", 0.130, 1),
    "locked": tweezers("locked", "fifo", 1e-5, 50),
    "sequence": tweezers("sequence", "sequence", 1.5e-5, 1, keep_warm=parked),  # it never ends
    "replay": tweezers("replay", "replay", 1.5e-5, 1),  # played last: its program lasts for 0.3 s
}
idle = {
    "prepared": tweezers("prepared", "replay", 0.130, 1),
    "stream": tweezers("stream", "stream", 0.130, 0, keep_warm=parked),  # a program could run dry
}
jobs = {
    state: (str(found.script), dict(found.arguments))
    for state, device in {**devices, **idle}.items()
    if (found := device.emergency())
}
print(json.dumps(jobs), flush=True)
sys.stdin.readline()
idle["stream"].settle()
for device in devices.values():
    device.play()
threading.Thread(target=devices["fifo"].wait, args=(1e3,), daemon=True).start()
devices["played"].wait(60.0)
card = devices["locked"]._card
assert card.spcm.spcm_dwSetParam_i64(card._handle, 30010, 9000) == 0x101  # blocks the driver library
print("on", flush=True)
sys.stdin.read()
"""
STATES = {"prepared", "armed", "played", "locked", "replay", "sequence", "fifo", "stream"}
OFF = "card stopped, outputs 0 and 1 disabled"


class Scope:
    """The cards after the process that used them was killed, and after ``off`` from outside, twice."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-c", LABSEQ, str(folder)]
        labseq = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert labseq.stdin is not None
        assert labseq.stdout is not None
        jobs = json.loads(labseq.stdout.readline())
        self.cards = {state: Connection(str(folder / state)) for state in jobs}
        with outsider(jobs) as outside:
            self.heavy_modules = outside.heavy_modules
            labseq.stdin.write("play\n")
            labseq.stdin.flush()
            assert labseq.stdout.readline() == "on\n"
            labseq.kill()
            labseq.communicate()
            self.after_death = {state: card("state") for state, card in self.cards.items()}
            self.off: dict[str, Done] = outside.off()
            self.writes = {state: card("log") for state, card in self.cards.items()}
            self.again: dict[str, Done] = outside.off()

    def end_s(self, state: str, channel: int) -> float:
        """When the output of a channel ended; before the kill if it was silent then."""
        spans: list[SampleSpan] = self.cards[state]("played", channel)
        return max((span.end_s for span in spans), default=0.0)


@pytest.fixture(scope="module")
def scope(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scope]:
    scope = Scope(tmp_path_factory.mktemp("computer"))
    yield scope
    scope.cards["fifo"]("power_off")


def test_a_card_goes_on_after_the_process_has_died(scope: Scope) -> None:
    """The reason for all of this: without the script the relays stay closed, and an edge starts a card."""
    assert set(scope.after_death) == STATES
    assert {relays for _, relays in scope.after_death.values()} == {(True, True)}
    running = {"fifo": True, "sequence": True, "armed": True, "played": False, "prepared": False}
    for state, is_running in running.items():
        assert scope.after_death[state][0] == is_running


@pytest.mark.parametrize("state", sorted(STATES))
def test_a_plain_process_brings_its_outputs_to_zero(scope: Scope, state: str) -> None:
    done = scope.off[state]
    assert done.text == OFF
    assert scope.cards[state]("state") == (False, (False, False))
    assert not scope.cards[state]("trigger", 3.3), "an edge at Ext0 starts nothing any more"
    for channel in (0, 1):
        end_s = scope.end_s(state, channel)
        assert end_s <= done.end_s
        if state in ("fifo", "sequence"):
            assert end_s > done.start_s, "it played until then"
    assert scope.again[state].text == done.text, "it can be repeated"
    assert not scope.heavy_modules


def test_the_script_stops_the_card_first_and_writes_the_set_up_to_open_the_relays(scope: Scope) -> None:
    mine = [
        (entry.register, entry.value)
        for entry in scope.writes["fifo"]
        if scope.off["fifo"].start_s <= entry.time_s <= scope.off["fifo"].end_s
    ]
    assert mine == [
        (r.SPC_M2CMD, r.M2CMD_CARD_STOP | r.M2CMD_DATA_STOPDMA),
        (r.SPC_AMP0, M4I6631.amplitude_mv[0]),
        (r.SPC_AMP1, M4I6631.amplitude_mv[0]),
        (r.SPC_ENABLEOUT0, 0),
        (r.SPC_ENABLEOUT1, 0),
        (r.SPC_M2CMD, r.M2CMD_CARD_WRITESETUP),
        (r.SPC_M2CMD, r.M2CMD_CARD_RESET),
    ]


def test_its_numbers_are_those_of_the_vendor() -> None:
    names = [name for name in vars(script) if name.startswith(("SPC", "M2"))]
    assert len(names) == 9
    assert {name: getattr(script, name) for name in names} == {name: getattr(r, name) for name in names}


CARD = "simulated card"
LIBRARY = "libspcm_that_is_not_installed.so"


def test_a_missing_library_and_wrong_arguments_give_one_clear_line() -> None:
    path = str(Path(script.__file__))
    jobs = {
        "library": (path, {"library": LIBRARY, "card": "/dev/spcm0"}),
        "name": (path, {"library": LIBRARY, "card": 0}),
        "argument": (path, {"crad": "/dev/spcm0"}),
    }
    with outsider(jobs) as outside:
        done = outside.off()
    prepared: dict[str, Any] = outside.prepared
    for name, fact in (("library", repr(LIBRARY)), ("name", "is 0; expected"), ("argument", "'crad'")):
        assert fact in prepared[name]
        assert "\n" not in prepared[name]
        assert name == "argument" or done[name].text == prepared[name]


C_LIBRARY = """
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#define CARD ((void *)0x7fff12345678)
typedef int32_t i32;
typedef uint32_t u32;
void *spcm_hOpen(const char *name) { return strcmp(name, "/dev/spcm7") ? 0 : CARD; }
void spcm_vClose(void *card) { puts(card == CARD ? "closed" : "wrong handle"); fflush(stdout); }
u32 spcm_dwSetParam_i32(void *card, i32 reg, i32 value) { printf("%d=%d ", reg, value); return 0; }
u32 spcm_dwGetParam_i32(void *card, i32 reg, i32 *value) { *value = reg == 110 ? 4 : 0; return 0; }
u32 spcm_dwGetErrorInfo_i32(void *card, u32 *reg, i32 *value, char *text) { return 0; }
"""


@pytest.mark.needs("c-compiler")
def test_the_functions_of_a_c_library_are_called_as_its_header_declares_them(tmp_path: Path) -> None:
    (tmp_path / "spcm.c").write_text(C_LIBRARY)
    library = tmp_path / "libspcm_linux.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", library, tmp_path / "spcm.c"], check=True)
    arguments = {"library": str(library), "card": "/dev/spcm7"}
    code = f"import runpy; print(runpy.run_path({script.__file__!r})['off'](**{arguments!r}))"
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "100=262208 30010=80 30110=80 30091=0 30191=0 100=2 100=1 closed",
        OFF,
    ]


class Stubborn(SimulatedCard):
    """A card that does not let its output 0 be disabled, and perhaps not be reset."""

    refused: tuple[tuple[int, int], ...] = ()

    def write_all(self, writes: Iterable[tuple[int, int | float]]) -> int:
        ((register, value),) = writes
        if (register, value) in self.refused:
            return self._refused(Refusal(r.ERR_FNCNOTSUPPORTED, "not now"), register, value)
        return super().write_all([(register, value)])


@contextmanager
def found(card: SimulatedCard, monkeypatch: pytest.MonkeyPatch) -> Generator[None]:
    """Within the block the script finds a card in this process as ``CARD``."""
    with installed(card, CARD):
        functions = {
            name: ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.cast(function, ctypes.c_void_p).value or 0)
            for name, function in _library().functions.items()
        }
        library = script.signed(SimpleNamespace(**functions))
        monkeypatch.setattr(script, "load", lambda _library: library)
        yield


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stubborn]:
    """A card in this process, which the script finds as ``simulated``; it plays, with its outputs on."""
    card = Stubborn(FakeClock())
    for register, value in (
        (r.SPC_ENABLEOUT0, 1),
        (r.SPC_ENABLEOUT1, 1),
        (r.SPC_M2CMD, r.M2CMD_CARD_START),
    ):
        assert card.write(register, value) == 0
    with found(card, monkeypatch):
        yield card


def test_a_card_that_a_dying_process_still_holds_is_waited_for(
    card: Stubborn, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, gives_back_s = 0.0, 0.5

    def sleep(duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s
        if now_s > gives_back_s:
            card.release()

    monkeypatch.setattr(script, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=sleep))
    assert card.acquire()
    assert script.off("", CARD) == OFF
    assert 0.5 < now_s < 0.51
    assert card.acquire(), "the script has closed it"
    now_s, gives_back_s = 0.0, 1e9
    with pytest.raises(script.EmergencyError, match=f"'{CARD}' .*2 s: .*in use"):
        script.off("", CARD)


def test_the_reset_of_the_card_makes_up_for_a_step_that_is_refused(card: Stubborn) -> None:
    card.refused = ((r.SPC_ENABLEOUT0, 0),)
    done, refused = script.off("", CARD).split("; refused: ")
    assert done.endswith("disabled by its reset")
    assert "SPC_ENABLEOUT0 (30091): not now" in refused
    assert (card.running, card.outputs_on) == (False, (False, False))
    card.refused += ((r.SPC_M2CMD, r.M2CMD_CARD_RESET),)
    with pytest.raises(script.EmergencyError, match=r"SPC_ENABLEOUT0 .*; reset .*SPC_M2CMD \(100\): not now"):
        script.off("", CARD)


def test_without_the_reset_the_outputs_are_off_all_the_same(card: Stubborn) -> None:
    card.refused = ((r.SPC_M2CMD, r.M2CMD_CARD_RESET),)
    assert "refused: reset of the card: SPC_M2CMD (100)" in script.off("", CARD)
    assert (card.running, card.outputs_on) == (False, (False, False))


def test_a_card_in_use_elsewhere_is_refused_and_one_that_dies_with_labseq_needs_no_script(
    tmp_path: Path,
) -> None:
    name = f"simulated@{tmp_path / 'card'}"
    elsewhere = TweezersOfProcess(SpcmSettings(card=name), Context("mobile_tweezers"))
    assert elsewhere.emergency() is None, "it is not open"
    elsewhere.open()
    other = Connection(str(tmp_path / "card"))
    try:
        assert not other("acquire"), "one owner"
        elsewhere.close()
        assert other("acquire")
        with pytest.raises(DeviceError, match="is in use"):
            elsewhere.open()
    finally:
        other("power_off")
    inside = SpcmMobileTweezers(SpcmSettings(card="simulated"), Context("mobile_tweezers"))
    inside.open()
    assert inside.emergency() is None
    inside.close()


def test_a_run_that_is_killed_leaves_card_and_radio_off(tmp_path: Path) -> None:
    """From the command line to the connectors, through the watchdog."""
    comb = "{centre: 100 MHz, step: 60 kHz}"
    radio = (
        f"device: 'simulated,speed=1,buffer=0.02,record=100000000,folder={tmp_path}', sample_rate: 1.2 MHz"
    )
    static = f"{{use: soapy, {radio}, row_frequency: {comb}, column_frequency: {comb}}}"
    mobile = f"{{use: spcm_process, card: simulated@{tmp_path}/card, mode: fifo, sample_rate: 250 MHz}}"
    profile = PROFILE.replace("STATIC", static).replace("MOBILE", mobile) + "plugin_folders: [plugins]\n"
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "card.py").write_text(PLUGIN, encoding="utf-8")
    (tmp_path / "p.yaml").write_text(profile, encoding="utf-8")
    (tmp_path / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    output = tmp_path / "output"
    command = [sys.executable, "-m", "labseq", "run", "s.yaml", "--shots", "1000", "--output", "runs"]
    root = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with output.open("wb") as file:
        labseq = subprocess.Popen(command, cwd=tmp_path, stdout=file, stderr=subprocess.STDOUT, env=root)

    def is_ready(condition: Callable[[], bool]) -> Callable[[], bool]:
        def check() -> bool:
            assert labseq.poll() is None, output.read_text("utf-8")
            return condition()

        return check

    try:
        until(is_ready((tmp_path / ADDRESS).exists), 120.0)
        card = Connection(str(tmp_path / "card"))
        until(is_ready(lambda: card("state")[1] == (True, True)), 120.0)
    finally:
        labseq.kill()
        labseq.wait()
    until(lambda: len(log_of(tmp_path)) == 2)
    assert log_of(tmp_path) == {
        "mobile_tweezers": OFF,
        "static_tweezers": "streaming process ended, radio ramped down and closed",
    }
    assert card("state") == (False, (False, False))
    assert not Ring(tmp_path).is_transmitting
    card("power_off")


def log_of(folder: Path) -> dict[str, str]:
    """What the watchdog has done: device -> text."""
    files = folder.glob("runs/*/*/watchdog.jsonl")
    rows = [json.loads(line) for file in files for line in file.read_text("utf-8").splitlines()]
    return {row["device"]: row["text"] for row in rows}


def test_all_outputs_of_a_card_with_four_are_disabled(monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimulatedCard(FakeClock(), model=M4I6622)
    outputs = [r.SPC_ENABLEOUT0 + 100 * n for n in range(4)]
    for register, value in [*((register, 1) for register in outputs), (r.SPC_M2CMD, r.M2CMD_CARD_WRITESETUP)]:
        assert card.write(register, value) == 0
    with found(card, monkeypatch):
        assert script.off("", CARD, 4) == "card stopped, outputs 0, 1, 2 and 3 disabled"
    assert card.outputs_on == (False,) * 4
