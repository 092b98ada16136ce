"""The radio is switched off when labseq, or the process that streams to it, has died or hangs."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_soapy import emergency as script
from labseq_soapy_sim import Ring, read_trace
from labseq_soapy_sim.radio import STREAMER

from .emergency import Done, outsider
from .labseq_soapy_rig import another_labseq, assert_ramped_down, recorded, until

Labseq = subprocess.Popen[str]
RAMPED = "streaming process ended, radio ramped down and closed"
AGAIN = "radio opened again, lowest gains set, closed"


def last_lit_s(folder: Path) -> float:
    """When the last sample that is not zero was at the connectors."""
    _, _, start_s, rate_hz = [entry for entry in read_trace(folder) if entry[1] == "play"][-1]
    return max(start_s + int(np.flatnonzero(recorded(folder, channel))[-1]) / rate_hz for channel in (0, 1))


def kill(labseq: Labseq, _pid: int) -> None:
    labseq.kill()


def hang(labseq: Labseq, _pid: int) -> None:
    labseq.send_signal(signal.SIGSTOP)


def kill_both(labseq: Labseq, pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    labseq.kill()


def kill_and_hang_the_stream(labseq: Labseq, pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    labseq.kill()


@pytest.mark.parametrize(
    ("fail", "text"),
    [
        (kill, RAMPED),
        (hang, RAMPED),
        (kill_both, f"streaming process ended without closing its radio; {AGAIN}"),
        (kill_and_hang_the_stream, f"streaming process hung and was killed; {AGAIN}"),
    ],
)
def test_a_plain_process_switches_the_radio_off(
    tmp_path: Path, fail: Callable[[Labseq, int], None], text: str
) -> None:
    with (
        another_labseq(tmp_path, row_gain=20, column_gain=20) as (labseq, job),
        outsider({"radio": job}) as outside,
    ):
        pid = job[1]["pid"]
        until(lambda: bool(np.count_nonzero(recorded(tmp_path)) > 50_000))
        fail(labseq, pid)
        if fail is kill_both:
            until(lambda: not script._runs(pid, job[1]["started"]))
            until(lambda: not Ring(tmp_path).is_playing)
            assert Ring(tmp_path).is_transmitting, "no samples, but the leakage of its local oscillator"
        done: Done = outside.off()["radio"]
        assert done.text == text
        assert not outside.heavy_modules
        assert not script._runs(pid, job[1]["started"])
        trace = read_trace(tmp_path)
        assert trace[-1][1] == "close"
        assert last_lit_s(tmp_path) < done.end_s
        assert not Ring(tmp_path).is_transmitting
        if AGAIN in text:
            assert [name for _, name, *_ in trace].count("open") == 2
            assert [gain[2:] for gain in trace if gain[1] == "gain"][-2:] == [(0.0, 0.0), (1.0, 0.0)]
        else:
            assert_ramped_down(tmp_path)
        assert outside.off()["radio"].text == RAMPED, "it can be repeated"


def test_the_streaming_process_ends_with_labseq_although_a_copy_of_labseq_holds_its_pipe(
    tmp_path: Path,
) -> None:
    """A child that labseq has forked keeps the pipe open, so that its end never comes."""
    with another_labseq(tmp_path, forks=True, patience=3600) as (labseq, job):
        pid, started = job[1]["pid"], job[1]["started"]
        until(lambda: bool(np.count_nonzero(recorded(tmp_path)) > 50_000))
        labseq.kill()
        until(lambda: not script._runs(pid, started))
    assert_ramped_down(tmp_path)
    assert read_trace(tmp_path)[-1][1] == "close"


def test_a_radio_that_cannot_be_opened_again_may_transmit_and_the_text_says_so(tmp_path: Path) -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    opened = tmp_path / "opened"
    opened.write_text(str(dead.pid), "ascii")
    may_transmit = "'driver=none' .*no match.* transmitters stay on .*switch it off by hand"
    with pytest.raises(script.EmergencyError, match=may_transmit):
        script.off(dead.pid, 1, str(opened), 0.01, "driver=none", [0, 1], STREAMER)
    assert opened.exists(), "the next attempt tries it again"


def test_wrong_arguments_give_one_clear_line_and_a_process_that_took_the_number_lives() -> None:
    arguments: dict[str, Any] = {
        "started": script.start_of(os.getpid()) + 1,
        "opened": "none",
        "ramp_s": 0.01,
        "device": "driver=none",
        "channels": [0, 1],
        "program": "none",
    }
    assert script.off(pid=os.getpid(), **arguments) == RAMPED
    with pytest.raises(script.EmergencyError, match="process is 0; expected a number above 1"):
        script.off(pid=0, **arguments)
