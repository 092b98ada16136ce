"""The simulated GigE Vision camera: a process of its own, with pixels from this one."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from labseq_aravis import AravisError, Camera
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure
from numpy.typing import NDArray

from .labseq_genicam_rig import WAIT_S, needs_aravis, opened, pattern, plugged_in

pytestmark = needs_aravis


def test_an_exposure_that_goes_wrong_fails_its_frame_and_is_reported() -> None:
    def expose(request: Exposure) -> NDArray[np.uint16]:
        if request.n == 0:
            raise RuntimeError("no light in exposure 0")
        return pattern(request)[:, : -1 if request.n == 1 else None]

    with plugged_in(expose) as fake, opened(fake) as (camera, stream):
        for n in range(3):
            camera.execute("TriggerSoftware")
            assert fake.wait_for_image(n, WAIT_S)
        buffers = [stream.pop(WAIT_S) for _ in range(3)]
        assert [buffer is not None and buffer.image is not None for buffer in buffers] == [False, False, True]
        for text in ("no light", "expected uint16"):
            with pytest.raises((RuntimeError, ValueError), match=text):
                fake.raise_pending()
        fake.raise_pending()


def test_cameras_that_start_at_the_same_time_get_an_address_each() -> None:
    """As those of tests that run beside one another: each begins at port 3956 of 127.0.0.1, and leaves it."""
    fakes = [FakeCamera(pattern, serial=f"T{n}") for n in range(4)]
    try:
        with ThreadPoolExecutor(len(fakes)) as pool:
            list(pool.map(FakeCamera.start, fakes))
        for fake in fakes:
            with Camera(fake.address) as camera:
                assert camera.serial == fake._serial
        assert len({fake.address for fake in fakes} - {"127.0.0.1"}) == len(fakes)
    finally:
        for fake in fakes:
            fake.stop()


def test_a_process_that_cannot_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_genicam_sim.fake.sys.executable", "/bin/false")
    with pytest.raises(AravisError, match="process of the simulated camera has ended"):
        FakeCamera(pattern).start()


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="only Linux waits for other processes' children")
def test_the_process_ends_with_its_parent() -> None:
    program = (
        "import os, numpy as np\n"
        "from labseq_genicam_sim.fake import FakeCamera\n"
        "fake = FakeCamera(lambda request: np.zeros((request.height, request.width), np.uint16))\n"
        "fake.start()\n"
        "print(fake._process.pid, flush=True)\n"
        "input()\n"
        "os._exit(1)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert parent.stdin is not None
    assert parent.stdout is not None
    with parent.stdin, parent.stdout:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        assert parent.wait(WAIT_S) != 0
        assert select.select([child], [], [], WAIT_S)[0]
        os.close(child)
