"""The simulated library, which NI's own Python package calls in place of NI-DAQmx."""

# ruff: noqa: N802 - NI's names

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from labseq_nidaqmx.library import import_package
from labseq_nidaqmx.outputs import OutputGroup
from labseq_nidaqmx.settings import NidaqmxSettings

from labseq.plugin import Context, Emergency
from labseq_nidaqmx_sim.cards import TEXTS, Code, Refused
from labseq_nidaqmx_sim.tasks import Computer

RETRY_S: Final = 1e-3
"""How long a wait for a task that is not done lasts in real time, in seconds."""
VERSION: Final = {0x1272: 24, 0x1923: 8, 0x2F22: 0}
"""Attribute of the system -> part of the version of NI-DAQmx."""
DEVICE_NAMES: Final = 0x193B
_loaded: Final[list[Any]] = []
"""The libraries in use, the last one on top, after the package's earlier library."""


class SimulatedLibrary:
    """The simulator that replaces the installed NI-DAQmx.

    Attributes:
        computer: The simulated computer with its cards, for tests.
    """

    def __init__(self, settings: NidaqmxSettings, context: Context) -> None:
        self.computer = Computer(settings, context)
        self._functions: Any = None

    def load(self, name: str) -> Any:
        """The package ``nidaqmx`` on simulated cards."""
        package = import_package(name)
        seam = importlib.import_module("nidaqmx._lib")
        if not _loaded:
            _loaded.append(vars(seam.lib_importer)["_cdll"])
        self._functions = seam.DaqFunctionImporter(Functions(self.computer))
        _loaded.append(self._functions)
        _install()
        return package

    def unload(self) -> None:
        """Give the package back the library that it had."""
        _loaded[:] = [library for library in _loaded if library is not self._functions]
        _install()

    def emergency(self, groups: Sequence[OutputGroup]) -> Emergency | None:
        """None, since simulated cards end with the process."""
        del groups


def _install() -> None:
    """Let the package call the library on top, which only works through its own attributes."""
    vars(importlib.import_module("nidaqmx._lib").lib_importer).update(
        _windll=_loaded[-1], _cdll=_loaded[-1], _encoding="utf-8" if len(_loaded) > 1 else None
    )


class Function:
    """A function of the library, which checks the types of its arguments, as ctypes does, and returns a code.

    Attributes:
        argtypes: The caller's types of the arguments, None before it sets them.
        arg_lock: For the caller.
    """

    def __init__(self, call: Callable[..., int]) -> None:
        self.argtypes: Any = None
        self.arg_lock = threading.Lock()
        self._call = call

    def __call__(self, *arguments: Any) -> int:
        """Call it with Python values, ctypes values or references."""
        for kind, argument in zip(self.argtypes or (), arguments, strict=False):  # others may be variadic
            kind.from_param(argument)
        return self._call(*map(_plain, arguments))


def _plain(argument: Any) -> Any:
    """The number or text of an argument, or of the value that a reference points to."""
    if isinstance(argument, bytes):
        return argument.decode()
    if hasattr(argument, "_obj"):
        return argument._obj  # noqa: SLF001 - what ctypes.byref refers to
    return getattr(argument, "value", argument) if not hasattr(argument, "_length_") else argument


class Functions:
    """NI's functions, by their names in C. Others are missing, as in an old NI-DAQmx."""

    def __init__(self, computer: Computer) -> None:
        self._computer = computer
        self._error = ""
        self._made: dict[str, Function] = {}

    def __getattr__(self, name: str) -> Function:
        method = getattr(type(self), f"_{name.removeprefix('DAQmx')}", None)
        if method is None or not name.startswith("DAQmx"):
            raise AttributeError(name)
        return self._made.setdefault(name, Function(lambda *arguments: self._run(method, *arguments)))

    def _run(self, method: Callable[..., int | None], *arguments: Any) -> int:
        try:
            return method(self, *arguments) or 0
        except Refused as refused:
            self._error = str(refused)
            return refused.code

    def _GetExtendedErrorInfo(self, text: Any, size: int) -> None:
        text.value = self._error.encode()[: size - 1]

    def _GetErrorString(self, code: int, text: Any, size: int) -> None:
        text.value = TEXTS[Code(code)].encode()[: size - 1]

    def _GetSystemInfoAttribute(self, attribute: int, out: Any, size: int = 0) -> int:
        if attribute == DEVICE_NAMES:
            return _put_text(out, ", ".join(self._computer.cards), size)
        out.value = VERSION[attribute]
        return 0

    def _GetDeviceAttribute(self, device: str, attribute: int, out: Any, size: int = 0) -> int:
        computer = self._computer
        if device not in computer.cards:
            raise Refused(Code.NO_SUCH_DEVICE, device)
        model = computer.model
        if attribute == 0x631:
            return _put_text(out, computer.product, size)
        values = {0x632: 0, 0x2996: bool(model.ao_rates_hz)}
        values |= {0x2997: model.ao_rates_hz[0]} if model.ao_rates_hz else {}
        values |= {0x299A: model.do_rate_hz} if model.timed_ports else {}
        if attribute not in values:
            raise Refused(Code.NOT_SUPPORTED)
        out.value = values[attribute]
        return 0

    def _GetPhysicalChanAttribute(self, name: str, attribute: int, out: Any) -> None:
        if attribute != 0x29A8:
            raise Refused(Code.NOT_SUPPORTED)
        out.value = int(self._computer.find(name, "do")[1]["port"]) in self._computer.model.timed_ports

    def _GetWriteAttribute(self, handle: int, attribute: int, out: Any) -> None:
        if attribute != 0x217E:
            raise Refused(Code.NOT_SUPPORTED)
        out.value = len(self._computer.task(handle).channels)

    def _GetTaskAttribute(self, handle: int, _attribute: int, out: Any, size: int) -> int:
        self._computer.task(handle)
        return _put_text(out, f"_unnamedTask<{handle}>", size)

    def _CreateTask(self, _name: str, out: Any) -> None:
        out.value = self._computer.new_task()

    def _ClearTask(self, handle: int) -> None:
        self._computer.clear(handle)

    def _ResetDevice(self, device: str) -> None:
        self._computer.reset(device)

    def _CreateDOChan(self, handle: int, lines: str, _name: str, grouping: int) -> None:
        names = importlib.import_module("nidaqmx.utils").unflatten_channel_string(lines)
        task = self._computer.task(handle)
        for channel in [names] if grouping == 1 else [[name] for name in names]:
            self._computer.add_channel(task, channel, "do")

    def _CreateAOVoltageChan(
        self, handle: int, output: str, _name: str, least_v: float, most_v: float, *_units: object
    ) -> None:
        self._computer.add_channel(self._computer.task(handle), [output], "ao", (least_v, most_v))

    def _CfgSampClkTiming(
        self, handle: int, source: str, rate_hz: float, _edge: int, _mode: int, n_samples: int
    ) -> None:
        self._computer.set_timing(self._computer.task(handle), source, rate_hz, n_samples)

    def _CfgDigEdgeStartTrig(self, handle: int, terminal: str, _edge: int) -> None:
        self._computer.set_trigger(self._computer.task(handle), terminal)

    def _write(
        self,
        handle: int,
        n: int,
        auto_start: int,
        _timeout: float,
        _layout: int,
        values: Any,
        out: Any,
        *_: object,
    ) -> None:
        task = self._computer.task(handle)
        out.value = self._computer.write(task, np.asarray(values), n, auto_start=bool(auto_start))

    _WriteDigitalU32 = _WriteAnalogF64 = _write

    def _TaskControl(self, handle: int, _action: int) -> None:
        self._computer.reserve(self._computer.task(handle))

    def _StartTask(self, handle: int) -> None:
        self._computer.start(self._computer.task(handle))

    def _StopTask(self, handle: int) -> None:
        self._computer.stop(self._computer.task(handle))

    def _IsTaskDone(self, handle: int, out: Any) -> None:
        out.value = self._computer.is_done(self._computer.task(handle))

    def _WaitUntilTaskDone(self, handle: int, timeout_s: float) -> None:
        try:
            self._computer.wait(self._computer.task(handle), timeout_s)
        except Refused:
            threading.Event().wait(min(timeout_s, RETRY_S))
            raise


def _put_text(out: Any, text: str, size: int) -> int:
    """Write a text to a buffer. Returns the size that it needs for a buffer of no size."""
    if not size:
        return len(text) + 1
    out.value = text.encode()
    return 0
