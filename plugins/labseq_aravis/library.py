"""The C library libaravis, loaded on first use, with the types and errors of its functions."""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
import threading
from collections.abc import Callable
from typing import Any, Final

INSTALL: Final = (
    "install it (Debian and Ubuntu `apt-get install libaravis-0.8-0`, Fedora `dnf install aravis`, "
    "macOS `brew install aravis`, Windows the package mingw-w64-ucrt-x86_64-aravis of MSYS2 with its "
    "folder `ucrt64\\bin` on PATH)"
)
"""How to get libaravis on each system."""


class AravisError(Exception):
    """The library or a camera refused something.

    Attributes:
        code: Kind of error ("timeout", "not found", "not controller", ... of :data:`ERRORS`), else the
            library's domain and number, empty if the error is not the library's.
    """

    def __init__(self, message: str, code: str = "") -> None:
        self.code = code
        super().__init__(message)


class LibraryMissingError(AravisError):
    """The library is not installed. The text says how to install it."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the library libaravis 0.8 cannot be loaded ({reason}); {INSTALL}", "missing")


class PixelFormatError(AravisError):
    """A frame has a pixel format that is not supported."""

    def __init__(self, pixel_format: int) -> None:
        text = f"frames have the pixel format 0x{pixel_format:08X}; expected Mono8, Mono10, Mono12, Mono14"
        super().__init__(f"{text} or Mono16, unpacked; set PixelFormat", "pixel format")


ERRORS: Final[dict[str, dict[int, str]]] = {
    "arv_device_error_quark": {
        1: "feature not found",
        2: "not connected",
        5: "timeout",
        6: "not found",
        10: "not controller",
        17: "access denied",
        18: "busy",
    },
    "arv_gc_error_quark": {4: "out of range", 7: "feature not found"},
}
"""Names of the errors that callers tell apart, by the function for their domain, and their code in it.

The codes come from the enumerations ``ArvDeviceError`` and ``ArvGcError``.
"""

TYPES: Final[dict[str, Any]] = {
    "v": None,
    "p": ctypes.c_void_p,
    "s": ctypes.c_char_p,
    "b": ctypes.c_int,
    "i": ctypes.c_int,
    "u": ctypes.c_uint,
    "h": ctypes.c_uint16,
    "l": ctypes.c_int64,
    "L": ctypes.c_uint64,
    "d": ctypes.c_double,
    "z": ctypes.c_size_t,
    "g": ctypes.c_ulong,
    "e": ctypes.c_void_p,
}
"""Types of the letters in :data:`SIGNATURES`."""

SIGNATURES: Final[dict[str, str]] = {
    # GLib and GObject
    "g_clear_error": "v p",
    "g_free": "v p",
    "g_object_set_property": "v psp",
    "g_object_unref": "v p",
    "g_quark_to_string": "s u",
    "g_random_set_seed": "v u",
    "g_signal_connect_data": "g pspppi",
    "g_signal_handler_disconnect": "v pg",
    "g_value_init": "p pz",
    "g_value_set_double": "v pd",
    "g_value_set_int": "v pi",
    # discovery
    "arv_device_error_quark": "u ",
    "arv_gc_error_quark": "u ",
    "arv_disable_interface": "v s",
    "arv_enable_interface": "v s",
    "arv_get_device_address": "s u",
    "arv_get_device_id": "s u",
    "arv_get_device_model": "s u",
    "arv_get_device_physical_id": "s u",
    "arv_get_device_protocol": "s u",
    "arv_get_device_serial_nbr": "s u",
    "arv_get_device_vendor": "s u",
    "arv_get_interface_id": "s u",
    "arv_get_major_version": "u ",
    "arv_get_micro_version": "u ",
    "arv_get_minor_version": "u ",
    "arv_get_n_devices": "u ",
    "arv_get_n_interfaces": "u ",
    "arv_update_device_list": "v ",
    # a camera
    "arv_camera_create_stream": "p pppe",
    "arv_camera_dup_available_enumerations_as_strings": "p pspe",
    "arv_camera_execute_command": "v pse",
    "arv_camera_get_boolean": "b pse",
    "arv_camera_get_device": "p p",
    "arv_camera_get_device_serial_number": "s pe",
    "arv_camera_get_float": "d pse",
    "arv_camera_get_float_bounds": "v psppe",
    "arv_camera_get_integer": "l pse",
    "arv_camera_get_integer_bounds": "v psppe",
    "arv_camera_get_integer_increment": "l pse",
    "arv_camera_get_model_name": "s pe",
    "arv_camera_get_payload": "u pe",
    "arv_camera_get_string": "s pse",
    "arv_camera_get_vendor_name": "s pe",
    "arv_camera_gv_get_packet_delay": "l pe",
    "arv_camera_gv_get_packet_size": "u pe",
    "arv_camera_gv_set_packet_delay": "v ple",
    "arv_camera_gv_set_packet_size": "v pie",
    "arv_camera_gv_set_packet_size_adjustment": "v pi",
    "arv_camera_gv_set_stream_options": "v pi",
    "arv_camera_is_feature_available": "b pse",
    "arv_camera_is_gv_device": "b p",
    "arv_camera_new": "p se",
    "arv_camera_set_boolean": "v psie",
    "arv_camera_set_float": "v psde",
    "arv_camera_set_integer": "v psle",
    "arv_camera_set_range_check_policy": "v pi",
    "arv_camera_set_string": "v psse",
    "arv_camera_start_acquisition": "v pe",
    "arv_camera_stop_acquisition": "v pe",
    "arv_gv_device_is_controller": "b p",
    # its stream and its buffers
    "arv_buffer_get_data": "p pp",
    "arv_buffer_get_frame_id": "L p",
    "arv_buffer_get_image_data": "p pp",
    "arv_buffer_get_image_height": "i p",
    "arv_buffer_get_image_padding": "v ppp",
    "arv_buffer_get_image_pixel_format": "u p",
    "arv_buffer_get_image_width": "i p",
    "arv_buffer_get_status": "i p",
    "arv_buffer_get_timestamp": "L p",
    "arv_buffer_new_allocate": "p z",
    "arv_gv_stream_get_port": "h p",
    "arv_stream_push_buffer": "v pp",
    "arv_stream_timeout_pop_buffer": "p pL",
    # the simulated camera
    "arv_fake_camera_get_payload": "z p",
    "arv_fake_camera_read_register": "b pup",
    "arv_fake_camera_set_fill_pattern": "v ppp",
    "arv_fake_camera_set_trigger_frequency": "v pd",
    "arv_fake_camera_write_memory": "b puup",
    "arv_fake_camera_write_register": "b puu",
    "arv_gv_fake_camera_get_fake_camera": "p p",
    "arv_gv_fake_camera_is_running": "b p",
    "arv_gv_fake_camera_new_full": "p sss",
}
"""Types of the C functions that are called, by name. A letter of the result, then letters of the arguments.

They follow the headers of Aravis 0.8.26 and of GLib 2: ``v`` nothing, ``p`` any pointer, ``s`` text, ``b``
gboolean, ``i`` gint or an enumeration, ``u`` guint, ``h`` guint16, ``l`` gint64, ``L`` guint64, ``d`` double,
``z`` gsize or GType, ``g`` gulong. A last argument ``e`` is the place for a GError.
"""

NAMES: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "linux": (("libaravis-0.8.so.0", "aravis-0.8"), ("libgobject-2.0.so.0",), ("libglib-2.0.so.0",)),
    "darwin": (
        ("libaravis-0.8.0.dylib", "aravis-0.8"),
        ("libgobject-2.0.0.dylib", "gobject-2.0"),
        ("libglib-2.0.0.dylib", "glib-2.0"),
    ),
    "win32": (
        ("libaravis-0.8-0.dll", "aravis-0.8-0.dll"),
        ("libgobject-2.0-0.dll", "gobject-2.0-0.dll"),
        ("libglib-2.0-0.dll", "glib-2.0-0.dll"),
    ),
}
"""File names of Aravis, GObject and GLib by system. Of each, the first that loads is used."""


class GError(ctypes.Structure):
    """GLib's error."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


class GValue(ctypes.Structure):
    """GObject's value of any type."""

    _fields_ = (("type", ctypes.c_size_t), ("data", ctypes.c_int64 * 2))


INT, DOUBLE = 6 << 2, 15 << 2
"""GObject's G_TYPE_INT and G_TYPE_DOUBLE."""


class Library:
    """The functions of Aravis, GObject and GLib in :data:`SIGNATURES`, as typed attributes.

    For example, ``library.arv_get_n_devices()`` calls a function.
    """

    def __init__(self) -> None:
        self._libraries = [_loaded(names) for names in NAMES.get(sys.platform, NAMES["linux"])]
        self._functions: dict[str, Callable[..., Any]] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        function = self._functions.get(name)
        if function is None:
            function = self._functions[name] = self._declared(name)
        return function

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function whose last argument is a GError.

        Returns:
            Its result.
        """
        place = ctypes.POINTER(GError)()
        result = getattr(self, name)(*arguments, ctypes.byref(place))
        if place:
            error = place.contents
            message, code = text(error.message), self._name_of(error.domain, error.code)
            self.g_clear_error(ctypes.byref(place))
            raise AravisError(message, code)
        return result

    def texts(self, name: str, *arguments: Any) -> tuple[str, ...]:
        """Call a function that returns an array of texts and their number, and free the array."""
        n = ctypes.c_uint()
        array = self.call(name, *arguments, ctypes.byref(n))
        if not array:
            return ()
        try:
            return tuple(
                text(item) for item in ctypes.cast(array, ctypes.POINTER(ctypes.c_char_p))[: n.value]
            )
        finally:
            self.g_free(array)

    def set_property(self, instance: int, name: str, value: float) -> None:
        """Set a property of an object that is a number or an enumeration. GObject converts the type."""
        place = GValue()
        is_int = isinstance(value, int)
        self.g_value_init(ctypes.byref(place), INT if is_int else DOUBLE)
        (self.g_value_set_int if is_int else self.g_value_set_double)(ctypes.byref(place), value)
        self.g_object_set_property(instance, name.encode(), ctypes.byref(place))

    def _name_of(self, domain: int, code: int) -> str:
        for quark, names in ERRORS.items():
            if domain == getattr(self, quark)() and code in names:
                return names[code]
        return f"{text(self.g_quark_to_string(domain))} {code}"

    def _declared(self, name: str) -> Callable[..., Any]:
        if name not in SIGNATURES:
            raise AttributeError(name)
        result, arguments = SIGNATURES[name].split(" ")
        for library in self._libraries:
            function = getattr(library, name, None)
            if function is not None:
                function.restype = TYPES[result]
                function.argtypes = [TYPES[letter] for letter in arguments]
                return function
        raise LibraryMissingError(f"it has no function {name}; expected version 0.8.20 or later")


def load_library() -> Library:
    """The library, loaded when this is first called."""
    global _library  # noqa: PLW0603 - a process has one
    with _lock:
        if _library is None:
            _library = Library()
        return _library


def library_version() -> str:
    """Version of the library, such as "0.8.26"."""
    parts = (getattr(load_library(), f"arv_get_{part}_version")() for part in ("major", "minor", "micro"))
    return ".".join(map(str, parts))


def text(value: bytes | None) -> str:
    """Text of a C string, empty for a null pointer."""
    return "" if value is None else value.decode(errors="replace")


def _loaded(names: tuple[str, ...]) -> ctypes.CDLL:
    """Load the first file that loads. Windows finds further libraries in its folder only with a full path."""
    reason = ""
    for name in names:
        path = name if name.startswith("lib") and sys.platform != "win32" else ctypes.util.find_library(name)
        try:
            if path is not None:
                return ctypes.CDLL(path)
        except OSError as error:
            reason = reason or str(error)
    raise LibraryMissingError(reason or f"no file {' or '.join(names)} was found")


_lock = threading.Lock()
_library: Library | None = None
