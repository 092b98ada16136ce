"""Search for cameras, and access to an open one."""

from __future__ import annotations

import ctypes
import ipaddress
import threading
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from labseq_aravis.library import AravisError, Library, load_library, text
from labseq_aravis.stream import Stream, StreamOptions

INTERFACES: Final = ("GigEVision", "USB3Vision")
"""Interfaces that are searched. The library's others play back its own patterns, or are not GenICam."""

CHECK_RANGES: Final = 1
NO_PACKET_SOCKET: Final = 1
"""Numbers of the library's policies for ranges and for streams."""

KINDS: Final[dict[type, str]] = {bool: "boolean", int: "integer", float: "float", str: "string"}
"""The library's names of kinds of features, bool first, since each bool is an int, too."""

Value = TypeVar("Value", str, bool, int, float)
Number = TypeVar("Number", int, float)

_ControlLost = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that answered.

    Attributes:
        id: Name by which the library opens it.
        physical_id: Its name on the network or the bus, a MAC address or USB GUID.
        vendor: Manufacturer.
        model: Model.
        serial: Serial number.
        address: IP address, empty for a camera on USB.
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


def find_cameras() -> tuple[FoundCamera, ...]:
    """Search all networks and buses for cameras, which takes about a second."""
    lib = load_library()
    for index in range(lib.arv_get_n_interfaces()):
        name = lib.arv_get_interface_id(index)
        switch = lib.arv_enable_interface if text(name) in INTERFACES else lib.arv_disable_interface
        switch(name)
    lib.arv_update_device_list()
    return tuple(_found(lib, index) for index in range(lib.arv_get_n_devices()))


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


def camera_id(name: str | None) -> str:
    """The id by which the library opens a camera.

    Args:
        name: IP address, id or serial number of the camera, None for the only one.
    """
    if name is not None and _is_address(name):
        return name  # opened without a search, which also reaches cameras behind a router
    found = find_cameras()
    matches = [camera for camera in found if name in (None, camera.id, camera.physical_id, camera.serial)]
    if len(matches) == 1:
        return matches[0].address or matches[0].id  # ids need not be unique
    if not found:
        raise AravisError("no camera answered; check that it is switched on and reachable", "not found")
    listed = "; ".join(str(camera) for camera in found)
    if name is None:
        raise AravisError(f"there are {len(found)} cameras: {listed}; name one of them", "not found")
    how_many = "no camera" if not matches else "more than one camera"
    raise AravisError(f"{how_many} has the id or the serial number {name!r}; found: {listed}", "not found")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class Camera:
    """A camera that this process controls as long as it is open.

    Features have their GenICam names. Every method raises :class:`AravisError` if the camera has no such
    feature, refuses the value, or does not answer. Values out of a feature's range are refused.

    Args:
        name: IP address, id or serial number, None for the only camera there is.

    Attributes:
        is_ethernet: Whether it is a GigE camera.
    """

    def __init__(self, name: str | None = None) -> None:
        self._library = lib = load_library()
        id_ = camera_id(name)
        self._handle: int | None = lib.call("arv_camera_new", id_.encode())
        self._streams: list[Stream] = []
        self._lost = threading.Event()
        self._signal: tuple[int, int, Any] | None = None
        self.is_ethernet = bool(lib.arv_camera_is_gv_device(self._handle))
        device = lib.arv_camera_get_device(self._handle)
        if self.is_ethernet and not lib.arv_gv_device_is_controller(device):
            self.close()
            raise AravisError(f"the camera {id_} is controlled by another program", "not controller")
        lib.arv_camera_set_range_check_policy(self._handle, CHECK_RANGES)
        callback = _ControlLost(self._note_lost_control)
        signal = lib.g_signal_connect_data(device, b"control-lost", callback, None, None, 0)
        self._signal = (device, signal, callback)

    def close(self) -> None:
        """Close its streams and release the camera. Legal at any time, and repeatedly."""
        for stream in tuple(self._streams):
            stream.close()
        if self._signal is not None:
            device, signal, _callback = self._signal
            self._library.g_signal_handler_disconnect(device, signal)
            self._signal = None
        if self._handle is not None:
            self._library.g_object_unref(self._handle)
            self._handle = None

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _note_lost_control(self, _device: Any, _data: Any) -> None:
        self._lost.set()

    @property
    def is_lost(self) -> bool:
        """Whether the library has noticed that the camera no longer answers."""
        return self._lost.is_set()

    @property
    def vendor(self) -> str:
        """Manufacturer."""
        return text(self._call("arv_camera_get_vendor_name"))

    @property
    def model(self) -> str:
        """Model."""
        return text(self._call("arv_camera_get_model_name"))

    @property
    def serial(self) -> str:
        """Serial number."""
        return text(self._call("arv_camera_get_device_serial_number"))

    # features by name

    def is_available(self, feature: str) -> bool:
        """Whether the camera has a feature and offers it now."""
        return bool(self._call("arv_camera_is_feature_available", feature.encode()))

    def options(self, feature: str) -> tuple[str, ...]:
        """Values of an enumeration that can be chosen, none if the camera does not have it."""
        if not self.is_available(feature):
            return ()
        name = "arv_camera_dup_available_enumerations_as_strings"
        return self._library.texts(name, self._open_handle(), feature.encode())

    def get(self, feature: str, kind: type[Value]) -> Value:
        """Value of a feature, a text or an enumeration as str, a number as int or float."""
        value = self._call(f"arv_camera_get_{KINDS[kind]}", feature.encode())
        return kind(text(value) if kind is str else value)

    def set(self, feature: str, value: str | float) -> None:
        """Set a feature of the value's kind, which is bool, int, float or str."""
        kind = next(name for kind, name in KINDS.items() if isinstance(value, kind))
        encoded = value.encode() if isinstance(value, str) else value
        self._call(f"arv_camera_set_{kind}", feature.encode(), encoded)

    def bounds(self, feature: str, kind: type[Number]) -> tuple[Number, Number]:
        """Smallest and largest value of a number."""
        c_type = ctypes.c_int64 if kind is int else ctypes.c_double
        low, high = c_type(), c_type()
        places = ctypes.byref(low), ctypes.byref(high)
        self._call(f"arv_camera_get_{KINDS[kind]}_bounds", feature.encode(), *places)
        return kind(low.value), kind(high.value)

    def increment(self, feature: str) -> int:
        """Distance between two values of an integer."""
        return int(self._call("arv_camera_get_integer_increment", feature.encode()))

    def execute(self, feature: str) -> None:
        """Execute a command, and return when the camera has confirmed it."""
        self._call("arv_camera_execute_command", feature.encode())

    # network packets, whose features have other names in this library

    @property
    def packet_size(self) -> int:
        """Maximum size of a frame's packets, in bytes. GigE only."""
        return int(self._call("arv_camera_gv_get_packet_size"))

    def set_packet_size(self, n_bytes: int) -> None:
        """Set the maximum size of packets, headers included. GigE only.

        Without this, the library determines the largest size that is transmitted when a stream is made.
        """
        self._library.arv_camera_gv_set_packet_size_adjustment(self._open_handle(), 0)  # never
        self._call("arv_camera_gv_set_packet_size", n_bytes)

    @property
    def packet_delay_s(self) -> float:
        """Pause between packets, in seconds. GigE only."""
        return int(self._call("arv_camera_gv_get_packet_delay")) * 1e-9

    def set_packet_delay_s(self, delay_s: float) -> None:
        """Set the pause between packets, in seconds. GigE only."""
        self._call("arv_camera_gv_set_packet_delay", round(delay_s * 1e9))

    # acquisition

    def create_stream(self, n_buffers: int, options: StreamOptions | None = None) -> Stream:
        """Get ready to receive frames of the current region and pixel format.

        Args:
            n_buffers: How many frames can wait until they are read.
            options: How the stream handles losses, None for the defaults.
        """
        if self.is_ethernet:
            self._library.arv_camera_gv_set_stream_options(self._open_handle(), NO_PACKET_SOCKET)
        handle = self._call("arv_camera_create_stream", None, None)
        stream = Stream(self._library, handle, self.is_ethernet, self._streams)
        payload = self.payload
        stream.apply(options or StreamOptions(), payload)
        stream.allocate(n_buffers, payload)
        return stream

    @property
    def payload(self) -> int:
        """Size of a frame, in bytes."""
        return int(self._call("arv_camera_get_payload"))

    def start(self) -> None:
        """Start the acquisition. Frames come at the frame rate, or at each trigger."""
        self._call("arv_camera_start_acquisition")

    def stop(self) -> None:
        """End the acquisition."""
        self._call("arv_camera_stop_acquisition")

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._library.call(name, self._open_handle(), *arguments)

    def _open_handle(self) -> int:
        if self._handle is None:
            raise AravisError("the camera is closed; open it first", "closed")
        return self._handle
