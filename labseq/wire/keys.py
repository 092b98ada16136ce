"""The keys of this computer and of the computers that it knows, each in a file.

The folder of keys contains ``NAME.key_secret``, the secret key of this computer, ``NAME.key``, its public
key, which other computers need, and a folder ``known`` with the public keys of other computers.
"""

from __future__ import annotations

import errno
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import explained, read_file, write_file
from labseq.messages import clean

SECRET: Final = ".key_secret"  # noqa: S105 - the end of a file's name
PUBLIC: Final = ".key"
KNOWN: Final = "known"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True, repr=False)
class Keys:
    """The keys of this computer, as 40 characters of Z85 each."""

    public: bytes
    secret: bytes


def keys_root() -> Path:
    """Folder of keys. LABSEQ_KEYS, else ``keys`` in the user's configuration folder."""
    if folder := os.environ.get("LABSEQ_KEYS"):
        return Path(folder).expanduser()
    import platformdirs

    return Path(platformdirs.user_config_dir("labseq", appauthor=False)) / "keys"


def new_keys(name: str, folder: Path) -> tuple[Path, Path]:
    """Make the keys of this computer.

    Returns:
        The files of the secret and of the public key.

    Raises:
        ConfigError: The name cannot be a file name, or such a key already exists.
        RecordingError: The files cannot be written.
    """
    import zmq

    if _NAME.fullmatch(name) is None:
        raise ConfigError(
            Problem(
                f"'{clean(name)}' cannot be the name of a key", expected="letters, digits, '_', '.' and '-'"
            )
        )
    secret, public = folder / f"{name}{SECRET}", folder / f"{name}{PUBLIC}"
    for path in (secret, public):
        if path.exists():
            raise ConfigError(Problem("such a key already exists", str(path), hint="choose another name"))
    public_key, secret_key = zmq.curve_keypair()
    with explained(secret):
        (folder / KNOWN).mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(secret, flags, 0o600), "wb") as file:  # closed to others from the start
            file.write(_content(public_key, secret_key))
    write_file(public, _content(public_key))
    return secret, public


def _content(public: bytes, secret: bytes = b"") -> bytes:
    text = b'curve\n    public-key = "' + public + b'"\n'
    return text + (b'    secret-key = "' + secret + b'"\n' if secret else b"")


def find_keys(folder: Path) -> Keys:
    """Read the keys of this computer.

    Args:
        folder: The folder of keys.

    Raises:
        ConfigError: There is no key, there are several, or the file is damaged.
    """
    files = sorted(folder.glob(f"*{SECRET}"))
    if len(files) != 1:
        problem = "there are several keys of this computer" if files else "this computer has no key"
        hint = "keep one of them in this folder" if files else "make one with 'labseq keys new'"
        raise ConfigError(Problem(problem, str(folder), hint=hint))
    keys = _read(files[0])
    if len(keys) != 2:
        raise ConfigError(
            Problem("this file is damaged", str(files[0]), expected="a public and a secret key")
        )
    return Keys(keys[b"public"], keys[b"secret"])


def read_public(path: Path) -> bytes:
    """Read the public key in a file.

    Raises:
        ConfigError: The file does not exist, or is damaged.
    """
    keys = _read(path)
    if b"public" not in keys:
        raise ConfigError(Problem("this file is damaged", str(path), expected="a public key"))
    return keys[b"public"]


def known_keys(folder: Path) -> dict[bytes, str]:
    """The public keys of other computers -> their names, without unreadable or damaged files.

    Raises:
        OSError: The folder cannot be read, which is not the same as an empty folder.
        RecordingError: This process, or the computer, can open no more files.
    """
    names: list[str] = []
    with suppress(FileNotFoundError):
        names = sorted(os.listdir(folder / KNOWN))  # noqa: PTH208 - glob() hides errors
    known: dict[bytes, str] = {}
    for path in [folder / KNOWN / name for name in names if name.endswith(PUBLIC)]:
        try:
            public = _values(path).get(b"public")
        except RecordingError as error:
            # if no file can be opened, every key would seem withdrawn, and all clients would be cut off
            if getattr(error.__cause__, "errno", 0) in (errno.EMFILE, errno.ENFILE):
                raise
            continue
        if public is not None:
            known[public] = path.stem
    return known


def _read(path: Path) -> dict[bytes, bytes]:
    if path.parent.name == KNOWN and not path.exists():
        problem, hint = f"there is no key of {path.stem}", "copy the public key of that computer there"
        raise ConfigError(Problem(problem, str(path), hint=hint))
    try:
        return _values(path)
    except RecordingError as error:
        raise ConfigError(str(error)) from error


def _values(path: Path) -> dict[bytes, bytes]:
    """The keys "public" and "secret" in a file that has the format of ZeroMQ's certificates."""
    pattern = rb'^\s*(public|secret)-key = "([!#-~]{40})"\s*$'
    return dict(re.findall(pattern, read_file(path, 4096), re.MULTILINE))
