"""The simulator of Andor's SDK, called as pylablib calls it: through C, with the SDK's codes."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_andor.codes import Code
from labseq_andor.heads import HEADS, IXON_897
from labseq_andor.library import load_pylablib
from labseq_andor_sim import SimulatedCamera, SimulatedSdk
from labseq_andor_sim.functions import Refused
from labseq_andor_sim.library import FUNCTIONS

from labseq.testing.fakes import FakeClock

from .labseq_camera_rig import NoisyWorld
from .needs import need_library

SHAPE = (32, 48)


@pytest.fixture(autouse=True, scope="module")
def pylablib() -> None:
    need_library(lambda: load_pylablib("camera"))


class Wire:
    """The simulator's C functions, with a camera attached."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.world = NoisyWorld(self.clock, SHAPE)
        self.camera = SimulatedCamera(self.world, self.clock, IXON_897, SHAPE)
        define_functions = load_pylablib("camera").atmcd32d_lib.define_functions
        self.sdk = SimulatedSdk(define_functions)
        define_functions(self.sdk)
        self.sdk.attach(self.camera)
        handle = ctypes.c_long()
        assert self("GetCameraHandle", 0, ctypes.byref(handle)) == Code.SUCCESS
        assert self("SetCurrentCamera", handle) == Code.SUCCESS
        self.handle = handle.value

    def __call__(self, function: str, *arguments: Any) -> int:
        return int(getattr(self.sdk, function)(*arguments))

    def start(self, trigger: int = 10, mode: int = 5) -> None:
        calls: list[tuple[str, tuple[int, ...]]] = [
            ("SetReadMode", (4,)),
            ("SetImage", (1, 1, 1, 48, 1, 32)),
            ("SetAcquisitionMode", (mode,)),
            ("SetTriggerMode", (trigger,)),
            ("StartAcquisition", ()),
        ]
        for function, arguments in calls:
            assert self(function, *arguments) == Code.SUCCESS

    def status(self) -> int:
        value = ctypes.c_int()
        assert self("GetStatus", ctypes.byref(value)) == Code.SUCCESS
        return value.value


@pytest.fixture
def wire() -> Wire:
    return Wire()


def test_nothing_works_before_initialize_and_after_shut_down(wire: Wire) -> None:
    assert wire("CoolerON") == Code.NOT_INITIALIZED
    assert wire("Initialize", b"") == Code.SUCCESS
    assert wire("CoolerON") == Code.SUCCESS
    assert wire("ShutDown") == Code.SUCCESS
    assert wire("CoolerON") == wire("ShutDown") == Code.NOT_INITIALIZED


def test_settings_are_refused_while_it_acquires(wire: Wire) -> None:
    wire("Initialize", b"")
    wire.start()
    assert wire.status() == Code.ACQUIRING
    for function, arguments in {
        "SetExposureTime": (ctypes.c_float(0.1),),
        "SetEMCCDGain": (0,),
        "SetShutter": (1, 2, 0, 0),
        "SetImage": (1, 1, 1, 8, 1, 8),
        "StartAcquisition": (),
        "GetTemperatureF": (ctypes.byref(ctypes.c_float()),),
    }.items():
        assert wire(function, *arguments) == Code.ACQUIRING, function
    assert wire("AbortAcquisition") == Code.SUCCESS
    assert wire("AbortAcquisition") == Code.IDLE
    assert wire.status() == Code.IDLE
    assert wire("SetExposureTime", ctypes.c_float(0.1)) == Code.SUCCESS


def test_the_software_trigger_wants_its_mode(wire: Wire) -> None:
    wire("Initialize", b"")
    assert wire("SendSoftwareTrigger") == Code.INVALID_MODE
    wire.start()
    assert wire("SendSoftwareTrigger") == Code.SUCCESS
    assert wire("SendSoftwareTrigger") == Code.ERROR_CODES
    wire("AbortAcquisition")
    assert wire("SendSoftwareTrigger") == Code.IDLE


def test_gain_above_300_is_advanced_and_only_real_gain_is_a_factor(wire: Wire) -> None:
    wire("Initialize", b"")
    assert wire("SetEMCCDGain", 100) == Code.P1INVALID
    wire("SetEMGainMode", 3)
    codes = [wire("SetEMCCDGain", gain) for gain in (0, 1, 2, 300, 301)]
    assert codes == [Code.SUCCESS, Code.P1INVALID, Code.SUCCESS, Code.SUCCESS, Code.P1INVALID]
    wire("SetEMAdvanced", 1)
    assert [wire("SetEMCCDGain", gain) for gain in (1000, 1001)] == [Code.SUCCESS, Code.P1INVALID]


def test_a_frame_goes_into_a_buffer_of_its_size_only(wire: Wire) -> None:
    wire("Initialize", b"")
    wire.start()
    wire("SendSoftwareTrigger")
    first, last = ctypes.c_long(), ctypes.c_long()
    new = ("GetNumberNewImages", ctypes.byref(first), ctypes.byref(last))
    assert wire(*new) == Code.NO_NEW_DATA
    assert wire("WaitForAcquisitionByHandleTimeOut", wire.handle, 1) == Code.NO_NEW_DATA
    wire.clock.sleep(1.0)
    assert wire("WaitForAcquisitionByHandleTimeOut", wire.handle, 1) == Code.SUCCESS
    assert (wire(*new), first.value, last.value) == (Code.SUCCESS, 1, 1)
    image = np.zeros(SHAPE, np.uint16)
    pixels = image.ctypes.data_as(ctypes.POINTER(ctypes.c_ushort))
    valid = (ctypes.byref(ctypes.c_long()), ctypes.byref(ctypes.c_long()))
    assert wire("GetImages16", 1, 1, pixels, image.size - 1, *valid) == Code.P4INVALID
    assert wire("GetImages16", 2, 2, pixels, image.size, *valid) == Code.P1INVALID
    assert not image.any()
    assert wire("GetImages16", 1, 1, pixels, image.size, *valid) == Code.SUCCESS
    np.testing.assert_array_equal(image, wire.world.shown[0])
    assert wire(*new) == Code.NO_NEW_DATA


@given(st.integers(-2, 50), st.integers(-2, 50), st.integers(-2, 34), st.integers(-2, 34), st.integers(0, 5))
def test_an_image_is_taken_exactly_if_it_fits(left: int, right: int, bottom: int, top: int, b: int) -> None:
    camera = SimulatedCamera(NoisyWorld(clock := FakeClock(), SHAPE), clock, IXON_897, SHAPE)
    refused = False
    try:
        camera.optics.set_image(b, b, left, right, bottom, top)
    except Refused:
        refused = True
    fits = b > 0 and 1 <= left <= right <= 48 and 1 <= bottom <= top <= 32
    fits = fits and (right - left + 1) % b == 0 and (top - bottom + 1) % b == 0
    assert refused != fits
    if fits:
        assert camera.optics.frame_shape == ((top - bottom + 1) // b, (right - left + 1) // b)


def test_the_codes_are_those_of_andors_header() -> None:
    names = load_pylablib("camera").DRV_STATUS
    for code in Code:
        assert names[f"DRV_{code.name}"] == code


def test_every_function_is_one_that_the_library_has(wire: Wire) -> None:
    for name in FUNCTIONS:
        assert isinstance(getattr(wire.sdk, name).argnames, list), name


@pytest.mark.parametrize("head", HEADS, ids=lambda head: head.model)
def test_heads_are_listed_from_fast_to_slow(head: Any) -> None:
    assert list(head.em_rates_hz) == sorted(head.em_rates_hz, reverse=True)
    assert list(head.shifts_s) == sorted(head.shifts_s)
