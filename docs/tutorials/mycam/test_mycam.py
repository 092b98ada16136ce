"""The camera keeps its promises."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from labseq.plugin import Context, DeviceError
from labseq.testing import CameraContract

from .camera import MycamCamera, MycamSettings


class TestMycam(CameraContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], MycamCamera]:
        return partial(MycamCamera, MycamSettings(serial="A-17"))


def test_a_camera_that_is_not_there() -> None:
    camera = MycamCamera(MycamSettings(serial="A-18"), Context("camera"))
    with pytest.raises(DeviceError, match="no camera 'A-18' found; check `serial` and the cable"):
        camera.open()
