"""The library ``atmcd`` in Python: C function pointers that pylablib calls in place of Andor's."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from threading import RLock
from types import SimpleNamespace
from typing import Any, Final

from labseq_andor.codes import Code
from labseq_andor.heads import HEADS, IXON_897, Head
from labseq_andor.library import AndorLibrary, bind
from labseq_andor.settings import AndorSettings

from labseq.plugin import ConfigError, Context, LabseqError, SensorMode, wait_for
from labseq.plugin.camera import ExposureResult
from labseq.plugin.lines import trigger_line
from labseq_andor_sim.acquisition import Acquisition
from labseq_andor_sim.camera import Cooler, SimulatedCamera
from labseq_andor_sim.configuration import Amplifiers, Optics, Timing
from labseq_andor_sim.functions import names_in, write_text

VERSION: Final = "simulated"
FIRST_HANDLE: Final = 100
FUNCTIONS: Final = names_in(SimulatedCamera, Cooler, Amplifiers, Optics, Timing, Acquisition)
"""Names of the SDK functions that a camera implements."""


class SimulatedAndorLibrary(AndorLibrary):
    """The simulated library with one camera, whose sensor is the simulation's.

    Attributes:
        camera: The camera.
        others: Further cameras at the same computer.
    """

    def __init__(self, settings: AndorSettings, context: Context) -> None:
        super().__init__(settings, context)
        world = context.simulation
        if world is None:
            text = "the simulated camera needs a simulation; add `simulation: {use: virtual}`"
            raise ConfigError(f"{text} to the profile")
        shape = world.sensor_shape or IXON_897.sensor_shape
        self.head: Head = simulated_head(settings, shape)
        self.sensor_shape = shape
        self.folder = ""
        self.camera = SimulatedCamera(world, context.clock, self.head, shape, arm_s=settings.arming_time)
        self.others: list[SimulatedCamera] = []
        self._settings = settings
        self._world = world
        self._is_wired = trigger_line(context.lines, "camera") is not None
        self._sdk: SimulatedSdk | None = None

    def warm(self, em_gain: float) -> None:
        """Compute what all simulated frames have in common."""
        region = self._settings.mode.region
        is_whole = region == (0, 0, *self.sensor_shape)
        mode = SensorMode(None if is_whole else region, self._settings.binning, em_gain)
        self._world.prepare_sensor(mode)

    def connect(self, andor: Any) -> tuple[int, ...]:
        """Connect the cameras to the computer."""
        sdk = simulated_sdk(andor.atmcd32d_lib.define_functions)
        bind(self._name, andor, "simulated", sdk)
        sdk.attach(self.camera, *self.others)
        self._sdk = sdk
        if self._is_wired:
            self._world.wire("camera", self.camera.trigger)
        return sdk.indices(self.camera, *self.others)

    def disconnect(self) -> None:
        """Disconnect the cameras."""
        if self._sdk is not None:
            self._sdk.detach(self.camera, *self.others)
            self._sdk = None

    def wait(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until a frame is due, then in real time until pylablib sees it."""
        acquisition, start_s = self.camera.acquisition, self._clock.now()
        expected, due_s = acquisition.n_fetched, acquisition.next_cycle_s
        if due_s > start_s:
            self._clock.sleep(min(due_s - start_s, timeout_s))
        acquisition.proceed()
        frame = self.camera.sensor.take(max(0.0, timeout_s - (self._clock.now() - start_s)))
        if frame is None:
            return look(0.0)
        left_s = max(0.0, timeout_s - (self._clock.now() - start_s))
        taken = wait_for(look, left_s, self._clock)
        if taken is None:
            return None
        for _ in range(taken.number - expected):  # overwritten in the ring buffer, but not in the sensor
            frame = self.camera.sensor.take(0.0) or frame
        return replace(taken, t_start_s=frame.t_start_s)


def simulated_head(settings: AndorSettings, sensor_shape: tuple[int, int]) -> Head:
    """The head that the settings describe, with the simulation's sensor of (height, width) pixels."""
    head = settings.head
    if head is None:
        heads = sorted(HEADS, key=lambda head: head.sensor_shape != sensor_shape)
        rate_hz = settings.readout_rate
        suitable = [head for head in heads if rate_hz in (None, *head.rates_hz(settings.amplifier))]
        head = (suitable or heads)[0]
    return replace(head, model=settings.model.upper() or head.model, sensor_shape=sensor_shape)


class SimulatedSdk:
    """All simulated cameras of this process, behind the functions of Andor's library.

    pylablib uses an instance as the loaded library. Each simulated function is an attribute: a true C
    function pointer, so that arguments and buffers pass through ctypes as with Andor's library. Functions
    that are not simulated are missing, as in an older library.
    """

    def __init__(self, define_functions: Callable[[Any], None]) -> None:
        declared = _Declarations()
        define_functions(declared)
        self._lock = RLock()
        self._cameras: dict[int, SimulatedCamera] = {}
        self._next_handle = FIRST_HANDLE
        self._current: int | None = None
        self._error: LabseqError | None = None
        self._own: dict[str, Callable[..., int]] = {
            "GetVersionInfo": self._get_version,
            "GetAvailableCameras": self._count,
            "GetCameraHandle": self._handle_of,
            "GetCurrentCamera": self._get_current,
            "SetCurrentCamera": self._set_current,
            "Initialize": self._initialize,
            "ShutDown": self._shut_down,
        }
        for name in sorted(FUNCTIONS | set(self._own)):
            setattr(self, name, self._c_function(name, declared.functions[name].argtypes))

    def attach(self, *cameras: SimulatedCamera) -> None:
        """Connect cameras to this computer."""
        with self._lock:
            for camera in cameras:
                self._cameras[self._next_handle] = camera
                self._next_handle += 1

    def detach(self, *cameras: SimulatedCamera) -> None:
        """Disconnect cameras."""
        with self._lock:
            self._cameras = {h: camera for h, camera in self._cameras.items() if camera not in cameras}
            if self._current not in self._cameras:
                self._current = None

    def indices(self, *cameras: SimulatedCamera) -> tuple[int, ...]:
        """Places of cameras in the SDK's list."""
        return tuple(n for n, handle in enumerate(self._connected) if self._cameras[handle] in cameras)

    @property
    def _connected(self) -> list[int]:
        return [handle for handle, camera in self._cameras.items() if not camera.faults.not_connected]

    def _c_function(self, name: str, argument_types: list[Any]) -> Any:
        plain = [ctypes.c_void_p if kind is ctypes.c_char_p else kind for kind in argument_types]
        pointer: Any = ctypes.CFUNCTYPE(ctypes.c_uint, *plain)
        sdk = self

        class CFunction(pointer):
            """Raises, once C has returned, an error of the simulation, which cannot pass through C."""

            _flags_ = pointer._flags_
            _restype_ = pointer._restype_
            _argtypes_ = pointer._argtypes_

            def __call__(self, *arguments: Any) -> Any:
                try:
                    return super().__call__(*arguments)
                finally:
                    error, sdk._error = sdk._error, None
                    if error is not None:
                        raise error

        function: Any = CFunction(partial(self._call, name))
        function.__name__ = name
        return function

    def _call(self, name: str, *arguments: Any) -> int:
        try:
            with self._lock:
                if (own := self._own.get(name)) is not None:
                    return own(*arguments)
                by_handle = name.startswith("WaitForAcquisitionByHandle")
                camera = self._cameras.get(arguments[0] if by_handle else self._current or 0)
                if camera is None:
                    return Code.NOT_INITIALIZED
                function = camera.functions[name]
                code = camera.refusal(function)
                if code != Code.SUCCESS:
                    return code
                if not function.waits:
                    return function.call(arguments)
            return function.call(arguments)
        except LabseqError as error:
            self._error = error
            return Code.GENERAL_ERRORS

    def _count(self, number: Any) -> int:
        number[0] = len(self._connected)
        return Code.SUCCESS

    def _handle_of(self, index: int, handle: Any) -> int:
        if not 0 <= index < len(self._connected):
            return Code.P1INVALID
        handle[0] = self._connected[index]
        return Code.SUCCESS

    def _get_current(self, handle: Any) -> int:
        handle[0] = self._current or 0
        return Code.SUCCESS

    def _set_current(self, handle: int) -> int:
        if handle not in self._cameras:
            return Code.P1INVALID
        self._current = handle
        return Code.SUCCESS

    def _get_version(self, _kind: int, text: int, length: int) -> int:
        write_text(text, VERSION, length)
        return Code.SUCCESS

    def _initialize(self, _folder: int | None) -> int:
        camera = self._cameras.get(self._current or 0)
        return Code.ERROR_NOCAMERA if camera is None else camera.initialize()

    def _shut_down(self) -> int:
        """Release every camera."""
        codes = [camera.shut_down() for camera in self._cameras.values()]
        return Code.SUCCESS if Code.SUCCESS in codes else Code.NOT_INITIALIZED


class _Declarations:
    """Records how functions of a library are declared."""

    def __init__(self) -> None:
        self.functions: dict[str, SimpleNamespace] = {}

    def __getattr__(self, name: str) -> SimpleNamespace:
        return self.functions.setdefault(name, SimpleNamespace())


@lru_cache(maxsize=1)
def simulated_sdk(define_functions: Callable[[Any], None]) -> SimulatedSdk:
    """The only simulated SDK of this process: pylablib keeps the library that it was given."""
    return SimulatedSdk(define_functions)
