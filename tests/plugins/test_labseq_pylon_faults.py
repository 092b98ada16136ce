"""What can go wrong with a pylon camera; pylon's emulated one really fails, unless a test says otherwise."""

from __future__ import annotations

import sys
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labseq_pylon import connection
from labseq_pylon.library import load_pypylon

from labseq import DeviceError, LimitError, TransientError
from labseq.plugin.messages import install_hint

from .labseq_camera_rig import Rig, opened_rig

needs_pypylon = pytest.mark.needs("pypylon")
unopened = partial(Rig, "pylon")
rig = partial(opened_rig, "pylon")


def fail_buffers(lab: Rig, n_buffers: int) -> None:
    lab.pylon.ForceFailedBufferCount.Value = n_buffers
    lab.pylon.ForceFailedBuffer.Execute()


def opening(**settings: Any) -> DeviceError | LimitError:
    made = unopened(**settings)
    with pytest.raises((DeviceError, LimitError)) as caught:
        made.camera.open()
    made.camera.close()
    return caught.value


@needs_pypylon
def test_a_failed_buffer_is_a_lost_frame_and_the_series_goes_on() -> None:
    with rig() as lab:
        lab.camera.arm(4, 0.01, "software")
        fail_buffers(lab, 2)
        for number in (0, 1):
            lab.camera.trigger()
            with pytest.raises(TransientError, match=f"frame {number} was lost from a .* 4: .*incomplete"):
                lab.camera.read(1.0)
        for number in (2, 3):
            lab.camera.trigger()
            frame = lab.camera.read(1.0)
            assert frame.number == number
            np.testing.assert_array_equal(frame.image, lab.world.shown[number])


@needs_pypylon
def test_an_unplugged_camera_is_an_error_and_can_be_opened_again() -> None:
    made = unopened()
    made.camera.open()
    made.camera.arm(3, 0.01, "software")
    made.camera.trigger()
    made.camera.read(1.0)
    made.camera.trigger()
    made.pylon.FirePnPCallback.Execute()
    gone = "camera: the camera no longer answers; check its cable and power"
    made.camera.read(1.0)
    with pytest.raises(DeviceError, match=gone):
        made.camera.trigger()
    with pytest.raises(DeviceError, match=gone):
        made.camera.arm(1, 0.01, "software")
    made.camera.safe_state()
    made.camera.close()
    made.camera.open()
    np.testing.assert_array_equal(made.take(1)[0].image, made.world.shown[-1])
    made.camera.arm(1, 0.01, "external")
    made.pylon.FirePnPCallback.Execute()
    with pytest.raises(DeviceError, match=gone):
        made.camera.read(60.0)
    made.camera.close()


@needs_pypylon
def test_the_trigger_line_is_that_of_the_settings() -> None:
    with rig(trigger_line="Line2", trigger_edge="falling") as lab:
        lab.camera.arm(2, 0.01, "external")
        chosen = [lab.pylon.TriggerSource.Value, lab.pylon.TriggerActivation.Value]
        assert chosen == ["Line2", "FallingEdge"]
        lab.camera.arm(2, 0.01, "bulb")
        chosen = [lab.pylon.TriggerSource.Value, lab.pylon.ExposureMode.Value]
        assert chosen == ["Line2", "TriggerWidth"]
        lab.camera.arm(1, 0.01, "software")
        assert lab.pylon.ExposureMode.Value == "Timed"
    with rig(trigger_line="Line3", line_trigger="external_start", cycle_time="50 ms") as lab:
        with pytest.raises(DeviceError, match="no number of frames of a start"):  # the emulated camera
            lab.camera.arm(2, 0.01, "external_start")
        lab.pylon.TriggerSelector.Value = "FrameBurstStart"
        assert (lab.pylon.TriggerMode.Value, lab.pylon.TriggerSource.Value) == ("On", "Line3")
        lab.pylon.TriggerSelector.Value = "FrameStart"
        assert lab.pylon.TriggerMode.Value == "Off"
        lab.camera.arm(1, 0.01, "software")
        lab.pylon.TriggerSelector.Value = "FrameBurstStart"
        assert lab.pylon.TriggerMode.Value == "Off"
    with rig(trigger_line="Line9") as lab:
        with pytest.raises(DeviceError, match=r"source cannot be Line9; the camera offers .*Line1"):
            lab.camera.arm(1, 0.01, "external")
        assert len(lab.take(1)) == 1


@needs_pypylon
@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"region": {"y": 3, "x": 0, "height": 32, "width": 32}, "binning": 2},
            "the nearest possible value is 4",
        ),
        ({"binning": 8}, "binning is 8; the limit is 1 to 4, in steps of 1"),
        ({"gain": 60.0}, "gain is 60; the limit is 0 to 48"),
        ({"gain_raw": 100}, "gain_raw is 100; the limit is 192 to 1023"),
        ({"model": "acA1920-40um"}, "has the model Emulation, not acA1920-40um"),
    ],
)
def test_what_the_camera_is_not_or_cannot_is_refused_when_it_is_opened(
    settings: dict[str, Any], text: str
) -> None:
    assert text in str(opening(**settings))


@needs_pypylon
def test_an_exposure_beyond_the_cameras_limits_is_refused() -> None:
    with rig(max_exposure="60 s") as lab:
        for exposure_s, came in ((20.0, "20 s"), (1e-7, "100 ns")):
            with pytest.raises(LimitError, match=f"exposure is {came}; the limit is 1 us to 10 s"):
                lab.camera.arm(1, exposure_s, "software")
        assert len(lab.take(1)) == 1


@needs_pypylon
def test_a_stream_that_breaks_off_is_an_error() -> None:
    with rig() as lab:
        lab.camera.arm(1, 0.01, "software")
        lab.pylon.GetStreamGrabberNodeMap().GetNode("ImposedError").Value = "no bandwidth left"
        lab.camera.trigger()
        with pytest.raises(DeviceError, match="camera: cannot read a frame: no bandwidth left"):
            lab.camera.read(1.0)
        assert len(lab.take(1)) == 1


@needs_pypylon
def test_a_region_beyond_the_cameras_sensor_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    region = {"y": 0, "x": 4000, "height": 64, "width": 100}
    error = str(opening(camera="0815-0000", region=region))
    assert all(fact in error for fact in ("row 64, column 4100", "4096 x 4096"))


@needs_pypylon
def test_a_serial_number_that_no_camera_has_is_reported_with_those_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    error = str(opening(camera="22345678"))
    assert all(fact in error for fact in ("'22345678'", "'0815-0000'", "'0815-0001'"))


@pytest.fixture
def emulated_only(monkeypatch: pytest.MonkeyPatch) -> Any:
    """pylon, with two emulated cameras and whatever is plugged into this computer left out."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    sdk = load_pypylon("camera")
    layer: Any = sdk.pylon.TlFactory.GetInstance().CreateTl(connection.EMULATION)
    factory = SimpleNamespace(GetInstance=lambda: layer)
    monkeypatch.setattr(sdk.pylon, "TlFactory", factory)
    return sdk


@needs_pypylon
def test_without_a_camera_it_says_so_and_does_not_take_an_emulated_one(emulated_only: Any) -> None:
    with pytest.raises(DeviceError, match=r"no Basler camera .*`camera: simulated`"):
        connection.find_camera(emulated_only, None)


@needs_pypylon
def test_of_two_cameras_one_must_be_named(emulated_only: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "EMULATION", "no class")  # as if these two were real
    with pytest.raises(DeviceError, match=r"2 cameras .*'0815-0000', .*'0815-0001'.* serial number"):
        connection.find_camera(emulated_only, None)


@needs_pypylon
def test_a_camera_that_another_program_has_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """``Open`` is replaced: several programs may open an emulated camera, so it is never busy."""
    sdk = load_pypylon("camera")

    def refuse(_camera: Any) -> None:
        raise sdk.genicam.RuntimeException("The device is controlled by another application.")

    monkeypatch.setattr(sdk.pylon.InstantCamera, "Open", refuse)
    error = str(opening())
    assert "controlled by another application" in error
    assert "close the pylon Viewer" in error


def test_without_pypylon_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypylon.pylon", None)
    assert f"install it with {install_hint('pylon')}. To try" in str(opening())
