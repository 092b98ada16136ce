"""The simulated library with DCAM's functions as C functions, called with the structures of its header."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from threading import RLock
from typing import Any, Final

from labseq_dcam_sim.camera import SimulatedCamera
from labseq_dcam_sim.header import FRAME_READY, MONO16, SIGNATURES, Code
from labseq_dcam_sim.properties import Refused, require

WITHOUT_LOCK: Final = ("dcamwait_start", "dcambuf_lockframe")
"""Functions that may wait, so other calls must be possible meanwhile."""
FIRST_HANDLE: Final = 0x1000
FIRST_WAIT: Final = 0x2000


class SimulatedLibrary:
    """The C functions of DCAM-API with some cameras, as attributes like a loaded library's.

    Args:
        cameras: The cameras of the computer.
    """

    def __init__(self, cameras: Sequence[SimulatedCamera]) -> None:
        self._cameras, self._lock = cameras, RLock()
        self._is_initialized = False
        for name, types in SIGNATURES.items():
            pointers = [_passed(kind) for kind in types]
            function: Any = ctypes.CFUNCTYPE(ctypes.c_int32, *pointers)(self._entry(name))
            function.__name__ = name
            setattr(self, name, function)

    def _entry(self, name: str) -> Callable[..., int]:
        body = getattr(self, f"_{name}")

        def call(*arguments: Any) -> int:
            try:
                if name in WITHOUT_LOCK:
                    body(*arguments)
                else:
                    with self._lock:
                        body(*arguments)
            except Refused as refused:
                return refused.code
            return Code.SUCCESS

        return call

    def _camera(self, handle: int | None, first: int = FIRST_HANDLE) -> SimulatedCamera:
        """The open camera with a handle."""
        code = Code.INVALIDHANDLE if first == FIRST_HANDLE else Code.INVALIDWAITHANDLE
        index = (handle or 0) - first
        require(0 <= index < len(self._cameras) and self._cameras[index].is_open, code)
        camera = self._cameras[index]
        camera.check()
        return camera

    # the library and its cameras

    def _dcamapi_init(self, param: Any) -> None:
        _check_size(param, "size")
        connected = [camera for camera in self._cameras if not camera.faults.not_connected]
        require(connected, Code.NOCAMERA)
        self._is_initialized = True
        param.contents.iDeviceCount = len(connected)

    def _dcamapi_uninit(self) -> None:
        for camera in self._cameras:
            camera.close()
        self._is_initialized = False

    def _dcamdev_open(self, param: Any) -> None:
        _check_size(param, "size")
        index = param.contents.index
        require(self._is_initialized and 0 <= index < len(self._cameras), Code.INVALIDCAMERA)
        self._cameras[index].open()
        param.contents.hdcam = FIRST_HANDLE + index

    def _dcamdev_close(self, handle: int) -> None:
        self._camera(handle).close()

    def _dcamdev_getstring(self, handle: int, param: Any) -> None:
        _check_size(param, "size")
        wanted = param.contents
        _write(wanted.text, wanted.textbytes, self._camera(handle).text(wanted.iString))

    # properties

    def _dcamprop_getattr(self, handle: int, param: Any) -> None:
        _check_size(param, "cbSize")
        properties, wanted = self._camera(handle).properties, param.contents
        limits = properties.limits[properties.find(wanted.iProp)]
        wanted.attribute = ctypes.c_int32(limits.attribute).value
        wanted.valuemin, wanted.valuemax = limits.low, limits.high
        wanted.valuestep, wanted.valuedefault = limits.step, limits.default

    def _dcamprop_getvalue(self, handle: int, number: int, value: Any) -> None:
        value[0] = self._camera(handle).get_value(number)

    def _dcamprop_setvalue(self, handle: int, number: int, value: float) -> None:
        self._camera(handle).set_value(number, value)

    def _dcamprop_setgetvalue(self, handle: int, number: int, value: Any, _option: int) -> None:
        value[0] = self._camera(handle).set_value(number, value[0])

    def _dcamprop_getnextid(self, handle: int, number: Any, _option: int) -> None:
        number[0] = self._camera(handle).properties.next_to(number[0])

    def _dcamprop_getname(self, handle: int, number: int, text: int, n_bytes: int) -> None:
        _write(text, n_bytes, self._camera(handle).properties.find(number).text)

    def _dcamprop_getvaluetext(self, handle: int, param: Any) -> None:
        _check_size(param, "cbSize")
        wanted = param.contents
        text = self._camera(handle).properties.text(wanted.iProp, wanted.value)
        _write(wanted.text, wanted.textbytes, text)

    # buffer and series

    def _dcambuf_alloc(self, handle: int, n_frames: int) -> None:
        self._camera(handle).allocate(n_frames)

    def _dcambuf_release(self, handle: int, _kind: int) -> None:
        self._camera(handle).release()

    def _dcambuf_lockframe(self, handle: int, param: Any) -> None:
        _check_size(param, "size")
        camera, wanted = self._camera(handle), param.contents
        frame, stamp, address = camera.lock(wanted.iFrame)
        height, width = frame.image.shape
        y, x, *_ = camera.properties.mode.region or (0, 0)
        since_us = round((frame.t_start_s + 1.0) * 1e6)  # a stamp of 0 would be none
        wanted.buf, wanted.rowbytes, wanted.type = address, 2 * width, MONO16
        wanted.width, wanted.height, wanted.left, wanted.top = width, height, x, y
        wanted.timestamp_sec, wanted.timestamp_microsec = divmod(since_us, 1_000_000)
        wanted.framestamp = wanted.camerastamp = stamp

    def _dcamcap_start(self, handle: int, mode: int) -> None:
        self._camera(handle).start(mode)

    def _dcamcap_stop(self, handle: int) -> None:
        self._camera(handle).stop()

    def _dcamcap_status(self, handle: int, status: Any) -> None:
        status[0] = self._camera(handle).status

    def _dcamcap_transferinfo(self, handle: int, param: Any) -> None:
        _check_size(param, "size")
        exposures, wanted = self._camera(handle).exposures, param.contents
        wanted.nFrameCount, wanted.nNewestFrameIndex = (
            exposures.n_arrived,
            max(exposures.buffer, default=0) - 1,
        )

    def _dcamcap_firetrigger(self, handle: int, _kind: int) -> None:
        self._camera(handle).fire()

    # waiting

    def _dcamwait_open(self, param: Any) -> None:
        _check_size(param, "size")
        self._camera(param.contents.hdcam)
        param.contents.hwait = FIRST_WAIT + param.contents.hdcam - FIRST_HANDLE
        param.contents.supportevent = FRAME_READY

    def _dcamwait_close(self, handle: int) -> None:
        self._camera(handle, FIRST_WAIT)

    def _dcamwait_start(self, handle: int, param: Any) -> None:
        _check_size(param, "size")
        wanted = param.contents
        require(wanted.eventmask & FRAME_READY, Code.INVALIDPARAM)
        self._camera(handle, FIRST_WAIT).wait(wanted.timeout)
        wanted.eventhappened = FRAME_READY

    def _dcamwait_abort(self, handle: int) -> None:
        self._camera(handle, FIRST_WAIT).abort_wait()


def _passed(kind: Any) -> Any:
    """The type of an argument, a pointer for a structure."""
    is_structure = isinstance(kind, type) and issubclass(kind, ctypes.Structure)
    return ctypes.POINTER(kind) if is_structure else kind


def _check_size(param: Any, field: str) -> None:
    """Refuse a structure of another size than the header's."""
    require(getattr(param.contents, field) == ctypes.sizeof(param.contents), Code.INVALIDPARAM)


def _write(address: int, n_bytes: int, text: str) -> None:
    encoded = text.encode()[: max(0, n_bytes - 1)] + b"\0"
    ctypes.memmove(address, encoded, len(encoded))
