"""The simulated camera itself: Aravis' own, with its pixels from elsewhere. In a process of its own."""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from labseq_genicam.aravis.errors import AravisError
from labseq_genicam.aravis.library import G_TYPE_DOUBLE, library
from labseq_genicam.counterpart.description import REGISTERS, TEXTS, description
from labseq_genicam.counterpart.faults import Setup
from labseq_genicam.counterpart.messages import Exposure
from labseq_genicam.counterpart.sockets import FIRST_ADDRESS, has_port, move, own_addresses

TRIGGER_POLLS_HZ: Final = 250.0
"""How often it looks for a software trigger. Faster makes it spin: it polls in whole milliseconds."""

HALF: Final = 0.5
"""Fraction of the packets that a failed frame loses: all of a frame's do not come by chance."""

CURRENT_ADDRESS: Final = 0x24
STREAM_PORT: Final = 0xD00
STREAM_ADDRESS: Final = 0xD18
"""Bootstrap registers of GigE Vision: its own address, and where frames go to."""

START_TIMEOUT_S: Final = 5.0
"""How long it waits for the address that each simulated camera begins at."""

FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class SimulatedCamera:
    """A GigE Vision camera on loopback, as long as this process lives.

    Args:
        setup: What it is.
        expose: Makes a frame's bytes, in its pixel format; None fails it. Called by the camera's
            own thread, which answers nothing meanwhile.

    Raises:
        AravisError: It cannot run.
    """

    def __init__(self, setup: Setup, expose: Callable[[Exposure], bytes | bytearray | None]) -> None:
        self._library = library()
        self._expose = expose
        self.faults = setup.faults
        self._n = 0
        self._camera = _started(setup)
        self._registers = self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        addresses = (*filter(None, [setup.address]), *own_addresses())
        self._cable = next(filter(None, map(move, addresses)), None)
        self.address = FIRST_ADDRESS if self._cable is None else self._cable.address
        self._write(CURRENT_ADDRESS, bytes(int(part) for part in self.address.split(".")))
        texts = {
            "DeviceVendorName": setup.faults.vendor,
            "DeviceModelName": setup.faults.model,
            "DeviceManufacturerInfo": "simulated",
            "DeviceSerialNumber": setup.serial,
        }
        for name, value in texts.items():
            address, size = TEXTS[name]
            self._write(address, value.encode()[: size - 1].ljust(size, b"\0"))
        height, width = setup.sensor_shape
        sizes = {
            "SensorWidth": width,
            "SensorHeight": height,
            "Width": min(width, 512),
            "Height": min(height, 512),
        }
        for name, value in sizes.items():
            self._library.arv_fake_camera_write_register(self._registers, REGISTERS[name], value)
        self._library.arv_fake_camera_set_trigger_frequency(self._registers, TRIGGER_POLLS_HZ)
        self._fill_pattern = FillPattern(self._fill)  # kept, or it would be collected
        self._library.arv_fake_camera_set_fill_pattern(self._registers, self._fill_pattern, None)

    def _fill(self, buffer: int, _data: Any, exposure_us: int, gain: int, pixel_format: int) -> None:
        """Fill a frame; the library calls this when it begins one."""
        n, self._n = self._n, self._n + 1
        names = ("OffsetX", "OffsetY", "Width", "Height", "BinningHorizontal", "BinningVertical")
        values = (self._register(REGISTERS[name]) for name in names)
        if self._cable is not None:
            host = self._register(STREAM_ADDRESS).to_bytes(4, "big")
            self._cable.aim(socket.inet_ntoa(host), self._register(STREAM_PORT) & 0xFFFF)
        image = self._expose(Exposure(n, exposure_us, gain, pixel_format, *values))
        faults = self.faults
        if faults.unplugged_at is not None and n >= faults.unplugged_at:
            os._exit(0)
        if faults.late_s:
            time.sleep(faults.late_s)
        size = ctypes.c_size_t()
        address = self._library.arv_buffer_get_data(buffer, ctypes.byref(size))
        room = self._library.arv_fake_camera_get_payload(self._registers)
        is_whole = image is not None and len(image) == room
        if is_whole:
            ctypes.memmove(address, (ctypes.c_char * room).from_buffer(image), room)
        self._lose(faults.packet_loss if is_whole and n not in faults.failed_frames else HALF, n)

    def _lose(self, fraction: float, n: int) -> None:
        """Lose this fraction of the next frame's packets, the same ones each time."""
        self._library.g_random_set_seed(n)
        self._library.set_property(self._camera, "gvsp-lost-ratio", fraction, G_TYPE_DOUBLE)

    def _register(self, address: int) -> int:
        value = ctypes.c_uint32()
        self._library.arv_fake_camera_read_register(self._registers, address, ctypes.byref(value))
        return value.value

    def _write(self, address: int, data: bytes) -> None:
        self._library.arv_fake_camera_write_memory(self._registers, address, len(data), data)


def _started(setup: Setup) -> int:
    """Make the camera; waits while another one is being made on this machine."""
    lib = library()
    faults = setup.faults
    xml = description(faults.vendor, faults.model, ignores_triggers=faults.ignores_triggers)
    file, name = tempfile.mkstemp(suffix=".xml")
    try:
        with os.fdopen(file, "w", encoding="utf-8") as stream:
            stream.write(xml)
        end_s = time.monotonic() + START_TIMEOUT_S
        while True:
            camera = lib.arv_gv_fake_camera_new_full(
                FIRST_ADDRESS.encode(), setup.serial.encode(), name.encode()
            )
            if lib.arv_gv_fake_camera_is_running(camera) and has_port():
                return camera
            lib.g_object_unref(camera)
            if time.monotonic() > end_s:
                text = f"another program has port 3956 of {FIRST_ADDRESS}, as simulated cameras have; end it"
                raise AravisError(text, "busy")
            time.sleep(0.01)
    finally:
        with contextlib.suppress(OSError):  # Windows keeps what is in use
            Path(name).unlink()
