"""The simulator of Andor's SDK, called as pylablib calls it: through C, with the SDK's codes."""

from __future__ import annotations

import ctypes
from typing import Any

import pytest
from labseq_andor.codes import Code
from labseq_andor.heads import HEADS, IXON_897
from labseq_andor.library import load_pylablib
from labseq_andor_sim import SimulatedCamera, SimulatedSdk
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
