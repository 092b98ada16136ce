"""What cameras there are."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Final

from labseq_genicam.aravis.errors import AravisError
from labseq_genicam.aravis.library import Library, library, text

INTERFACES: Final = ("GigEVision", "USB3Vision")
"""Where cameras are looked for. The library's others play back its own patterns, or are no GenICam."""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that answered.

    Attributes:
        id: Name that it can be opened by.
        physical_id: The network's or the bus's name of it: a MAC address, a USB GUID.
        vendor: Its maker.
        model: Its model.
        serial: Its serial number.
        address: IP address, or "" for a camera on USB.
        protocol: "GigEVision" or "USB3Vision".
    """

    id: str
    physical_id: str
    vendor: str
    model: str
    serial: str
    address: str
    protocol: str

    def __str__(self) -> str:
        return f"{self.vendor} {self.model}, serial number {self.serial}, {self.address or self.protocol}"


def find_cameras(interfaces: tuple[str, ...] = INTERFACES) -> tuple[FoundCamera, ...]:
    """Ask all networks and buses for cameras; takes about a second.

    Args:
        interfaces: Where to look.

    Raises:
        LibraryMissingError: There is no library.
    """
    lib = library()
    for index in range(lib.arv_get_n_interfaces()):
        name = lib.arv_get_interface_id(index)
        switch = lib.arv_enable_interface if text(name) in interfaces else lib.arv_disable_interface
        switch(name)
    lib.arv_update_device_list()
    return tuple(_found(lib, index) for index in range(lib.arv_get_n_devices()))


def camera_id(name: str | None) -> str:
    """What the library opens a camera by.

    Args:
        name: IP address, id or serial number of the camera; None for the only one there is.

    Raises:
        AravisError: There is no such camera, or more than one; lists those that were found.
    """
    if name is not None and _is_address(name):
        return name  # asked directly, which also reaches cameras behind a router
    found = find_cameras()
    matches = [camera for camera in found if name in (None, camera.id, camera.physical_id, camera.serial)]
    if len(matches) == 1:
        return matches[0].address or matches[0].id  # ids need not be unique
    if not found:
        raise AravisError("no camera answered; expected one that is switched on and in reach", "not found")
    there = "; ".join(str(camera) for camera in found)
    if name is None:
        raise AravisError(f"there are {len(found)} cameras: {there}; name one of them", "not found")
    how_many = "no camera" if not matches else "more than one camera"
    raise AravisError(f"{how_many} has the id or the serial number {name!r}; found: {there}", "not found")


def _found(lib: Library, index: int) -> FoundCamera:
    protocol = text(lib.arv_get_device_protocol(index))
    return FoundCamera(
        id=text(lib.arv_get_device_id(index)),
        physical_id=text(lib.arv_get_device_physical_id(index)),
        vendor=text(lib.arv_get_device_vendor(index)),
        model=text(lib.arv_get_device_model(index)),
        serial=text(lib.arv_get_device_serial_nbr(index)),
        address=text(lib.arv_get_device_address(index)) if protocol == "GigEVision" else "",
        protocol=protocol,
    )


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
