"""The process of Aravis' simulated camera, with pixels that its parent makes."""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from labseq_aravis.camera import Camera
from labseq_aravis.library import AravisError, load_library

from labseq_genicam_sim.description import MODEL, REGISTERS, TEXTS, VENDOR, description
from labseq_genicam_sim.messages import Channel, Exposure, Image, NotStarted, Ready, Setup
from labseq_genicam_sim.network import FIRST_ADDRESS, has_port, move, own_addresses

TRIGGER_POLLS_HZ: Final = 250.0
"""How often it polls for a software trigger. A higher rate would use all of a core, since it waits whole
milliseconds."""

HALF: Final = 0.5
"""Fraction of the packets that a failed frame loses."""

CURRENT_ADDRESS: Final = 0x24
STREAM_PORT: Final = 0xD00
STREAM_ADDRESS: Final = 0xD18
"""Bootstrap registers of GigE Vision for its own address and the destination of frames."""

START_TIMEOUT_S: Final = 20.0
"""How long it waits for the address at which each simulated camera starts. Each has it for some milliseconds,
but a busy computer may start many."""

FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class SimulatedCamera:
    """A GigE Vision camera on loopback, as long as this process lives.

    Args:
        expose: Makes a frame's bytes, in its pixel format. None fails the frame. Called by the camera's own
            thread, which answers nothing meanwhile.
    """

    def __init__(self, setup: Setup, expose: Callable[[Exposure], bytes | None]) -> None:
        self._library = load_library()
        self._expose = expose
        self.faults = setup.faults
        self._n = 0
        self._camera = _start_camera(setup)
        self._registers = self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        addresses = (*filter(None, [setup.address]), *own_addresses())
        self._cable = next(filter(None, map(move, addresses)), None)
        self.address = FIRST_ADDRESS if self._cable is None else self._cable.address
        self._write(CURRENT_ADDRESS, bytes(int(part) for part in self.address.split(".")))
        texts = {
            "DeviceVendorName": VENDOR,
            "DeviceModelName": MODEL,
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
            "ReverseX": 1,  # as another program may have left it
        }
        for name, value in sizes.items():
            self._library.arv_fake_camera_write_register(self._registers, REGISTERS[name], value)
        self._library.arv_fake_camera_set_trigger_frequency(self._registers, TRIGGER_POLLS_HZ)
        self._fill_pattern = FillPattern(self._fill)  # a reference, or it would be garbage-collected
        self._library.arv_fake_camera_set_fill_pattern(self._registers, self._fill_pattern, None)

    def _fill(self, buffer: int, _data: Any, exposure_us: int, gain: int, pixel_format: int) -> None:
        """Fill a frame. The library calls this when it begins the frame."""
        n, self._n = self._n, self._n + 1
        names = ("OffsetX", "OffsetY", "Width", "Height", "BinningHorizontal", "BinningVertical")
        names += ("ReverseX", "ReverseY")
        values = (self._register(REGISTERS[name]) for name in names)
        payload = self._library.arv_fake_camera_get_payload(self._registers)
        if self._cable is not None:
            host = self._register(STREAM_ADDRESS).to_bytes(4, "big")
            self._cable.aim(socket.inet_ntoa(host), self._register(STREAM_PORT) & 0xFFFF, payload)
        image = self._expose(Exposure(n, exposure_us, gain, pixel_format, *values)) or b""
        faults = self.faults
        if faults.unplugged_at is not None and n >= faults.unplugged_at:
            os._exit(0)
        if faults.late_by:
            time.sleep(faults.late_by)
        size = ctypes.c_size_t()
        address = self._library.arv_buffer_get_data(buffer, ctypes.byref(size))
        is_whole = len(image) == payload
        if is_whole:
            ctypes.memmove(address, image, payload)
        self._lose(faults.packet_loss if is_whole and n not in faults.failed_frames else HALF, n)

    def _lose(self, fraction: float, n: int) -> None:
        """Lose this fraction of the next frame's packets, the same ones each time."""
        self._library.g_random_set_seed(n)
        self._library.set_property(self._camera, "gvsp-lost-ratio", float(fraction))

    def _register(self, address: int) -> int:
        value = ctypes.c_uint32()
        self._library.arv_fake_camera_read_register(self._registers, address, ctypes.byref(value))
        return value.value

    def _write(self, address: int, data: bytes) -> None:
        self._library.arv_fake_camera_write_memory(self._registers, address, len(data), data)


def _start_camera(setup: Setup) -> int:
    """Start the camera. Waits while another one is being started on this machine."""
    lib = load_library()
    xml = description(ignores_triggers=setup.faults.ignores_triggers)
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
                text = (
                    f"another program has port 3956 of {FIRST_ADDRESS}, needed by simulated cameras; end it"
                )
                raise AravisError(text, "busy")
            time.sleep(0.01)
    finally:
        with contextlib.suppress(OSError):  # Windows does not delete a file in use
            Path(name).unlink()


class Process:
    """The camera, and its communication with the parent."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._images: queue.SimpleQueue[Image] = queue.SimpleQueue()

    def run(self) -> None:
        """Run the camera until the parent is gone."""
        setup = self._channel.receive()
        if setup is None:
            return
        try:
            self._camera = SimulatedCamera(setup, self._expose)
            if setup.faults.busy:  # control of the camera, as another application would have it
                self._other = Camera(self._camera.address)
        except AravisError as error:
            self._channel.send(NotStarted(str(error)))
            return
        self._channel.send(Ready(self._camera.address))
        while (image := self._channel.receive()) is not None:
            self._images.put(image)

    def _expose(self, exposure: Exposure) -> bytes | None:
        try:
            self._channel.send(exposure)
        except OSError:
            os._exit(0)
        return self._images.get().pixels


def main() -> None:
    """Run until the parent is gone, then end at once, whatever the camera is doing."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when it ends
    output = os.dup(1)
    os.dup2(2, 1)  # what libraries print must not mix with the messages
    Process(Channel(os.fdopen(0, "rb"), os.fdopen(output, "wb"))).run()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
