"""Drivers of devices on other computers, whose methods are calls to the server of the device.

A driver lists the methods that the served device carries out, and the properties that are returned
with every answer. They have the same meaning as in the role.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, ClassVar

from labseq.plugin import (
    Camera,
    CameraFacts,
    Context,
    Device,
    Hardware,
    Lines,
    LinesFacts,
    MobileTweezers,
    StaticTweezers,
    TweezersFacts,
)
from labseq_remote.link import Link, called, called_if_able, known
from labseq_remote.settings import RemoteSettings

# pyright: reportIncompatibleMethodOverride=false
# (pyright does not know the properties that `known` makes)


def checked(name: str) -> Any:
    """A check by the driver at the server, if it has this check. The device need not be open."""

    def method(driver: RemoteHardware, /, *args: Any, **named: Any) -> None:
        if name in driver.link.about["abilities"]:
            driver.link.connect().call(name, *args, **named)

    method.__name__ = name
    return method


class RemoteHardware(Hardware):
    """Base of the drivers of all roles.

    The device's emergency script belongs to the watchdog of the server, which also makes the device safe when
    the connection is lost.

    Args:
        settings: Address and name of the device, and key of its server.
        context: The context, from which the server also constructs its driver.

    Attributes:
        link: The connection.
    """

    any_thread = True
    _kind: ClassVar[str]

    def __init__(self, settings: RemoteSettings, context: Context) -> None:
        self.link = Link(settings, context, self._kind)

    def open(self) -> None:
        """Connect, and open the device for this client alone.

        Raises:
            DeviceError: The server does not answer, or another client uses the device.
        """
        self.link.open()

    def close(self) -> None:
        """Close the device, and end the connection."""
        self.link.close()

    def safe_state(self) -> None:
        """Make the device safe, even while another call hangs.

        Raises:
            DeviceError: It failed, or the connection is lost, in which case the server makes the device safe.
        """
        self.link.make_safe()

    def describe(self) -> Mapping[str, Any]:
        """The device's description, with address, settings and version of the server."""
        return self.link.describe()

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the served device, and of labseq at its server, which should be the same as here."""
        about = self.link.about
        found: Mapping[str, Any] = self.link.call_if_able("versions", {})
        there = {f"labseq on {about['host']}": (str(about["labseq"]), version("labseq"))}
        return {**{str(name): (str(one[0]), str(one[1])) for name, one in found.items()}, **there}

    def warm(self) -> None:
        """Compile the kernels at the server."""
        self.link.connect().call("warm")

    idle_output = known("idle_output", "")
    settling_timeout_s = known("settling_timeout_s", 0.0)
    settle = called_if_able("settle")
    self_test = called_if_able("self_test")  # otherwise it only tests the connection
    poll = called_if_able("poll", {})
    check_interlocks = called_if_able("check_interlocks")


class RemoteCamera(RemoteHardware, Camera):
    """A camera on another computer, with the times of its frames on the session's clock."""

    _kind = "camera"
    facts = known("facts", CameraFacts())
    arm = called("arm")
    trigger = called("trigger")
    read = called("read")

    def disarm(self) -> None:
        """End the series."""
        if self.link.is_open:
            self.link.call("disarm")


class RemoteStaticTweezers(RemoteHardware, StaticTweezers):
    """Static tweezers on another computer."""

    _kind = "static_tweezers"
    facts = known("facts", TweezersFacts())
    load = called("load")
    load_weights = called("load_weights")
    start = called("start")
    ramp = called("ramp")
    release = called("release")
    leave_on = called_if_able("leave_on", default=False)


class RemoteMobileTweezers(RemoteHardware, MobileTweezers):
    """Mobile tweezers on another computer. Programs are sent as tones, and rendered there.

    The transfer time of the message that starts them adds to their delay.
    """

    _kind = "mobile_tweezers"
    waits_for_trigger = known("waits_for_trigger", default=False)
    start_delay_s = known("start_delay_s", 0.0)
    beginning_s = known("beginning_s", math.inf)
    check_program = checked("check_program")
    prepare = called("prepare")
    prepare_beginning = called("prepare_beginning")
    append = called("append")
    play = called("play")
    wait = called("wait")

    def timings(self) -> Mapping[str, float]:
        """Durations of the parts of the last ``prepare()`` at the server."""
        return self.link.known("timings", {})


class RemoteDevice(RemoteHardware, Device):
    """Any other instrument on another computer."""

    _kind = "device"
    command = called("command")
    read = called("read")
    check_command = checked("check_command")


class RemoteLines(RemoteHardware, Lines):
    """A timing box on another computer."""

    _kind = "lines"
    lines_facts = known("lines_facts", LinesFacts(()))
    check_program = checked("check_program")
    idle = called("idle")
    compile = called("compile")
    arm = called("arm")
    fire = called("fire")
    wait = called("wait")
