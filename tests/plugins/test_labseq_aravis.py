"""The binding of libaravis, against the library's own simulated camera."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_aravis import (
    AravisError,
    Camera,
    FoundCamera,
    PixelFormatError,
    find_cameras,
)
from labseq_aravis.camera import camera_id
from labseq_aravis.stream import MONO, unpacked
from labseq_genicam_sim.fake import FakeCamera

from .labseq_genicam_rig import WAIT_S, needs_aravis, opened, pattern, plugged_in


@pytest.fixture
def fake() -> Iterator[FakeCamera]:
    with plugged_in() as fake:
        yield fake


@needs_aravis
def test_closing_is_legal_in_any_order_and_again(fake: FakeCamera) -> None:
    with opened(fake) as (camera, stream):
        camera.close()
        stream.close()
        camera.close()
        with pytest.raises(AravisError, match="closed"):
            stream.pop(0.0)
        with pytest.raises(AravisError, match="closed"):
            camera.execute("TriggerSoftware")
    with opened(fake) as (camera, stream):
        stream.close()
        stream.close()
        camera.stop()


@needs_aravis
@pytest.mark.skipif(sys.platform != "linux", reason="counts the files in /proc")
def test_opening_and_closing_leaves_nothing_behind(fake: FakeCamera) -> None:
    def counts() -> tuple[int, int, int]:
        n_files, n_threads = (len(list(Path("/proc/self", folder).iterdir())) for folder in ("fd", "task"))
        return n_files, n_threads, threading.active_count()

    def use() -> None:
        with opened(fake) as (camera, stream):
            camera.execute("TriggerSoftware")
            assert stream.pop(WAIT_S) is not None

    use()
    before = counts()
    for _ in range(15):
        with Camera(fake.address) as camera:
            camera.create_stream(3)
    use()
    after = counts()
    # fewer if an earlier test's camera has only now been let go
    assert all(now <= then for now, then in zip(after, before, strict=True)), (before, after)


@needs_aravis
def test_cameras_are_found_and_opened_by_their_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = f"P{os.getpid()}", f"Q{os.getpid()}"
    found: list[FoundCamera] = []

    def find() -> tuple[FoundCamera, ...]:
        found.extend(find_cameras())
        return tuple(found)

    monkeypatch.setattr("labseq_aravis.camera.find_cameras", find)
    with FakeCamera(pattern, serial=first) as one, FakeCamera(pattern, serial=second) as other:
        with Camera(second) as camera:
            assert camera.serial == second
        cameras = {camera.serial: camera for camera in found}
        assert [cameras[serial].address for serial in (first, second)] == [one.address, other.address]
        assert cameras[first].protocol == "GigEVision"
        assert str(cameras[first]) == f"labseq Simulated, serial number {first}, {one.address}"


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
def test_a_name_that_fits_no_camera_is_reported_with_those_there_are(
    monkeypatch: pytest.MonkeyPatch, name: str | None, found: tuple[FoundCamera, ...], text: str
) -> None:
    monkeypatch.setattr("labseq_aravis.camera.find_cameras", lambda: found)
    with pytest.raises(AravisError, match=text) as caught:
        camera_id(name)
    assert caught.value.code == "not found"
    monkeypatch.setattr("labseq_aravis.camera.find_cameras", lambda: _found("A1"))
    assert {camera_id(fitting) for fitting in (None, "A1", "id A1")} == {"id A1"}
    here = replace(*_found("A1"), address="192.168.7.2")
    monkeypatch.setattr("labseq_aravis.camera.find_cameras", lambda: (here,))
    assert camera_id("A1") == "192.168.7.2"


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
    with pytest.raises(AravisError, match="has 24 bytes, not 32"):
        unpacked(ctypes.addressof(memory), 24, MONO["Mono16"], (4, 4))


def test_nothing_is_loaded_when_the_package_is_imported() -> None:
    checks = "a.library._library is None and not {'numpy', 'labseq'} & set(sys.modules)"
    program = f"import sys, labseq_aravis as a, labseq_genicam_sim.__main__; sys.exit(not ({checks}))"
    subprocess.run([sys.executable, "-c", program], check=True)
