"""Drivers of devices on other computers: each method is a call to the server of the device."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    WHOLE_SENSOR,
    Camera,
    CameraFacts,
    Context,
    Device,
    DeviceError,
    Frame,
    Hardware,
    LineProgram,
    Lines,
    LinesFacts,
    MobileTweezers,
    Occupancy,
    SensorMode,
    Signal,
    Simulation,
    StaticTweezers,
    ToneProgram,
    Trigger,
    TweezersFacts,
)
from labseq_remote.connection import Connection
from labseq_remote.settings import RemoteSettings, RemoteSimulationSettings


class _Link:
    """The connection of a driver: made when it is first needed, again after it was closed."""

    def __init__(self, settings: RemoteSettings, context: Context, kind: str) -> None:
        self.settings = settings
        self.name = context.name or kind
        self.is_open = False
        self._context = context
        self._kind = kind
        self._connection: Connection | None = None
        self._state: dict[str, Any] = {}
        self._about: dict[str, Any] = {}

    def connect(self) -> Connection:
        """The connection.

        Raises:
            DeviceError: The server does not answer, or refuses.
        """
        if self._connection is None:
            if isinstance(self._context.simulation, RemoteSimulation):  # its devices are constructed with it
                self._context.simulation.connect()
            self._connection = made = Connection(self.settings, self._context, self._kind)
            weakref.finalize(self, made.abandon)
            self._about = made.about
            made.state = self._state = {**self._state, **made.state}
        return self._connection

    def call(self, name: str, *args: Any, **named: Any) -> Any:
        """Call a method of the open device.

        Raises:
            DeviceError: It is not open, or the connection is lost.
        """
        if not self.is_open:
            raise DeviceError(self.name, f"it is not open (at {self.settings.address})")
        return self.connect().call(name, *args, **named)

    def call_if_able(self, name: str, default: Any = None) -> Any:
        """Call an optional method if the served driver has it."""
        return self.call(name) if name in self.about["abilities"] else default

    @property
    def about(self) -> dict[str, Any]:
        """What the server says about itself and its driver."""
        if not self._about:
            self.connect()
        return self._about

    def known(self, name: str, default: Any) -> Any:
        """The value of a property, as it was after the last call."""
        if not self._about:
            self.connect()
        return self._state.get(name, default)

    def open(self) -> None:
        """Connect, and open the device for this client alone."""
        if self._connection is not None and self._connection.lost:
            self.end()
        try:
            self.connect().call("open", stoppable=False)
        except BaseException:
            self.end()
            raise
        self.is_open = True

    def make_safe(self) -> None:
        """Make the device safe if it was opened."""
        if self.is_open:
            self.connect().make_safe()

    def close(self) -> None:
        """Close the device, and end the connection."""
        if not self.is_open:
            return self.end()
        self.is_open = False
        try:
            self.connect().call("close", stoppable=False)
        finally:
            self.end()

    def end(self) -> None:
        """End the connection."""
        connection, self._connection, self.is_open = self._connection, None, False
        if connection is not None:
            connection.close()

    def describe(self) -> dict[str, Any]:
        """What the device says of itself, and where it is."""
        about = self.about
        remote = {
            "address": self.settings.address,
            "device": self.settings.device,
            "host": about["host"],
            "labseq": about["labseq"],
            "settings": about["settings"],
        }
        return {**self.connect().call("describe"), "remote": remote}


class RemoteHardware(Hardware):
    """What the drivers of all roles have in common.

    The device's emergency script belongs to the watchdog of the server, which also makes the device safe when
    the connection is lost.

    Args:
        settings: Where the device is.
        context: What the driver at the server is constructed with, too.
    """

    any_thread = True
    _kind: ClassVar[str]

    def __init__(self, settings: RemoteSettings, context: Context) -> None:
        self._link = _Link(settings, context, self._kind)

    def open(self) -> None:
        """Connect, and open the device for this client alone.

        Raises:
            DeviceError: The server does not answer, or another client uses the device.
        """
        self._link.open()

    def close(self) -> None:
        """Close the device, and end the connection."""
        self._link.close()

    def safe_state(self) -> None:
        """Make the device safe, also while another call hangs.

        Raises:
            DeviceError: It failed, or the connection is lost: then the server does it by itself.
        """
        self._link.make_safe()

    def describe(self) -> Mapping[str, Any]:
        """What the device says of itself, with address, settings and version of the server."""
        return self._link.describe()

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the served device, and of labseq at its server; that should be the same as here."""
        from importlib.metadata import version

        about = self._link.about
        found: Mapping[str, Any] = self._link.call_if_able("versions", {})
        there = {f"labseq on {about['host']}": (str(about["labseq"]), version("labseq"))}
        return {**{str(name): (str(one[0]), str(one[1])) for name, one in found.items()}, **there}

    @property
    def idle_output(self) -> str:
        """That of the served device."""
        return str(self._link.known("idle_output", ""))

    def warm(self) -> None:
        """Compile the kernels at the server."""
        self._link.connect().call("warm")

    @property
    def settling_timeout_s(self) -> float:
        """That of the served device."""
        return float(self._link.known("settling_timeout_s", 0.0))

    def settle(self) -> None:
        """Wait until the served device is ready."""
        self._link.call_if_able("settle")

    def self_test(self) -> None:
        """Test the served device if it has a self test; else this tests the connection alone."""
        self._link.call_if_able("self_test")

    def poll(self) -> Mapping[str, bool | int | float | str]:
        """Values to record of the served device."""
        return self._link.call_if_able("poll", {})

    def check_interlocks(self) -> None:
        """Check those of the served device."""
        self._link.call_if_able("check_interlocks")


class RemoteCamera(RemoteHardware, Camera):
    """A camera on another computer; the times of its frames are on the clock of this one."""

    _kind = "camera"

    @property
    def facts(self) -> CameraFacts:
        """Those of the served camera."""
        return self._link.known("facts", CameraFacts())

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """See :class:`labseq.plugin.Camera`."""
        self._link.call("arm", n_frames, exposure_s, trigger)

    def disarm(self) -> None:
        """End the series."""
        if self._link.is_open:
            self._link.call("disarm")

    def trigger(self) -> None:
        """Start the next exposure."""
        self._link.call("trigger")

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame that has not been read yet."""
        return self._link.call("read", timeout_s)


class RemoteStaticTweezers(RemoteHardware, StaticTweezers):
    """Static tweezers on another computer."""

    _kind = "static_tweezers"

    @property
    def facts(self) -> TweezersFacts:
        """Those of the served tweezers."""
        return self._link.known("facts", TweezersFacts())

    def load(self, amplitudes: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> None:
        """Set the amplitudes of the tones."""
        self._link.call("load", amplitudes)

    def start(self) -> None:
        """Bring the array to its nominal depth."""
        self._link.call("start")

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth."""
        self._link.call("ramp", depth, duration_s)

    def release(self, duration_s: float) -> float:
        """Turn the light off for a time that the device there keeps."""
        return float(self._link.call("release", duration_s))

    def leave_on(self) -> bool:
        """Leave the light on if the settings there say so."""
        return bool(self._link.call_if_able("leave_on", default=False))


class RemoteMobileTweezers(RemoteHardware, MobileTweezers):
    """Mobile tweezers on another computer: programs travel as tones, and are rendered there."""

    _kind = "mobile_tweezers"

    @property
    def waits_for_trigger(self) -> bool:
        """Whether the served tweezers do."""
        return bool(self._link.known("waits_for_trigger", default=False))

    def check_program(self, program: ToneProgram) -> None:
        """Have the served driver check it."""
        if "check_program" in self._link.about["abilities"]:
            self._link.connect().call("check_program", program)

    def prepare(self, program: ToneProgram) -> float:
        """Have it rendered and uploaded there."""
        return float(self._link.call("prepare", program))

    def play(self) -> None:
        """Start playing."""
        self._link.call("play")

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program."""
        self._link.call("wait", timeout_s)

    @property
    def start_delay_s(self) -> float:
        """That of the served tweezers; the way of the message comes in addition."""
        return float(self._link.known("start_delay_s", 0.0))

    @property
    def beginning_s(self) -> float:
        """That of the served tweezers."""
        return float(self._link.known("beginning_s", math.inf))

    def prepare_beginning(self, program: ToneProgram) -> float:
        """Have the beginning of a program rendered and uploaded there."""
        return float(self._link.call("prepare_beginning", program))

    def append(self, program: ToneProgram) -> None:
        """Have the rest follow."""
        self._link.call("append", program)

    def timings(self) -> Mapping[str, float]:
        """Durations of the parts of the last ``prepare()`` there."""
        return self._link.known("timings", {})


class RemoteDevice(RemoteHardware, Device):
    """Any other instrument on another computer."""

    _kind = "device"

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a command."""
        self._link.call("command", name, **arguments)

    def read(self, name: str) -> Any:
        """Read a value."""
        return self._link.call("read", name)

    def check_command(self, name: str, **arguments: Any) -> None:
        """Have the served driver check it."""
        if "check_command" in self._link.about["abilities"]:
            self._link.connect().call("check_command", name, **arguments)


class RemoteLines(RemoteHardware, Lines):
    """A timing box on another computer."""

    _kind = "lines"

    @property
    def lines_facts(self) -> LinesFacts:
        """Those of the served box."""
        return self._link.known("lines_facts", LinesFacts(()))

    def check_program(self, program: LineProgram) -> None:
        """Have the served driver check it."""
        if "check_program" in self._link.about["abilities"]:
            self._link.connect().call("check_program", program)

    def idle(self) -> None:
        """Turn on the lines that are on between steps."""
        self._link.call("idle")

    def compile(self, program: LineProgram) -> None:
        """Compile a program."""
        self._link.call("compile", program)

    def arm(self) -> None:
        """Get ready to fire."""
        self._link.call("arm")

    def fire(self) -> None:
        """Start the program."""
        self._link.call("fire")

    def wait(self, timeout_s: float) -> None:
        """Wait for its end."""
        self._link.call("wait", timeout_s)


class RemoteSimulation(Simulation):
    """The simulation that simulated devices of a server act on; it keeps to the clock of this run.

    Args:
        settings: Where it is.
        context: What the simulation there is constructed with, too.
    """

    def __init__(self, settings: RemoteSimulationSettings, context: Context) -> None:
        self._link = _Link(settings, context, "simulation")

    def connect(self) -> None:
        """Construct it at the server."""
        self._link.connect()

    def open(self) -> None:
        """Draw the disorder of the machine."""
        self._link.open()

    def close(self) -> None:
        """Discard the state."""
        with suppress(DeviceError):  # the server does it by itself when the connection is lost
            self._link.close()

    def begin_shot(self) -> None:
        """Remove all atoms."""
        self._link.call("begin_shot")

    def load(self, t_start_s: float, duration_s: float) -> None:
        """The atom source is on."""
        self._link.call("load", t_start_s, duration_s)

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Receive the output of a device of this computer."""
        self._link.call("play", role, signal, t_start_s)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """The frame of a camera of this computer."""
        return self._link.call("expose", t_start_s, exposure_s, mode)

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model, and where it runs."""
        return self._link.describe()

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """That of the served simulation."""
        rows, columns = self._link.known("sensor_shape", (0, 0))
        return rows, columns

    def warnings(self) -> Sequence[str]:
        """Those of the served simulation."""
        return self._link.connect().call("warnings")

    def readout_fraction(self, mode: SensorMode) -> float:
        """That of the served simulation."""
        return self._link.connect().call("readout_fraction", mode)

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Compute there what frames share."""
        self._link.connect().call("prepare_sensor", mode)

    @property
    def loading_probability(self) -> float | None:
        """That of the served simulation."""
        return self._link.known("loading_probability", None)

    def truth(self) -> Occupancy | None:
        """The current true occupancy."""
        return self._link.call("truth")

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began."""
        return self._link.call("losses")

    def atom_events(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """Events of the shot."""
        return self._link.call("atom_events", since_s)
