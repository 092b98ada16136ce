"""Drivers of devices on other computers: each method is a call to the server of the device."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    Camera,
    CameraFacts,
    Context,
    Device,
    Frame,
    Hardware,
    LineProgram,
    Lines,
    LinesFacts,
    MobileTweezers,
    StaticTweezers,
    ToneProgram,
    Trigger,
    TweezersFacts,
)
from labseq_remote.link import Link
from labseq_remote.settings import RemoteSettings
from labseq_remote.simulation import RemoteSimulation


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
        simulation = context.simulation
        first = simulation.connect if isinstance(simulation, RemoteSimulation) else None
        self._link = Link(settings, context, self._kind, first)

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
