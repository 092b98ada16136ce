"""The simulated DCAM library as C calls it: layouts of the header, and what it refuses."""

from __future__ import annotations

import ctypes
import importlib
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest
from labseq_dcam_sim import SimulatedCamera, SimulatedLibrary, header
from labseq_dcam_sim.header import Code, Property, Status

from labseq.testing.fakes import FakeClock

from .labseq_camera_rig import NoisyWorld

SHAPE: Final = (96, 128)
P = Property


class Dcam:
    """A computer with a simulated camera, and its library called by ctypes as a C program calls it."""

    def __init__(self, is_open: bool = True) -> None:
        self.clock = FakeClock()
        self.world = NoisyWorld(self.clock, SHAPE)
        self.camera = SimulatedCamera(self.world, self.clock, SHAPE)
        self.library: Any = SimulatedLibrary([self.camera])
        self.handle = ctypes.c_void_p(None)
        if is_open:
            init, opened = (self.filled(kind) for kind in (header.DCAMAPI_INIT, header.DCAMDEV_OPEN))
            assert self.library.dcamapi_init(init) == Code.SUCCESS
            assert self.library.dcamdev_open(opened) == Code.SUCCESS
            self.handle = ctypes.c_void_p(opened.hdcam)

    @staticmethod
    def filled(kind: Any, **fields: Any) -> Any:
        structure = kind(**fields)
        setattr(structure, kind._fields_[0][0], ctypes.sizeof(structure))
        return structure

    def set(self, number: int, value: float) -> int:
        return self.library.dcamprop_setvalue(self.handle, number, value)

    def get(self, number: int) -> float:
        value = ctypes.c_double()
        assert self.library.dcamprop_getvalue(self.handle, number, value) == Code.SUCCESS
        return value.value

    def status(self) -> int:
        value = ctypes.c_int32()
        assert self.library.dcamcap_status(self.handle, value) == Code.SUCCESS
        return value.value

    def waiter(self) -> Any:
        opened = self.filled(header.DCAMWAIT_OPEN, hdcam=self.handle)
        assert self.library.dcamwait_open(opened) == Code.SUCCESS
        return ctypes.c_void_p(opened.hwait)

    def wait(self, waiter: Any) -> int:
        return self.library.dcamwait_start(
            waiter, self.filled(header.DCAMWAIT_START, eventmask=header.FRAME_READY, timeout=1)
        )


def test_a_series_goes_through_the_states_of_the_manual() -> None:
    dcam = Dcam()
    library, handle = dcam.library, dcam.handle
    assert dcam.status() == Status.STABLE
    assert library.dcamcap_start(handle, header.SNAP) == Code.NOTREADY  # there is no buffer
    assert library.dcamcap_firetrigger(handle, 0) == Code.NOTBUSY
    assert dcam.set(P.TRIGGER_SOURCE, 3) == Code.SUCCESS
    assert library.dcambuf_alloc(handle, 2) == Code.SUCCESS
    assert dcam.status() == Status.READY
    assert library.dcambuf_alloc(handle, 2) == Code.NOTSTABLE
    assert dcam.set(P.BINNING, 2) == Code.ACCESSDENY  # the buffer has the old size
    assert dcam.set(P.TRIGGER_SOURCE, 3) == Code.SUCCESS
    assert library.dcamcap_start(handle, header.SNAP) == Code.SUCCESS
    assert dcam.status() == Status.BUSY
    for call, expected in (
        (lambda: library.dcamcap_start(handle, header.SNAP), Code.BUSY),
        (lambda: library.dcambuf_release(handle, 0), Code.BUSY),
        (lambda: dcam.set(P.TRIGGER_SOURCE, 1), Code.ACCESSDENY),
        (lambda: dcam.set(P.EXPOSURE_TIME, 0.02), Code.SUCCESS),
        (lambda: library.dcamcap_firetrigger(handle, 0), Code.SUCCESS),
        (lambda: library.dcamcap_firetrigger(handle, 0), Code.TOOFREQUENTTRIGGER),
    ):
        assert call() == expected
    frame = dcam.filled(header.DCAMBUF_FRAME, iFrame=0)
    assert library.dcambuf_lockframe(handle, frame) == Code.INVALIDFRAMEINDEX  # it is not read yet
    dcam.clock.sleep(1.0)
    assert library.dcambuf_lockframe(handle, frame) == Code.SUCCESS
    assert (frame.width, frame.height, frame.rowbytes, frame.type) == (128, 96, 256, header.MONO16)
    pixels = (ctypes.c_uint16 * (96 * 128)).from_address(frame.buf)
    assert list(pixels) == dcam.world.shown[0].ravel().tolist()
    assert library.dcamcap_firetrigger(handle, 0) == Code.SUCCESS
    dcam.clock.sleep(1.0)
    info = dcam.filled(header.DCAMCAP_TRANSFERINFO)
    assert library.dcamcap_transferinfo(handle, info) == Code.SUCCESS
    assert (info.nFrameCount, info.nNewestFrameIndex) == (2, 1)
    assert dcam.status() == Status.READY  # a snap ends with its buffer


@pytest.mark.parametrize(
    ("number", "value", "code"),
    [
        (P.EXPOSURE_TIME, 1e-6, Code.OUTOFRANGE),
        (P.SUBARRAY_HSIZE, 132, Code.OUTOFRANGE),
        (P.SUBARRAY_HSIZE, 30, Code.INVALIDVALUE),
        (P.SUBARRAY_VPOS, 2, Code.INVALIDVALUE),
        (P.SUBARRAY_HPOS, 32, Code.INVALIDSUBARRAY),
        (P.BINNING, 3, Code.INVALIDVALUE),
        (P.TRIGGER_MODE, 9, Code.OUTOFRANGE),
        (P.TIMING_READOUT_TIME, 1.0, Code.NOTWRITABLE),
        (0x12345, 1.0, Code.INVALIDPROPERTYID),
    ],
)
def test_a_property_refuses_what_it_cannot_be(number: int, value: float, code: Code) -> None:
    dcam = Dcam()
    assert dcam.set(P.SUBARRAY_MODE, 2) == Code.SUCCESS
    assert dcam.set(number, value) == code
    assert dcam.get(P.SUBARRAY_HSIZE) == 128


def test_handles_that_are_closed_and_waits_that_were_aborted() -> None:
    dcam = Dcam(is_open=False)
    opened = dcam.filled(header.DCAMDEV_OPEN)
    assert dcam.library.dcamdev_open(opened) == Code.INVALIDCAMERA  # the library is not initialised
    assert dcam.library.dcamapi_init(header.DCAMAPI_INIT(size=16)) == Code.INVALIDPARAM
    dcam = Dcam()
    assert dcam.library.dcamdev_open(dcam.filled(header.DCAMDEV_OPEN)) == Code.EXCLUDED
    waiter = dcam.waiter()
    assert dcam.wait(waiter) == Code.TIMEOUT
    assert dcam.library.dcamwait_abort(waiter) == Code.SUCCESS
    assert [dcam.wait(waiter), dcam.wait(waiter)] == [Code.ABORT, Code.TIMEOUT]
    assert dcam.library.dcamdev_close(dcam.handle) == Code.SUCCESS
    assert dcam.wait(waiter) == Code.INVALIDWAITHANDLE
    assert dcam.set(P.BINNING, 1) == Code.INVALIDHANDLE


LAYOUTS: Final[dict[str, str]] = {
    "DCAMAPI_INIT": "int32 size, iDeviceCount, reserved, initoptionbytes; void *initoption, *guid;",
    "DCAMDEV_OPEN": "int32 size, index; void *hdcam;",
    "DCAMDEV_STRING": "int32 size, iString; char *text; int32 textbytes;",
    "DCAMPROP_ATTR": "int32 cbSize, iProp, option, iReserved1, attribute, iGroup, iUnit, attribute2; "
    "double valuemin, valuemax, valuestep, valuedefault; "
    "int32 nMaxChannel, iReserved3, nMaxView, iProp_NumberOfElement, iProp_ArrayBase, iPropStep_Element;",
    "DCAMPROP_VALUETEXT": "int32 cbSize, iProp; double value; char *text; int32 textbytes;",
    "DCAMCAP_TRANSFERINFO": "int32 size, iKind, nNewestFrameIndex, nFrameCount;",
    "DCAMBUF_FRAME": "int32 size, iKind, option, iFrame; void *buf; int32 rowbytes, type, width, height; "
    "int32 left, top; unsigned int timestamp_sec; int32 timestamp_microsec, framestamp, camerastamp;",
    "DCAMWAIT_OPEN": "int32 size, supportevent; void *hwait, *hdcam;",
    "DCAMWAIT_START": "int32 size, eventhappened, eventmask, timeout;",
}
"""Members of the structures of ``dcamapi4.h`` (June 2021), in C."""


@pytest.mark.needs("c-compiler", "pylablib")
def test_simulator_and_pylablib_have_the_layout_that_a_compiler_gives_the_header(tmp_path: Path) -> None:
    lines = ["#include <stddef.h>", "#include <stdio.h>", "typedef int int32;", "#pragma pack(8)"]
    lines += [f"typedef struct {{ {members} }} {name};" for name, members in LAYOUTS.items()]
    lines += ["int main(void) {"]
    for name in LAYOUTS:
        lines += [f'printf("{name} %zu\\n", sizeof({name}));']
        for field, _ in getattr(header, name)._fields_:
            lines += [f'printf("{name}.{field} %zu\\n", offsetof({name}, {field}));']
    source, program = tmp_path / "layout.c", tmp_path / "layout"
    source.write_text("\n".join([*lines, "return 0; }"]), encoding="utf-8")
    subprocess.run(["cc", "-o", program, source], check=True)
    printed = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    compiled = {name: int(number) for name, number in map(str.split, printed.splitlines())}
    theirs: Any = importlib.import_module("pylablib.devices.DCAM.dcamapi4_defs")
    for name in LAYOUTS:
        own, other = getattr(header, name), getattr(theirs, name)
        assert ctypes.sizeof(own) == ctypes.sizeof(other) == compiled[name]
        for field, _ in own._fields_:
            assert getattr(own, field).offset == compiled[f"{name}.{field}"]
            if not field.startswith("timestamp_"):  # pylablib has a structure there
                assert getattr(other, field).offset == compiled[f"{name}.{field}"]
    properties: Any = importlib.import_module("pylablib.devices.DCAM.dcamprop_defs")
    assert {*Property} <= {int(one) for one in properties.DCAMIDPROP}
