"""A serial instrument and a timing box go off when the process that drives them dies or hangs."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Generator
from importlib import reload
from pathlib import Path

import pytest

from labseq.drivers import serial_emergency as script

from .labseq_serial_rig import Counterpart, opened
from .outputs_rig import log_rows, outputs

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


@pytest.mark.parametrize("cause", ["kill -9", "C call"])
def test_outputs_go_off(tmp_path: Path, cause: str) -> None:
    with outputs(tmp_path) as devices:
        assert {*devices.times_to_off(tmp_path, cause)} == {"shutter", "lines"}
        texts = {row["device"]: row["text"] for row in log_rows(tmp_path)}
        assert texts == {
            "shutter": f"sent 'FREQ 1.000000', 'CLOSE' to {tmp_path / 'port'}",
            "lines": f"sent '!' to {tmp_path / 'box'}",
        }


@pytest.fixture
def instrument(tmp_path: Path) -> Generator[Counterpart]:
    with Counterpart(tmp_path) as counterpart:
        yield counterpart


def off_for(counterpart: Counterpart, *safe_state: object) -> Callable[[], str]:
    """What the watchdog calls for a driver with this safe state."""
    reload(script)
    with opened(counterpart.port, safe_state=[*safe_state]) as synth:
        found = synth.emergency()
    assert found is not None
    arguments = json.loads(json.dumps(dict(found.arguments)))
    return lambda: script.off(**arguments)


def commands(counterpart: Counterpart) -> list[str]:
    return [text for text in counterpart.log if "?" not in text]


def test_a_toggle_is_sent_only_to_what_is_on(instrument: Counterpart) -> None:
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


def test_only_what_may_be_repeated_is_repeated_and_all_is_tried(instrument: Counterpart) -> None:
    off = off_for(instrument, "once", "nonsense", "close")
    instrument.order("fault", "other", 1)
    failed = "'OPEN' was answered by 'WHAT'; 'NONSENSE' was answered by 'ERR -113,undefined header'"
    for _ in range(2):
        with pytest.raises(OSError, match=re.escape(failed)):
            off()
    assert commands(instrument) == ["OPEN", "NONSENSE", "CLOSE", "NONSENSE", "CLOSE"]
