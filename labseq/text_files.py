"""Reads users' text files of limited size in UTF-8, with a hint if a file name is misspelt."""

from __future__ import annotations

import codecs
import stat
from collections.abc import Collection
from pathlib import Path
from typing import Final

from labseq.errors import ConfigError, Problem
from labseq.files import is_there
from labseq.messages import clean, closest, visible

MAX_BYTES: Final = 1 << 18
"""Largest YAML file, in bytes. Reading it takes a quarter of a second."""

YAML_SUFFIXES: Final = (".yaml", ".yml")

_UTF32: Final = (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)


def read_bytes(
    path: Path,
    expected: str = "a YAML file",
    suffixes: Collection[str] = YAML_SUFFIXES,
    max_bytes: int = MAX_BYTES,
) -> bytes:
    """Read a file of limited size.

    Args:
        path: The file.
        expected: Kind of file, for the message if it is a folder or a pipe.
        suffixes: If the file is missing, the hint names a similar file with one of these suffixes.
        max_bytes: Largest size.

    Raises:
        ConfigError: The file is missing, a folder, not a regular file, unreadable or too large.
    """
    name = visible(str(path))
    try:
        if message := _other_kind(path.stat().st_mode):  # reading a pipe could block for ever
            raise ConfigError(Problem(message, name, expected=expected))
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except ConfigError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        hint = alike_file(path, suffixes)
        raise ConfigError(Problem("there is no such file", name, hint=hint)) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        reason = error.strerror if isinstance(error, OSError) else str(error)
        message = f"the file cannot be read: {str(reason or error).lower()}"
        raise ConfigError(Problem(message, name)) from error
    if len(data) > max_bytes:
        message = f"the file is larger than {max_bytes >> 10} KiB"
        raise ConfigError(Problem(message, name, expected="a few kilobytes"))
    return data


def decode(data: bytes, name: str) -> str:
    """Decode UTF-8, without the byte order mark.

    Raises:
        ConfigError: Not UTF-8. The error has the place of the first wrong byte.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, *_UTF32)):
        encoding = "UTF-32" if data.startswith(_UTF32) else "UTF-16"
        raise ConfigError(Problem(f"the file is {encoding}", name, 1, 1, "UTF-8", "save it as UTF-8"))
    body = data.removeprefix(codecs.BOM_UTF8)
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError as error:
        byte, before = body[error.start], body[: error.start].decode("utf-8")
        latin = bytes([byte]).decode("latin-1")
        likely = f" (in Latin-1 it is '{latin}')" if latin.isprintable() else ""
        offset = error.start + len(data) - len(body)
        message = f"byte 0x{byte:02X} at offset {offset} is not UTF-8{likely}"
        place = line_and_column(before, len(before))
        raise ConfigError(
            Problem(visible(message), name, *place, "a file in UTF-8", "save the file as UTF-8")
        ) from None


def line_and_column(text: str, index: int) -> tuple[int, int]:
    """Line and column, from 1, of a character of a text whose lines end with LF, CR or CR LF."""
    lines = text[:index].replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return len(lines), len(lines[-1]) + 1


def files_in(folder: Path, suffixes: Collection[str] = YAML_SUFFIXES) -> list[str]:
    """Names of the files in a folder with one of the suffixes, sorted. Empty if it cannot be read."""
    try:
        return sorted(path.name for path in folder.iterdir() if path.suffix in suffixes)
    except (OSError, ValueError):
        return []


def alike_file(path: Path, suffixes: Collection[str] = YAML_SUFFIXES) -> str:
    """A hint at the file in the same folder with the most similar name, or ""."""
    names = {Path(name).stem: name for name in files_in(path.parent, suffixes) if name != path.name}
    stem = path.stem if path.suffix in suffixes else path.name
    meant = closest(stem, names)
    return f"did you mean '{clean(names[meant])}'?" if meant else ""


def is_file(path: Path) -> bool:
    """Whether this is a file. False if that cannot be found out."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Whether this is a folder. False if that cannot be found out."""
    try:
        return path.is_dir()
    except OSError:
        return False


def something_else(path: Path) -> str:
    """Message if a path is not a file, as "this is a folder". "" for a file, or if nothing is there."""
    try:
        return _other_kind(path.stat().st_mode)
    except (OSError, ValueError):
        return ""


def check_output(path: Path, kind: str, ending: str) -> None:
    """Check name and folder of an output file before the work that produces it.

    Args:
        path: The file.
        kind: For example "an NPZ file".
        ending: For example ".npz".

    Raises:
        ConfigError: It has another ending, its folder does not exist, or the path is not an ordinary file.
    """
    name, expected = visible(str(path)), f"a file that ends in {ending}"
    if path.suffix.lower() != ending:
        raise ConfigError(Problem(f"this is not the name of {kind}", name, expected=expected))
    if not is_folder(path.parent):
        folder = visible(str(path.parent))
        raise ConfigError(Problem("there is no such folder", folder, expected="an existing folder"))
    if message := something_else(path):
        raise ConfigError(Problem(message, name, expected=expected))
    try:
        is_there(path)
    except OSError as error:  # for a name that is too long
        raise ConfigError(Problem(f"this is not the name of a file: {error.strerror}", name)) from error


def _other_kind(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "this is a folder"
    return "" if stat.S_ISREG(mode) else "this is not an ordinary file"
