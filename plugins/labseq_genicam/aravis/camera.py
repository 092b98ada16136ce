"""An open camera."""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from labseq_genicam.aravis.discovery import camera_id
from labseq_genicam.aravis.errors import AravisError
from labseq_genicam.aravis.features import Features
from labseq_genicam.aravis.library import library, text

if TYPE_CHECKING:
    from labseq_genicam.aravis.stream import Stream, StreamOptions

ControlLost = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)

CHECK_RANGES: Final = 1
CONTINUOUS: Final = 0


@dataclass(frozen=True, slots=True)
class Region:
    """A part of the sensor, in pixels as they are read out, after binning.

    Attributes:
        x: First column.
        y: First row.
        width: Number of columns.
        height: Number of rows.
    """

    x: int
    y: int
    width: int
    height: int


class Camera(Features):
    """A camera that is ours as long as it is open.

    Values that a feature does not allow are refused, by the camera's own description of it.

    Args:
        name: IP address, id or serial number; None for the only camera there is.

    Raises:
        LibraryMissingError: There is no library.
        AravisError: There is no such camera, it does not answer, or another program controls it.
    """

    def __init__(self, name: str | None = None) -> None:
        lib = library()
        id_ = camera_id(name)
        handle = lib.call("arv_camera_new", id_.encode())
        super().__init__(lib, handle)
        self._streams: list[Stream] = []
        self._lost = threading.Event()
        self._signal: tuple[int, int, Any] | None = None
        self.is_ethernet = bool(lib.arv_camera_is_gv_device(handle))
        device = lib.arv_camera_get_device(handle)
        if self.is_ethernet and not lib.arv_gv_device_is_controller(device):
            self.close()
            raise AravisError(f"the camera {id_} is controlled by another program", "not controller")
        lib.arv_camera_set_range_check_policy(handle, CHECK_RANGES)
        callback = ControlLost(self._note_loss)
        signal = lib.g_signal_connect_data(device, b"control-lost", callback, None, None, 0)
        self._signal = (device, signal, callback)

    def close(self) -> None:
        """Close its streams and let go of the camera; legal at any time, and again."""
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

    @property
    def is_lost(self) -> bool:
        """Whether the camera has stopped answering, so that control over it is lost."""
        return self._lost.is_set()

    def wait_lost(self, timeout_s: float) -> bool:
        """Wait until the camera is lost.

        Returns:
            Whether it is.
        """
        return self._lost.wait(timeout_s)

    @property
    def vendor(self) -> str:
        """Its maker."""
        return text(self._call("arv_camera_get_vendor_name"))

    @property
    def model(self) -> str:
        """Its model."""
        return text(self._call("arv_camera_get_model_name"))

    @property
    def serial(self) -> str:
        """Its serial number."""
        return text(self._call("arv_camera_get_device_serial_number"))

    @property
    def firmware(self) -> str:
        """Version of its firmware, or "" if it does not tell."""
        for feature in ("DeviceFirmwareVersion", "DeviceVersion"):
            if self.is_available(feature):
                return self.get_string(feature)
        return ""

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """Height and width of the sensor, in pixels."""
        width, height = self._pair(ctypes.c_int, "arv_camera_get_sensor_size")
        return height, width

    @property
    def region(self) -> Region:
        """The part of the sensor that is read out."""
        values = [ctypes.c_int() for _ in range(4)]
        self._call("arv_camera_get_region", *(ctypes.byref(value) for value in values))
        return Region(*(value.value for value in values))

    def set_region(self, region: Region) -> None:
        """Choose the part of the sensor that is read out; set the binning before.

        Raises:
            AravisError: It does not lie on the sensor, or not on the camera's raster.
        """
        if min(region.x, region.y) < 0 or min(region.width, region.height) < 1:  # the library passes over it
            raise AravisError(f"{region} does not lie on the sensor", "out of range")
        self._call("arv_camera_set_region", region.x, region.y, region.width, region.height)

    @property
    def binning(self) -> tuple[int, int]:
        """Pixels that are added up, vertically and horizontally; (1, 1) if the camera cannot bin."""
        if not self._call("arv_camera_is_binning_available"):
            return 1, 1
        horizontal, vertical = self._pair(ctypes.c_int, "arv_camera_get_binning")
        return vertical, horizontal

    def set_binning(self, vertical: int, horizontal: int) -> None:
        """Choose how many pixels are added up."""
        if (vertical, horizontal) != self.binning:
            self._call("arv_camera_set_binning", horizontal, vertical)

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Pixel formats that the camera offers."""
        return self._library.texts("arv_camera_dup_available_pixel_formats_as_strings", self._open_handle())

    @property
    def pixel_format(self) -> str:
        """Pixel format of its frames."""
        return text(self._call("arv_camera_get_pixel_format_as_string"))

    def set_pixel_format(self, name: str) -> None:
        """Choose the pixel format, by name."""
        self._call("arv_camera_set_pixel_format_from_string", name.encode())

    @property
    def exposure_s(self) -> float:
        """Exposure time, in seconds."""
        return float(self._call("arv_camera_get_exposure_time")) * 1e-6

    def set_exposure_s(self, exposure_s: float) -> None:
        """Set the exposure time, in seconds."""
        self._call("arv_camera_set_exposure_time", exposure_s * 1e6)

    @property
    def exposure_bounds_s(self) -> tuple[float, float]:
        """Shortest and longest exposure, in seconds."""
        shortest, longest = self._pair(ctypes.c_double, "arv_camera_get_exposure_time_bounds")
        return shortest * 1e-6, longest * 1e-6

    @property
    def has_gain(self) -> bool:
        """Whether the gain can be set."""
        return bool(self._call("arv_camera_is_gain_available"))

    @property
    def gain(self) -> float:
        """Gain, in the camera's unit (dB, or raw)."""
        return float(self._call("arv_camera_get_gain"))

    def set_gain(self, gain: float) -> None:
        """Set the gain, in the camera's unit."""
        self._call("arv_camera_set_gain", gain)

    @property
    def gain_bounds(self) -> tuple[float, float]:
        """Least and greatest gain, in the camera's unit."""
        return self._pair(ctypes.c_double, "arv_camera_get_gain_bounds")

    @property
    def frame_rate_hz(self) -> float:
        """Frames per second when it runs freely."""
        return float(self._call("arv_camera_get_frame_rate"))

    def set_frame_rate_hz(self, frame_rate_hz: float) -> None:
        """Let the camera run freely, at so many frames per second."""
        self._call("arv_camera_set_frame_rate", frame_rate_hz)

    @property
    def trigger_sources(self) -> tuple[str, ...]:
        """What can trigger a frame: "Software", "Line1", ..."""
        return self._library.texts("arv_camera_dup_available_trigger_sources", self._open_handle())

    def set_trigger(self, source: str | None) -> None:
        """Choose what starts a frame.

        Args:
            source: One of :attr:`trigger_sources`, on its rising edge; None to run freely.
        """
        if source is None:
            self._call("arv_camera_clear_triggers")
        else:
            self._call("arv_camera_set_trigger", source.encode())

    def trigger(self) -> None:
        """Trigger a frame by software; returns when the camera has confirmed it."""
        self._call("arv_camera_software_trigger")

    @property
    def payload(self) -> int:
        """Size of a frame, in bytes."""
        return int(self._call("arv_camera_get_payload"))

    @property
    def packet_size(self) -> int:
        """Greatest size of the packets that frames come in, in bytes; GigE only."""
        return int(self._call("arv_camera_gv_get_packet_size"))

    def set_packet_size(self, n_bytes: int) -> None:
        """Set the greatest size of packets, headers included; GigE only.

        Without it, the library looks for the largest that comes through when a stream is made.
        """
        self._library.arv_camera_gv_set_packet_size_adjustment(self._open_handle(), 0)  # never
        self._call("arv_camera_gv_set_packet_size", n_bytes)

    @property
    def packet_delay_s(self) -> float:
        """Pause between packets, in seconds; GigE only."""
        return int(self._call("arv_camera_gv_get_packet_delay")) * 1e-9

    def set_packet_delay_s(self, delay_s: float) -> None:
        """Set the pause between packets, in seconds; GigE only."""
        self._call("arv_camera_gv_set_packet_delay", round(delay_s * 1e9))

    def create_stream(self, n_buffers: int, options: StreamOptions | None = None) -> Stream:
        """Get ready to receive frames of the present region and pixel format.

        Args:
            n_buffers: How many frames can wait until they are read.
            options: How the stream deals with losses; None for the library's ways.
        """
        from labseq_genicam.aravis.stream import Stream, StreamOptions

        options = options or StreamOptions()
        if self.is_ethernet:
            flags = 0 if options.packet_socket else 1
            self._library.arv_camera_gv_set_stream_options(self._open_handle(), flags)
        handle = self._call("arv_camera_create_stream", None, None)
        stream = Stream(self._library, handle, self.is_ethernet, self._streams)
        payload = self.payload
        stream.apply(options, payload)
        stream.allocate(n_buffers, payload)
        return stream

    def start(self) -> None:
        """Start the acquisition: frames come freely, or at each trigger."""
        self._call("arv_camera_set_acquisition_mode", CONTINUOUS)
        self._call("arv_camera_start_acquisition")

    def stop(self) -> None:
        """End the acquisition."""
        self._call("arv_camera_stop_acquisition")

    def _note_loss(self, _device: int | None, _data: int | None) -> None:
        self._lost.set()
