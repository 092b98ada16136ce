"""The simulated library, and the camera behind it as the driver uses it."""

# ruff: noqa: D102, N802 - the SDK's names, which its manual explains

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import Any, Final

from labseq_andor.codes import Code
from labseq_andor.connection import AndorConnection
from labseq_andor.heads import HEADS, IXON_897, Head
from labseq_andor.sdk import SIGNATURES, AndorSdk
from labseq_andor.settings import AndorSettings

from labseq.plugin import ConfigError, Context, SensorMode
from labseq.plugin.camera import ExposureResult
from labseq.plugin.lines import trigger_line
from labseq_andor_sim.camera import SimulatedCamera
from labseq_andor_sim.settings import Refused, pick, require

FIRST_HANDLE: Final = 100
WITHOUT_LOCK: Final = ("GetImages16", "WaitForAcquisitionByHandleTimeOut")
"""Functions that may wait, so other calls must be possible meanwhile."""


class SimulatedConnection(AndorConnection):
    """A simulated library with one camera, whose sensor is the simulation's.

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
        self.camera = SimulatedCamera(world, context.clock, self.head, shape, arm_s=settings.arming_time)
        self.others: list[SimulatedCamera] = []
        self._world = world
        if trigger_line(context.lines, "camera") is not None:
            world.wire("camera", self.camera.trigger)

    def warm(self, em_gain: float) -> None:
        """Compute the common part of all simulated frames."""
        region = self.settings.mode.region
        is_whole = region == (0, 0, *self.camera.optics.sensor_shape)
        mode = SensorMode(None if is_whole else region, self.settings.binning, em_gain)
        self._world.prepare_sensor(mode)

    def load(self) -> AndorSdk:
        """A library with the simulated cameras."""
        return AndorSdk(SimulatedLibrary([self.camera, *self.others]))

    def wait(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait on the session's clock until a frame is due, then in real time until the driver sees it."""
        return self.camera.acquisition.take(look, timeout_s)


def simulated_head(settings: AndorSettings, sensor_shape: tuple[int, int]) -> Head:
    """The head that the settings describe, with the simulation's sensor of (height, width) pixels."""
    head = settings.head
    if head is None:
        heads = sorted(HEADS, key=lambda head: head.sensor_shape != sensor_shape)
        rate_hz = settings.readout_rate
        suitable = [head for head in heads if rate_hz in (None, *head.rates_hz(settings.amplifier))]
        head = (suitable or heads)[0]
    return replace(head, model=settings.model.upper() or head.model, sensor_shape=sensor_shape)


class Computer:
    """The cameras that are connected to a computer, and the selected one."""

    def __init__(self, cameras: Sequence[SimulatedCamera]) -> None:
        self.cameras = cameras
        self._handle = 0

    def camera(self, handle: int | None = None) -> SimulatedCamera:
        """The camera with a handle, None for the selected one."""
        return pick(self.cameras, (handle or self._handle) - FIRST_HANDLE, Code.NOT_INITIALIZED)

    @property
    def _connected(self) -> list[SimulatedCamera]:
        return [camera for camera in self.cameras if not camera.faults.not_connected]

    def GetVersionInfo(self, _kind: int) -> str:
        return "simulated"

    def GetAvailableCameras(self) -> int:
        return len(self._connected)

    def GetCameraHandle(self, index: int) -> int:
        """Handle of a camera, by its place in the list."""
        return FIRST_HANDLE + self.cameras.index(pick(self._connected, index))

    def GetCurrentCamera(self) -> int:
        """Handle of the camera that is selected."""
        return self._handle

    def SetCurrentCamera(self, handle: int) -> None:
        self.camera(handle)
        self._handle = handle

    def Initialize(self, _folder: object) -> None:
        self.camera().initialize()

    def ShutDown(self) -> None:
        """Release every camera."""
        for camera in self.cameras:
            camera.shut_down()


class SimulatedLibrary:
    """Simulated cameras behind the functions of Andor's library, which :class:`AndorSdk` calls.

    Functions that are not simulated are missing, as in an older library.
    """

    def __init__(self, cameras: Sequence[SimulatedCamera]) -> None:
        self._lock = RLock()
        self._computer = Computer(cameras)

    def __getattr__(self, name: str) -> Any:
        if hasattr(Computer, name) or name in self._computer.cameras[0].functions:
            return partial(self._call, name)
        raise AttributeError(name)

    def _call(self, name: str, *arguments: Any) -> int:
        """Call a function as C does. Returns its code, and writes its results through the pointers."""
        inputs, outputs = SIGNATURES[name].split(" ")
        passed, places = arguments[: len(inputs)], arguments[len(inputs) :]
        try:
            if hasattr(Computer, name):
                with self._lock:
                    code, result = Code.SUCCESS, getattr(self._computer, name)(*passed)
            else:
                code, result = self._call_camera(name, passed)
            results = result if isinstance(result, tuple) else (result,)
            for letter, place, value in zip(outputs, places, results, strict=False):  # a length may follow
                _write(letter, place, value)
        except Refused as refused:
            return refused.code
        return code

    def _call_camera(self, name: str, passed: Sequence[Any]) -> tuple[Code, Any]:
        by_handle = name.startswith("WaitForAcquisitionByHandle")
        with self._lock:
            camera = self._computer.camera(passed[0] if by_handle else None)
            camera.check(name)
            if name not in WITHOUT_LOCK:
                result = camera.functions[name](*passed)
                code = camera.cooler.status if name == "GetTemperatureF" else Code.SUCCESS
                return code, result
        return Code.SUCCESS, camera.functions[name](*passed)


def _write(letter: str, place: Any, value: Any) -> None:
    if letter in "sn":
        place.value = value.encode()
    elif letter == "c":
        require(place.contents.ulSize == 52)  # 13 numbers of 32 bits, on every system
        place[0] = value
    else:
        place.contents.value = value
