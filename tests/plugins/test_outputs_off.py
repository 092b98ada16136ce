"""A serial instrument and a timing box go off when the process that drives them dies or hangs."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Generator
from importlib import reload
from pathlib import Path

import pytest

from labseq.cli import main
from labseq.plugin import serial_emergency as script

from .labseq_serial_rig import PROFILE as INSTRUMENT, Simulator, opened
from .labseq_soapy_rig import until
from .outputs_rig import log_rows, outputs
from .small_run import PROFILE, SEQUENCE

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


def test_outputs_go_off_when_a_c_call_does_not_return(tmp_path: Path) -> None:
    with outputs(tmp_path) as devices:
        assert {*devices.times_to_off("C call")} == {"shutter", "lines"}
        assert {row["cause"] for row in log_rows(tmp_path)} == {"hung"}


def test_a_run_that_is_killed_leaves_instrument_and_lines_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """From the command line to the connectors; `labseq show` and the next run report it."""
    channels = {"light": {"channel": 4, "on": ["load", "image", "idle"]}}
    profile = PROFILE.replace("STATIC", "{use: virtual}").replace("MOBILE", "{use: virtual}")
    profile += f"devices:\n  shutter:\n    use: serial\n    port: {tmp_path / 'port'}\n    on_open: [open]\n"
    profile += textwrap.indent(INSTRUMENT.lstrip("\n"), "  ")
    profile += f"lines: {json.dumps({'use': 'ttl', 'port': str(tmp_path / 'box'), 'channels': channels})}\n"
    (tmp_path / "p.yaml").write_text(profile, encoding="utf-8")
    (tmp_path / "s.yaml").write_text(SEQUENCE, encoding="utf-8")
    command = ["run", "s.yaml", "--output", "runs", "--shots"]
    monkeypatch.chdir(tmp_path)
    with outputs(tmp_path, driven=False) as devices:
        run = subprocess.Popen([sys.executable, "-m", "labseq", *command, "1000"], stdout=subprocess.DEVNULL)
        try:
            until(lambda: run.poll() is not None or {*devices.off_since().values()} == {None})
            assert run.poll() is None
        finally:
            run.kill()
            run.wait()
        folder = next(tmp_path.glob("runs/*/0001_small"))
        until(lambda: len(log_rows(folder)) == 2)
        assert None not in devices.off_since().values()
        because = r"off after \d+ ms, because the run died: sent"
        shown, _ = printed(capfd, "show", str(folder))
        assert re.search(rf"shutter {because}", shown)
        assert re.search(rf"lines {because}", shown)
        assert re.search(rf"its watchdog: lines {because}", " ".join(printed(capfd, *command, "1")))


def printed(capfd: pytest.CaptureFixture[str], *arguments: str) -> list[str]:
    """What a command prints on stdout and on stderr, each in one line."""
    capfd.readouterr()
    with pytest.raises(SystemExit):
        main([*arguments])
    return [" ".join(text.split()) for text in capfd.readouterr()]


@pytest.fixture
def instrument(tmp_path: Path) -> Generator[Simulator]:
    with Simulator(tmp_path) as simulator:
        yield simulator


def off_for(simulator: Simulator, *safe_state: object) -> Callable[[], str]:
    """What the watchdog calls for a driver with this safe state."""
    reload(script)
    with opened(simulator.port, safe_state=[*safe_state]) as synth:
        found = synth.emergency()
    assert found is not None
    arguments = json.loads(json.dumps(dict(found.arguments)))
    return lambda: script.off(**arguments)


def commands(simulator: Simulator) -> list[str]:
    return [text for text in simulator.log if "?" not in text]


def test_a_toggle_is_sent_only_to_what_is_on(instrument: Simulator) -> None:
    off = off_for(instrument, "toggle_off")
    off()
    assert commands(instrument) == []
    off = off_for(instrument, "toggle_off")
    instrument.order("set", "open", "1")
    off()
    off()
    assert commands(instrument) == ["TOGGLE"]
    off = off_for(instrument, "toggle_off")
    instrument.order("set", "open", "1")
    instrument.order("fault", "other", 1)
    with pytest.raises(OSError, match=r"'STATE\?' was answered by 'WHAT'"):
        off()
    off()
    assert commands(instrument) == ["TOGGLE", "TOGGLE"]


def test_only_what_may_be_repeated_is_repeated_and_all_is_tried(instrument: Simulator) -> None:
    off = off_for(instrument, "once", "nonsense", "close")
    instrument.order("fault", "other", 1)
    failed = "'OPEN' was answered by 'WHAT'; 'NONSENSE' was answered by 'ERR -113,undefined header'"
    for _ in range(2):
        with pytest.raises(OSError, match=re.escape(failed)):
            off()
    assert commands(instrument) == ["OPEN", "NONSENSE", "CLOSE", "NONSENSE", "CLOSE"]
