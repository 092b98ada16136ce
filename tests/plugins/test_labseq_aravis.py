"""The binding of libaravis, against the library's own simulated camera."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_aravis import (
    AravisError,
    Buffer,
    Camera,
    FoundCamera,
    LibraryMissingError,
    PixelFormatError,
    StreamOptions,
    find_cameras,
)
from labseq_aravis.camera import camera_id
from labseq_aravis.library import Library, load_library
from labseq_aravis.stream import MONO, unpacked
from labseq_genicam_sim.fake import FakeCamera

from .labseq_genicam_rig import REGION, WAIT_S, opened, pattern, plugged_in, set_region
from .needs import need_library


@pytest.fixture
def fake() -> Iterator[FakeCamera]:
    need_library(load_library)
    with plugged_in() as fake:
        yield fake


def test_a_missing_library_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_aravis.library.NAMES", {sys.platform: (("libnone.so.1", "none"),)})
    with pytest.raises(LibraryMissingError, match=r"apt-get install libaravis-0\.8-0.*brew install aravis"):
        Library()


def test_a_camera_tells_what_it_is(fake: FakeCamera) -> None:
    with Camera(fake.address) as camera:
        assert (camera.vendor, camera.model, camera.serial) == ("labseq", "Simulated", "T1")
        assert camera.sensor_shape == (2048, 2048)
        assert camera.pixel_formats == ("Mono8", "Mono10", "Mono12", "Mono16")
        assert camera.trigger_sources == ("Software", "Line1")
        assert camera.is_ethernet
        assert not camera.is_lost


def test_settings_are_read_back_as_they_were_set(fake: FakeCamera) -> None:
    with Camera(fake.address) as camera:
        camera.set_pixel_format("Mono12")
        camera.set_binning(2, 4)
        set_region(camera, {"OffsetX": 10, "OffsetY": 20, "Width": 300, "Height": 100})
        camera.set_exposure_s(0.0123)
        camera.set_gain(3.25)
        camera.set_frame_rate_hz(50.0)
        camera.set_packet_size(4000)
        camera.set_packet_delay_s(1e-6)
        assert camera.get_string("PixelFormat") == "Mono12"
        assert (camera.get_integer("BinningVertical"), camera.get_integer("BinningHorizontal")) == (2, 4)
        assert camera.integer_bounds("OffsetX") == (0, 2048 // 4 - 300, 1)
        assert camera.payload == 300 * 100 * 2
        assert camera.exposure_s == pytest.approx(0.0123)
        assert camera.has_gain
        assert camera.gain == pytest.approx(3.25)
        assert camera.frame_rate_hz == pytest.approx(50.0)
        assert camera.packet_size == 4000
        assert camera.packet_delay_s == pytest.approx(1e-6)
        assert camera.exposure_bounds_s == pytest.approx((1e-5, 10.0))
        assert camera.gain_bounds == pytest.approx((0.0, 1000.0))


def test_features_are_read_and_set_by_name(fake: FakeCamera) -> None:
    with Camera(fake.address) as camera:
        assert camera.is_available("ExposureTime")
        assert not camera.is_available("Nonsense")
        camera.set_exposure_s(500e-6)
        camera.set_integer("Width", 640)
        camera.set_string("TriggerMode", "On")
        assert camera.get_float("ExposureTime") == 500.0
        assert camera.float_bounds("ExposureTime") == (10.0, 10e6)
        assert camera.get_integer("Width") == 640
        assert camera.integer_bounds("OffsetX") == (0, 2048 - 640, 1)
        assert camera.get_string("TriggerMode") == "On"
        with pytest.raises(AravisError, match="Nonsense") as caught:
            camera.get_string("Nonsense")
        assert caught.value.code == "feature not found"


def test_values_that_the_camera_does_not_offer_are_refused(fake: FakeCamera) -> None:
    with Camera(fake.address) as camera:
        with pytest.raises(AravisError, match="greater than allowed"):
            camera.set_exposure_s(1000.0)
        with pytest.raises(AravisError) as caught:
            camera.set_integer("Width", 4096)
        assert caught.value.code == "out of range"
        with pytest.raises(AravisError, match="BayerRG8"):
            camera.set_pixel_format("BayerRG8")
        with pytest.raises(AravisError, match="Line7"):
            camera.set_trigger("Line7")


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono10", "Mono12", "Mono16"])
def test_frames_arrive_as_they_were_made(fake: FakeCamera, pixel_format: str) -> None:
    with opened(fake, pixel_format=pixel_format) as (camera, stream):
        camera.trigger()
        buffer = stream.pop(WAIT_S)
    assert buffer is not None
    assert buffer.image is not None
    largest = 2 ** int(pixel_format.removeprefix("Mono")) - 1
    rows, columns = np.indices((REGION["Height"], REGION["Width"]))
    expected = np.minimum((rows + REGION["OffsetY"]) * 7 + columns + REGION["OffsetX"], largest)
    assert (buffer.status, buffer.pixel_format, buffer.image.dtype) == ("success", pixel_format, np.uint16)
    np.testing.assert_array_equal(buffer.image, expected)


def test_buffers_are_used_again_and_numbered(fake: FakeCamera) -> None:
    with opened(fake, n_buffers=2) as (camera, stream):
        buffers: list[Buffer] = []
        for _ in range(7):
            camera.trigger()
            buffer = stream.pop(WAIT_S)
            assert buffer is not None
            buffers.append(buffer)
        statistics = stream.statistics
    ids = [buffer.frame_id for buffer in buffers]
    firsts = [int(buffer.image[0, 0]) for buffer in buffers if buffer.image is not None]
    times = [buffer.camera_time_ns for buffer in buffers]
    assert ids == list(range(ids[0], ids[0] + 7))
    assert np.diff(firsts).tolist() == [1000] * 6
    assert times == sorted(times)
    assert (statistics.n_completed, statistics.n_failed, statistics.n_underruns) == (7, 0, 0)


def test_popping_nothing_returns_none(fake: FakeCamera) -> None:
    with opened(fake) as (_, stream):
        assert stream.pop(0.0) is None
        assert stream.pop(0.02) is None


def test_stream_options_are_taken(fake: FakeCamera) -> None:
    options = StreamOptions(packet_timeout_s=0.05, frame_retention_s=5.0, resend=True)
    with Camera(fake.address) as camera:
        set_region(camera, REGION)
        stream = camera.create_stream(3, options)
        camera.start()
        buffer = stream.pop(WAIT_S)
    assert buffer is not None
    assert buffer.status == "success"


def test_closing_is_legal_in_any_order_and_again(fake: FakeCamera) -> None:
    with opened(fake) as (camera, stream):
        camera.close()
        stream.close()
        camera.close()
        with pytest.raises(AravisError, match="closed"):
            stream.pop(0.0)
        with pytest.raises(AravisError, match="closed"):
            camera.trigger()
    with opened(fake) as (camera, stream):
        stream.close()
        stream.close()
        camera.stop()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nobody counts files")
def test_opening_and_closing_leaves_nothing_behind(fake: FakeCamera) -> None:
    def counts() -> tuple[int, int, int]:
        process = Path("/proc/self")
        n_files, n_threads = (len(list((process / folder).iterdir())) for folder in ("fd", "task"))
        return n_files, n_threads, threading.active_count()

    def use() -> None:
        with opened(fake) as (camera, stream):
            camera.trigger()
            assert stream.pop(WAIT_S) is not None

    use()
    before = counts()
    for _ in range(50):
        with Camera(fake.address) as camera:
            camera.create_stream(3)
    use()
    assert counts() == before


def test_cameras_are_found_and_opened_by_their_serial_number() -> None:
    need_library(load_library)
    serials = [f"P{os.getpid()}", f"Q{os.getpid()}"]
    with FakeCamera(pattern, serial=serials[0]) as first, FakeCamera(pattern, serial=serials[1]) as second:
        found = {camera.serial: camera for camera in find_cameras()}
        assert [found[serial].address for serial in serials] == [first.address, second.address]
        assert found[serials[0]].protocol == "GigEVision"
        assert str(found[serials[0]]) == f"labseq Simulated, serial number {serials[0]}, {first.address}"
        with Camera(serials[1]) as camera:
            assert camera.serial == serials[1]


def _found(*serials: str) -> tuple[FoundCamera, ...]:
    return tuple(FoundCamera(f"id {s}", "", "Maker", "M1", s, "", "USB3Vision") for s in serials)


@pytest.mark.parametrize(
    ("name", "found", "text"),
    [
        (None, _found(), "no camera answered"),
        (None, _found("A1", "A2"), "there are 2 cameras: Maker M1, serial number A1, USB3Vision; .*A2"),
        ("A3", _found("A1"), "no camera has the id or the serial number 'A3'; found: .*A1"),
        ("A1", _found("A1", "A1"), "more than one camera has"),
    ],
)
def test_a_name_that_fits_no_camera_is_told_with_those_there_are(
    monkeypatch: pytest.MonkeyPatch, name: str | None, found: tuple[FoundCamera, ...], text: str
) -> None:
    monkeypatch.setattr("labseq_aravis.camera.find_cameras", lambda: found)
    with pytest.raises(AravisError, match=text) as caught:
        camera_id(name)
    assert caught.value.code == "not found"


@pytest.mark.parametrize("name", [None, "A1", "id A1"])
def test_the_only_camera_needs_no_name(monkeypatch: pytest.MonkeyPatch, name: str | None) -> None:
    monkeypatch.setattr("labseq_aravis.camera.find_cameras", lambda: _found("A1"))
    assert camera_id(name) == "id A1"


def test_no_camera_at_an_address_is_told() -> None:
    need_library(load_library)
    with pytest.raises(AravisError, match=r"127\.255\.0\.9") as caught:
        Camera("127.255.0.9")
    assert caught.value.code == "not found"


@given(
    st.sampled_from(sorted(MONO)),
    st.integers(1, 20),
    st.integers(1, 20),
    st.integers(0, 5),
    st.integers(0, 2**32),
)
def test_any_image_is_unpacked_line_by_line(
    name: str, height: int, width: int, padding: int, seed: int
) -> None:
    n_bits = int(name.removeprefix("Mono"))
    image = np.random.default_rng(seed).integers(0, 2**n_bits, (height, width), dtype=np.uint16)
    lines = image.astype(np.uint8 if n_bits == 8 else "<u2").view(np.uint8)
    data = np.pad(lines, ((0, 0), (0, padding)), constant_values=0xA5).tobytes()
    memory = ctypes.create_string_buffer(data, len(data))
    result = unpacked(ctypes.addressof(memory), len(data), MONO[name], (height, width), padding)
    ctypes.memset(memory, 0, len(data))
    np.testing.assert_array_equal(result, image)
    assert result.dtype == np.uint16


def test_packed_formats_and_short_frames_are_refused() -> None:
    memory = ctypes.create_string_buffer(24)
    with pytest.raises(PixelFormatError, match=r"0x010C0006; expected Mono8"):
        unpacked(ctypes.addressof(memory), 24, 0x010C0006, (4, 4))
    with pytest.raises(AravisError, match="has 24 bytes; expected 32"):
        unpacked(ctypes.addressof(memory), 24, MONO["Mono16"], (4, 4))


def test_nothing_is_loaded_when_the_package_is_imported() -> None:
    checks = "a.library._library is None and not {'numpy', 'labseq'} & set(sys.modules)"
    program = f"import sys, labseq_aravis as a, labseq_genicam_sim.__main__; sys.exit(not ({checks}))"
    subprocess.run([sys.executable, "-c", program], check=True)
