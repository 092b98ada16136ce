"""From a path to checked text: the faults of a file that are no faults of YAML."""

from __future__ import annotations

import codecs
import re
import stat
import unicodedata
from collections.abc import Collection
from pathlib import Path
from typing import Final

from labseq.config.nodes import Mark
from labseq.config.wording import clean, closest, visible
from labseq.errors import ConfigError, Problem

MAX_BYTES: Final = 1 << 18
"""Largest YAML file, in bytes; reading it takes a quarter of a second."""

YAML_SUFFIXES: Final = (".yaml", ".yml")

_LINE_BREAK: Final = re.compile(r"\r\n|\r|\n")
# U+0085, U+2028 and U+2029 are line breaks for PyYAML but for few editors, so
# that all line numbers after them would be wrong; U+FEFF cannot be seen.
_FORBIDDEN: Final = re.compile(
    "[^\t\n\r\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]"
)
# At the beginning of a line, all other spaces are text to YAML and indentation to the eye.
_ODD_INDENT: Final = re.compile("^[ \t-]*([\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000])", re.MULTILINE)
_UTF16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
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
        expected: What it should be, in words.
        suffixes: Endings of the names that come into question if there is no such file.
        max_bytes: Most bytes that it may have.

    Raises:
        ConfigError: Missing, a folder, no regular file, unreadable or too large.
    """
    name = visible(str(path))
    try:
        data = _bytes_of(path, max_bytes)
    except (FileNotFoundError, NotADirectoryError):
        hint = alike_file(path, suffixes)
        raise ConfigError(Problem("there is no such file", name, hint=hint)) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        reason = error.strerror if isinstance(error, OSError) else str(error)
        what = f"the file cannot be read: {str(reason or error).lower()}"
        raise ConfigError(Problem(what, name)) from error
    if isinstance(data, str):
        raise ConfigError(Problem(data, name, expected=expected))
    if len(data) > max_bytes:
        what = f"the file is larger than {max_bytes >> 10} KiB"
        raise ConfigError(Problem(what, name, expected="a few kilobytes"))
    return data


def _bytes_of(path: Path, max_bytes: int) -> bytes | str:
    """The first bytes of a file, one more than allowed; or why this is none."""
    if what := _no_file(path.stat().st_mode):  # reading a pipe could wait for ever
        return what
    with path.open("rb") as file:
        return file.read(max_bytes + 1)


def _no_file(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "this is a folder"
    return "" if stat.S_ISREG(mode) else "this is not an ordinary file"


def something_else(path: Path) -> str:
    """What there is in place of a file, in words; "" for a file, for nothing, and if it cannot be told."""
    try:
        return _no_file(path.stat().st_mode)
    except (OSError, ValueError):
        return ""


def decode(data: bytes, name: str) -> str:
    """Decode UTF-8, with or without a byte order mark; the mark is left out.

    Raises:
        ConfigError: Not UTF-8; with the place of the first wrong byte.
    """
    if data.startswith((*_UTF16, *_UTF32)):
        came = "UTF-32" if data.startswith(_UTF32) else "UTF-16"
        raise ConfigError(Problem(f"the file is {came}", name, 1, 1, "UTF-8", "save it as UTF-8"))
    body = data.removeprefix(codecs.BOM_UTF8)
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError as error:
        byte = body[error.start]
        offset = error.start + len(data) - len(body)
        latin = bytes([byte]).decode("latin-1")
        likely = f" (in Latin-1 it is '{latin}')" if latin.isprintable() else ""
        mark = _mark_at(body[: error.start].decode("utf-8"), error.start)
        what = f"byte 0x{byte:02X} at offset {offset} is not UTF-8{likely}"
        raise ConfigError(mark.problem(name, what, "a file in UTF-8", "save the file as UTF-8")) from None


def check_characters(text: str, name: str, origin: str = "") -> None:
    """Refuse control characters, odd line breaks and what is no character at all.

    Raises:
        ConfigError: With the place of the first one.
    """
    match = _FORBIDDEN.search(text)
    if match is None:
        _check_indentation(text, name, origin)
        return
    char = match[0]
    code = f"U+{ord(char):04X}"
    hint = "delete it"
    if char == "\0":
        what, hint = f"a NUL character ({code})", "is this a YAML file, saved as UTF-8?"
    elif "\ud800" <= char <= "\udfff":
        what = "a byte that is not UTF-8" if origin else f"half of a character ({code})"
    else:
        kind = unicodedata.name(char, "control character").lower()
        what = f"an invisible character ({code}, {kind})"
    mark = Mark(0, 0, origin) if origin else _mark_at(text, match.start())
    raise ConfigError(mark.problem(name, what, "plain text", hint))


def _check_indentation(text: str, name: str, origin: str) -> None:
    match = _ODD_INDENT.search(text)
    if match is not None:
        kind = unicodedata.name(match[1]).lower()
        mark = Mark(0, 0, origin) if origin else _mark_at(text, match.start(1))
        what = f"{'an' if kind[0] in 'aeio' else 'a'} {kind} (U+{ord(match[1]):04X}) is used for indentation"
        raise ConfigError(mark.problem(name, what, "plain spaces"))


def _mark_at(text: str, index: int) -> Mark:
    """Line and column of a character of the text."""
    breaks = [match.end() for match in _LINE_BREAK.finditer(text, 0, index)]
    start = breaks[-1] if breaks else 0
    return Mark(len(breaks) + 1, min(index, len(text)) - start + 1)


def files_in(folder: Path, suffixes: Collection[str] = YAML_SUFFIXES) -> list[str]:
    """Names of the files in a folder with one of the suffixes, sorted; none if it cannot be read."""
    try:
        return sorted(path.name for path in folder.iterdir() if path.suffix in suffixes)
    except (OSError, ValueError):
        return []


def alike_file(path: Path, suffixes: Collection[str] = YAML_SUFFIXES) -> str:
    """A hint at the file in the same folder that is spelled most alike, whatever its suffix, or ""."""
    names = {Path(name).stem: name for name in files_in(path.parent, suffixes) if name != path.name}
    stem = path.stem if path.suffix in suffixes else path.name
    meant = closest(stem, names)
    return f"did you mean '{clean(names[meant])}'?" if meant else ""


def beside(folder: Path, path: str) -> Path:
    """A path that a file in ``folder`` names; ``~`` is the user's home."""
    try:
        return folder / Path(path).expanduser()
    except RuntimeError:  # "~nobody"
        return folder / path


def is_file(path: Path) -> bool:
    """Whether there is such a file; False where that cannot be told."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Whether there is such a folder; False where that cannot be told."""
    try:
        return path.is_dir()
    except OSError:
        return False
