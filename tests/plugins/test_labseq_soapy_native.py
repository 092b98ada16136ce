"""The simulated radio does the same for the driver as a radio behind the real libSoapySDR."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_soapy_sim import SimulatedDevice, read_trace
from labseq_soapy_stream import radio as radio_module
from labseq_soapy_stream.messages import Facts, Setup
from labseq_soapy_stream.radio import Device, OpenDevice, open_radio, read_back, set_up
from labseq_soapy_stream.soapysdr import SoapyDevice, SoapyError

from .labseq_soapy_rig import opened, recorded

PACKET = 16384
"""Most samples that the radio takes at once."""

pytestmark = pytest.mark.needs("soapy-module")


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the SoapySDR module, compiled."""
    folder = tmp_path_factory.mktemp("module")
    source = Path(__file__).with_name("labseq_soapy_module.cpp")
    command = ["g++", "-std=c++14", "-shared", "-fPIC", "-o", str(folder / "libcapture.so"), str(source)]
    subprocess.run([*command, "-lSoapySDR"], check=True)
    return folder


def attempt(call: Callable[[], object]) -> object:
    """What a call gives, or the text of its error."""
    try:
        return call()
    except SoapyError as error:
        return plain(error)


def plain(error: SoapyError) -> str:
    """The text of an error without the names of C functions and classes."""
    return re.sub(r"SoapySDR::Device::make\(\) |\b[a-z]+[A-Z]\w+: ", "", str(error))


def facts(radio: Device, setup: Setup) -> Facts:
    """What is read back, without the version of the library."""
    found = read_back(radio, setup)
    return replace(found, radio={key: text for key, text in found.radio.items() if key != "SoapySDR"})


def use(open_device: OpenDevice, folder: Path, arguments: str, **settings: Any) -> list[object]:
    """All that the driver learns of a radio from opening to closing it, with an underflow in between."""
    values: dict[str, Any] = {
        "device": f"driver=capture,speed=1,patience=0,record=100000000,buffer=0.2,{arguments},folder=.",
        "stream": "WIRE=sc16, size = 3",
        "channels": (1, 0),
        "rate_hz": 1.2e6,
        "oscillator_hz": 100e6,
        "lo_offset_hz": 0.0,
        "bandwidth_hz": 1e6,
        "gain_db": (12.1, None),
        "antenna": "TX/RX",
        "clock_source": "external",
    }
    setup = Setup(**(values | settings), ramp_s=0.0, max_wait_s=1.0, marker="")
    results: list[object] = []
    try:
        radio = open_radio(open_device, setup)
    except SoapyError as error:
        return [plain(error)]
    results += [radio.n_channels, radio.gain_range(0), attempt(lambda: radio.gain_range(7))]
    results.append(attempt(lambda: radio.get("SampleRate", 7)))
    try:
        stream = set_up(radio, setup)
    except SoapyError as error:
        radio.close()
        return [*results, plain(error)]
    block = np.arange(2 * 2 * 20_000, dtype=np.float32).reshape(2, -1)
    results += [
        facts(radio, setup),
        attempt(lambda: stream.write(block, 0, 0.0)),
        attempt(stream.activate),
    ]
    first = attempt(lambda: stream.write(block, 0, 0.0))
    results.append(first)
    if isinstance(first, int):
        stream.check_start()
        results += [stream.starts_together, stream.write(block, 19_000, 0.0)]
        while stream.write(block, 0, 0.0) == PACKET:
            pass
        results += [{*stream.errors(20.0)}, stream.errors(), stream.write(block, 0, 0.0) > 0]
    stream.close()
    radio.close()
    trace = [(name, *gain) for _, name, *gain in read_trace(folder) if name != "play"]
    return [*results, trace, recorded(folder, 1)[:17_000].tolist()]


@pytest.mark.parametrize(
    ("arguments", "settings"),
    [
        ("", {}),
        ("detune=30000", {"lo_offset_hz": 200e3}),
        ("components=1,time=0,unlocked=lo", {"lo_offset_hz": 200e3}),
        ("time=2", {"oscillator_hz": 7e9}),
        ("delay=0.6", {}),
        ("fault=inactive", {}),
        ("fault=absent", {}),
        ("channels=1", {}),
        ("", {"gain_db": (61.0, None)}),
        ("", {"antenna": "none"}),
        ("", {"clock_source": "none"}),
        ("driver=none", {}),
    ],
)
def test_the_driver_learns_the_same_of_a_radio(
    tmp_path: Path, module: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, settings: dict[str, Any]
) -> None:
    monkeypatch.setenv("SOAPY_SDR_PLUGIN_PATH", str(module))
    monkeypatch.setattr(radio_module, "START_S", 0.5)  # of notice, also on a busy computer
    learned: list[list[object]] = []
    for open_device in (SimulatedDevice, SoapyDevice):
        folder = tmp_path / str(len(learned))
        folder.mkdir()
        monkeypatch.chdir(folder)
        learned.append(use(open_device, folder, arguments, **settings))
    assert learned[0] == learned[1]


def test_a_run_of_the_driver_sends_the_same_samples(
    tmp_path: Path, module: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOAPY_SDR_PLUGIN_PATH", str(module))
    seen: list[Any] = []
    for device in ("simulated,speed=1,patience=0", "driver=capture"):
        folder = tmp_path / str(len(seen))
        folder.mkdir()
        with opened(device=f"{device},buffer=0.2,record=100000000,folder={folder}", row_gain=12.1) as rig:
            rig.tweezers.start()
            rig.tweezers.ramp(0.5, 0.01)
            described: dict[str, Any] = {
                **rig.tweezers.describe(),
                "device": "",
                "notes": "",
                "no_real_time": "",
                "buffered": 0,  # what it is at the moment depends on how busy the computer is
            }
            described["radio"] = described["radio"]["driver"]
        names = [name for _, name, *_ in read_trace(folder) if name != "play"]
        samples = recorded(folder)
        first = int(np.flatnonzero(samples)[0])
        seen.append((described, names, samples[first : first + 30_000].tolist()))
    assert seen[0] == seen[1]
