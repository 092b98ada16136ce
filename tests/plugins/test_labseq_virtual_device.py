"""The virtual instrument."""

from __future__ import annotations

import pytest
from labseq_virtual.devices import VirtualDevice
from labseq_virtual.settings import DeviceSettings

from labseq import Context, DeviceError


def test_a_device_remembers_what_it_was_told() -> None:
    shutter = VirtualDevice(
        DeviceSettings(commands=("open", "close"), values={"power": 1.5}), Context("shutter")
    )
    shutter.open()
    shutter.command("open", power=2.5)
    assert shutter.read("state") == "open"
    assert shutter.read("power") == 2.5
    shutter.safe_state()
    assert shutter.read("state") == "safe"
    with pytest.raises(DeviceError, match="unknown command 'opne'; expected one of 'open', 'close'"):
        shutter.command("opne")
    with pytest.raises(DeviceError, match="unknown value 'depth'; expected one of 'power', 'state'"):
        shutter.read("depth")


def test_a_stand_in_takes_every_command() -> None:
    device = VirtualDevice(DeviceSettings(), Context("laser"))
    with pytest.raises(DeviceError, match="laser: not open"):
        device.command("on")
    device.open()
    device.command("set", power=0.1)
    assert device.read("power") == 0.1
