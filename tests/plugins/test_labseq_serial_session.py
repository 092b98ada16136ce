"""Runs with a serial instrument: in a dry run made of its description, else a process on a pty."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from labseq import ConfigError, DeviceError, Session
from labseq.config import find_profile
from labseq.config.yaml_nodes import compose
from labseq.recording import Run
from labseq.session import check_devices
from labseq.session.check import check

from .labseq_serial_rig import PROFILE, Counterpart

on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")

SEQUENCE = """
labseq: 1
name: serial
profile: ./lab.yaml
shots: 2
seed: 1
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca}
shot:
  - load: {duration: 10 ms}
  - device: {name: synth, do: set, arguments: {frequency: 80 MHz}}
  - device: {name: synth, do: toggle_on}
  - image: {exposure: 5 ms}
"""


@pytest.fixture
def counterpart(tmp_path: Path) -> Iterator[Counterpart]:
    with Counterpart(tmp_path) as counterpart:
        yield counterpart


def lab(folder: Path, port: str, **more: Any) -> Path:
    """A sequence in a folder, and the virtual lab with the instrument as its profile."""
    text = find_profile("virtual", folder).read_text()
    profile, synth = compose(text, ""), compose(f"synth:\n{PROFILE}", "")
    assert profile is not None
    assert synth is not None
    device = {"use": "serial", "port": port, **synth.plain()["synth"], **more}
    (folder / "lab.yaml").write_text(json.dumps({**profile.plain(), "devices": {"synth": device}}))
    (folder / "sequence.yaml").write_text(SEQUENCE)
    return folder / "sequence.yaml"


def run(sequence: Path, **options: Any) -> Run:
    with Session.open(sequence, output=sequence.parent / "data", **options) as session:
        return session.run()


class Observer:
    """Notes what becomes of each attempt at a shot; unplugs an instrument when the first one begins.

    Attributes:
        ends: How each attempt ended, and its error.
    """

    def __init__(self, unplugged: Counterpart | None = None) -> None:
        self.ends: list[tuple[str, str]] = []
        self._unplugged = unplugged

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "shot_started" and self._unplugged is not None and not self.ends:
            self._unplugged.order("unplug")
        if name in ("shot_finished", "shot_repeated"):
            self.ends.append((values["shot"].status, values["shot"].error))


def test_a_dry_run_speaks_to_an_instrument_made_of_the_description(tmp_path: Path) -> None:
    done = run(lab(tmp_path, "/dev/ttyNOSUCH7"), dry_run="full")
    readings = [shot.readings for shot in done.shots]
    assert [reading["synth.is_open"] for reading in readings] == [False, True]
    assert [reading["synth.frequency"] for reading in readings] == [0.0, 80e6]
    assert done.record["devices"]["synth"]["port"] == "simulated"


def test_a_simulated_port_takes_no_real_time(tmp_path: Path) -> None:
    with Session.open(lab(tmp_path, "simulated"), output=tmp_path / "data") as session:
        assert session.assembly.virtual_time


@on_a_pty
def test_values_are_kept_with_each_shot(tmp_path: Path, counterpart: Counterpart) -> None:
    done = run(lab(tmp_path, counterpart.port))
    assert [shot.readings["synth.frequency"] for shot in done.shots] == [100e6, 80e6]
    assert counterpart.log[-2:] == ["FREQ 1.000000", "CLOSE"], "it was made safe"


@on_a_pty
def test_the_first_command_of_the_day_names_the_instrument(tmp_path: Path, counterpart: Counterpart) -> None:
    report = check_devices(str(lab(tmp_path, counterpart.port).with_name("lab.yaml")))
    (synth,) = [found for found in report.devices if found.name == "synth"]
    assert synth.ok
    assert synth.tested
    assert synth.described["serial_number"] == "0042"
    assert synth.latency_s


@on_a_pty
def test_a_value_past_its_interlock_ends_the_run_before_anything_is_done(
    tmp_path: Path, counterpart: Counterpart
) -> None:
    counterpart.order("set", "temperature", "25.60")
    observer = Observer()
    text = "synth: temperature is 25.6 degC; the interlock expects 15 degC to 25 degC; look at the chiller"
    with pytest.raises(DeviceError, match=re.escape(text)):
        run(lab(tmp_path, counterpart.port), observer=observer)
    assert "TOGGLE" not in counterpart.log
    assert counterpart.log[-1] == "CLOSE"
    assert observer.ends == [("failed", f"InterlockError: {text}")]


@on_a_pty
def test_a_shot_in_which_the_line_breaks_is_repeated_and_ends_the_run_if_it_stays_broken(
    tmp_path: Path, counterpart: Counterpart
) -> None:
    observer = Observer(unplugged=counterpart)
    with pytest.raises(DeviceError, match="synth: the line broke and could not be opened again"):
        run(lab(tmp_path, counterpart.port), observer=observer)
    (first, first_error), (second, second_error) = observer.ends
    assert (first, second) == ("failed", "failed")
    assert first_error.startswith("TransientError: synth: the line broke at 'STATE?'")
    assert second_error.startswith("DeviceError: ")


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        (
            "do: set,",
            "do: sett,",
            ":11:31: synth: unknown command 'sett'; expected one of 'open', 'close', 'once'",
        ),
        ("80 MHz", "300 MHz", ":11:31: synth: frequency of 'set' is 300 MHz; the limit is 1 MHz to 200 MHz"),
        ("frequency: 80 MHz", "", ":11:31: synth: 'set' has no arguments; expected frequency"),
    ],
)
def test_a_command_that_the_device_does_not_know_is_refused_before_anything_is_opened(
    tmp_path: Path, right: str, wrong: str, message: str
) -> None:
    sequence = lab(tmp_path, "/dev/ttyNOSUCH7")
    sequence.write_text(SEQUENCE.replace(right, wrong, 1))
    with Session.open(sequence, output=tmp_path / "data") as session:
        for attempt in (partial(check, session), session.run):
            with pytest.raises(ConfigError, match=re.escape(message)):
                attempt()
    assert not (tmp_path / "data").exists()


def test_a_scan_beyond_a_limit_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    scan = "scan: {shot.1.device.arguments.frequency: [80 MHz, 90 MHz, 300 MHz]}"
    sequence = lab(tmp_path, "simulated")
    sequence.write_text(SEQUENCE.replace("shots: 2", scan))
    with (
        Session.open(sequence, output=tmp_path / "data") as session,
        pytest.raises(ConfigError, match="synth: frequency of 'set' is 300 MHz; the limit"),
    ):
        session.run()
