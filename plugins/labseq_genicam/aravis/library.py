"""The C library libaravis, loaded on first use."""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
import threading
from collections.abc import Callable
from typing import Any, Final

from labseq_genicam.aravis.errors import DESCRIPTION_ERRORS, DEVICE_ERRORS, AravisError, LibraryMissingError
from labseq_genicam.aravis.signatures import SIGNATURES, TYPES

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
"""By system: file names of Aravis, of GObject and of GLib, each the first one that loads."""


class GError(ctypes.Structure):
    """GLib's error."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


class GValue(ctypes.Structure):
    """GLib's value of any type."""

    _fields_ = (("type", ctypes.c_size_t), ("data", ctypes.c_uint64 * 2))


G_TYPE_INT: Final = 6 << 2
G_TYPE_UINT: Final = 7 << 2
G_TYPE_DOUBLE: Final = 15 << 2


class Library:
    """The functions of Aravis, of GObject and of GLib that are used here, by name and typed.

    ``library.arv_get_n_devices()`` calls one; names are those of :data:`SIGNATURES`.

    Raises:
        LibraryMissingError: A library cannot be loaded.
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

        Args:
            name: Name of the function.
            arguments: All arguments but the last.

        Returns:
            Its result.

        Raises:
            AravisError: The function reported an error.
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
        """Call a function that returns an array of texts, and free the array.

        Args:
            name: Name of the function; before its GError comes the place for the number of texts.
            arguments: All arguments before that.

        Raises:
            AravisError: The function reported an error.
        """
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

    def set_property(self, instance: int, name: str, value: float, type_: int) -> None:
        """Set a property of an object.

        Args:
            instance: The object.
            name: Name of the property.
            value: The value.
            type_: Its GType: G_TYPE_INT, G_TYPE_UINT, G_TYPE_DOUBLE, or that of an enumeration.
        """
        box = GValue()
        self.g_value_init(ctypes.byref(box), type_)
        if type_ == G_TYPE_DOUBLE:
            self.g_value_set_double(ctypes.byref(box), value)
        elif type_ == G_TYPE_INT:
            self.g_value_set_int(ctypes.byref(box), int(value))
        elif type_ == G_TYPE_UINT:
            self.g_value_set_uint(ctypes.byref(box), int(value))
        else:
            self.g_value_set_enum(ctypes.byref(box), int(value))
        self.g_object_set_property(instance, name.encode(), ctypes.byref(box))
        self.g_value_unset(ctypes.byref(box))

    def _name_of(self, domain: int, code: int) -> str:
        domains = {
            self.arv_device_error_quark(): DEVICE_ERRORS,
            self.arv_gc_error_quark(): DESCRIPTION_ERRORS,
        }
        names = domains.get(domain, ())
        return names[code] if 0 <= code < len(names) else f"{text(self.g_quark_to_string(domain))} {code}"

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


def library() -> Library:
    """The library, loaded when this is first called.

    Raises:
        LibraryMissingError: It cannot be loaded; says how to install it.
    """
    global _library  # noqa: PLW0603 - a process has one
    with _lock:
        if _library is None:
            _library = Library()
        return _library


def text(value: bytes | None) -> str:
    """What C calls a string; "" for none."""
    return "" if value is None else value.decode(errors="replace")


def _loaded(names: tuple[str, ...]) -> ctypes.CDLL:
    """Load the first that loads; on Windows, only a full path has its own folder searched."""
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
