"""The pylon camera: every pixel of the simulation comes through pylon."""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from labseq_genicam.settings import BITS
from labseq_pylon import connection
from labseq_pylon.library import load_pypylon
from labseq_pylon.settings import PylonSettings

from .labseq_camera_rig import opened_rig, sensors

needs_pypylon = pytest.mark.needs("pypylon")
rig = partial(opened_rig, "pylon")


@needs_pypylon
@settings(max_examples=10)
@given(sensor=sensors(tuple(name for name in BITS if name != "Mono14")))
def test_the_camera_cuts_its_region_and_saturates_as_its_pixel_format_does(sensor: dict[str, Any]) -> None:
    with rig(**sensor) as lab:
        frames = lab.take(2)
        about = lab.camera.facts.frame_shape
        nodes = lab.pylon.GetNodeMap()
        place = [nodes.GetNode(name).GetValue() for name in ("OffsetY", "OffsetX", "Height", "Width")]
    wanted = sensor.get("region") or {"y": 0, "x": 0, "height": 96, "width": 128}
    binned = [wanted[key] // sensor["binning"] for key in ("y", "x", "height", "width")]
    assert place == binned
    assert about == tuple(binned[2:])
    for frame, shown in zip(frames, lab.world.shown, strict=True):
        assert frame.image.dtype == np.uint16
        np.testing.assert_array_equal(frame.image, np.minimum(shown, 2 ** BITS[sensor["pixel_format"]] - 1))


@needs_pypylon
def test_a_computer_that_is_slow_fails_no_trigger_and_costs_no_time_on_a_virtual_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connection, "READY_S", 0.0)  # a real camera's, which is not this one's
    with rig(readout="5 ms") as lab:
        wait, n_waits = lab.pylon.WaitForFrameTriggerReady, 0

        def wait_slowly(milliseconds: int, handling: Any) -> bool:
            nonlocal n_waits
            n_waits += 1
            return n_waits > 3 and wait(milliseconds, handling)

        slow = Changed(lab.pylon, WaitForFrameTriggerReady=wait_slowly)
        monkeypatch.setattr(lab.camera.connection, "camera", slow)
        lab.take(1, 0.01)
    assert n_waits == 4
    assert lab.clock.now() == pytest.approx(0.015)


class Changed:
    """An object of pylon's with some attributes replaced."""

    def __init__(self, original: Any, **attributes: Any) -> None:
        self._original = original
        vars(self).update(attributes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


@needs_pypylon
def test_it_says_what_it_is_and_what_it_took() -> None:
    with rig(gain=6.0, packet_size=9000, packet_delay="1 us", binning=2) as lab:
        about = json.loads(json.dumps(dict(lab.camera.describe()), allow_nan=False))
    assert (about["model"], about["serial_number"]) == ("Emulation", "0815-0000")
    assert about["firmware"]
    assert about["gain_now"] == pytest.approx(6.0, abs=1e-3)
    assert about["packet_size_now"] == 9000
    assert about["pixel_format"] == "Mono16"
    assert about["frame_shape"] == [48, 64]


@needs_pypylon
def test_time_stamps_of_the_camera_are_in_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The emulated camera makes none; others count nanoseconds unless they say otherwise."""
    with rig() as lab:
        retrieve = lab.pylon.RetrieveResult
        stamped = Changed(lab.pylon, RetrieveResult=lambda *_: Changed(retrieve(*_), TimeStamp=2_500_000_000))
        monkeypatch.setattr(lab.camera.connection, "camera", stamped)
        assert lab.take(1)[0].device_time_s == pytest.approx(2.5)


def serial_numbers() -> list[str]:
    """Serial numbers of the cameras that pylon lists."""
    infos: Any = load_pypylon("test").pylon.TlFactory.GetInstance().EnumerateDevices()
    return [info.GetSerialNumber() for info in infos]


@needs_pypylon
def test_emulated_cameras_never_stand_among_real_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYLON_CAMEMU", raising=False)
    with rig():
        assert "0815-0000" not in serial_numbers()


@needs_pypylon
def test_no_files_stay_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with rig() as lab:
        lab.take(2)
        (folder,) = tmp_path.iterdir()
        assert [file.stat().st_size for file in folder.iterdir()] == [0, 0]
    assert not list(tmp_path.iterdir())


@needs_pypylon
def test_the_camera_reads_its_own_pictures_where_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a real camera: found by its number, whole sensor, all triggers, no simulation."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    with rig("0815-0001", pixel_format="Mono8", gain_raw=200) as lab:
        assert lab.camera.describe()["serial_number"] == "0815-0001"
        assert lab.camera.facts.frame_shape == (4096, 4096)
        lab.camera.self_test()
    region = {"y": 64, "x": 32, "height": 48, "width": 80}
    with rig("0815-0001", region=region, readout="0 ms") as lab:
        lab.camera.arm(3, 1e-3, "internal")
        frames = [lab.camera.read(5.0) for _ in range(3)]
        assert [frame.number for frame in frames] == [0, 1, 2]
        assert {frame.image.shape for frame in frames} == {(48, 80)}
        assert lab.take(1)[0].image.shape == (48, 80)
    assert not lab.world.shown


def test_settings_take_one_gain_and_a_serial_number_without_quotes() -> None:
    with pytest.raises(ValueError, match="set one of them"):
        PylonSettings(gain=3.0, gain_raw=200)
    assert PylonSettings.model_validate({"camera": 22345678}).camera == "22345678"
