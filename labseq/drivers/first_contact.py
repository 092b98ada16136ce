"""The file of a first contact, with measurements of one device on one computer, sealed by a digest."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import read_file, write_file
from labseq.messages import visible
from labseq.plain import dumps, parse_object

SCHEMA: Final = 1
FOLDER: Final = "first-contact"
"""Folder of the files in the data folder."""
AGAIN: Final = "take all steps again with 'labseq first-contact'"


def contact_path(data: Path, serial: str, *, simulated: bool = False) -> Path:
    """The file of a device. A simulator has another file than the device that it simulates."""
    stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in serial) or "unnamed"
    return data / FOLDER / f"{stem}{'-simulated' if simulated else ''}.json"


def this_computer() -> dict[str, str]:
    """Name of this computer, and a hash that distinguishes it from others with the same name."""
    identity = _machine_id() or f"{uuid.getnode():x}"
    digest = hashlib.sha256(f"labseq first-contact {identity}".encode()).hexdigest()
    return {"node": platform.node(), "machine_id": digest[:16]}


def _machine_id() -> str:
    """The installation's own number, or "" if the system has none."""
    with suppress(OSError):
        if sys.platform == "win32":
            import winreg

            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, r"SOFTWARE\Microsoft\Cryptography") as key:
                return str(winreg.QueryValueEx(key, "MachineGuid")[0])
        return Path("/etc/machine-id").read_text("utf-8").strip()
    return ""


def digest_of(content: Mapping[str, Any]) -> str:
    """The digest of all other keys of a file. It reveals edits, but does not protect against them."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def write_contact(path: Path, content: Mapping[str, Any]) -> None:
    """Write the file with its digest.

    Raises:
        RecordingError: It cannot be written.
    """
    plain = parse_object(dumps(content).encode()) or {}  # as it will be read, with tuples as lists
    write_file(path, (dumps({**plain, "digest": digest_of(plain)}, indent=1) + "\n").encode())


def read_contact(path: Path) -> dict[str, Any]:
    """Read the file of a first contact.

    Raises:
        ConfigError: There is no file, it is damaged or edited, or it was written by a newer labseq.
    """
    try:
        content = parse_object(read_file(path))
    except RecordingError as error:
        raise _refused(path, "there is no readable file of a first contact", AGAIN) from error
    if content is None or "digest" not in content:
        raise _refused(path, "this is not the file of a first contact", AGAIN)
    if content.get("schema") != SCHEMA:
        what = f"its schema is {content.get('schema')!r}; expected {SCHEMA}"
        raise _refused(path, what, "use the labseq that wrote it, or " + AGAIN)
    if content["digest"] != digest_of(content):
        raise _refused(path, "its digest does not match, so it was edited after the measurement", AGAIN)
    return content


def check_belongs(content: Mapping[str, Any], card: Mapping[str, Any], path: Path) -> None:
    """Check that a first contact was made with this device, its present software, and this computer.

    Args:
        content: What :func:`read_contact` returned.
        card: "serial", "model", "driver" and "firmware" of the open device.
        path: The file, for the message.

    Raises:
        ConfigError: A part differs. The error names the part.
    """
    for key, value in card.items():
        if (measured := content["card"].get(key)) != value:
            raise _refused(path, f"it was measured with {key} {measured}, but the device has {value}", AGAIN)
    computer, here = content["computer"], this_computer()
    if computer["machine_id"] != here["machine_id"]:
        what = f"it was measured on another computer, '{computer['node']}', but this is '{here['node']}'"
        raise _refused(path, what, AGAIN + " here")


def _refused(path: Path, what: str, hint: str) -> ConfigError:
    return ConfigError(Problem(what, visible(str(path)), hint=hint))
