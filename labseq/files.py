"""Files that survive a crash, and the folders where labseq keeps things.

:func:`whole_file` and :func:`write_file` are the one way to write a whole file, :class:`LineLog` the one way
to append to a file.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, Final

from labseq.errors import RecordingError
from labseq.plain import dumps, parse_object


@contextmanager
def whole_file(path: Path, *, alone: bool = False) -> Generator[IO[bytes]]:
    """Write a file that gets its name only when it is complete and on the disk.

    It is written as ``<name>.part``, flushed to the disk and renamed. Until then an older file of that name
    stays as it is. If the path is a link, the file that it points to is replaced. A pipe or another special
    file is written to directly.

    Args:
        path: The file.
        alone: Refuse while another process writes the same file in this way, so that values read in the block
            are still valid when the file gets its name.

    Raises:
        FileExistsError: ``alone`` is set and another process writes the file. ``filename`` is the ``.part``
            file, which a killed process leaves behind.
        OSError: It cannot be written. No ``.part`` file is left.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    real = Path(os.path.realpath(path))
    part = real.with_name(f"{real.name}.part")
    with part.open("xb" if alone else "wb") as file:
        try:
            yield file
            file.flush()
            os.fsync(file.fileno())
            file.close()  # Windows cannot rename an open file
            _give_name(part, real)
        except BaseException:
            with suppress(OSError):  # closing flushes, which fails again on a full disk
                file.close()
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise
    sync_folder(real.parent)


def _give_name(part: Path, real: Path) -> None:
    """Rename a complete file. On Windows, wait until no program reads the file that it replaces."""
    attempts = 400 if os.name == "nt" else 1  # readers hold a file open for milliseconds
    for attempt in range(1, attempts + 1):
        try:
            part.replace(real)
            return
        except PermissionError:
            if attempt == attempts:
                raise
            time.sleep(0.005)


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Write a whole file at once, see :func:`whole_file`.

    Raises:
        RecordingError: The disk is full or the folder cannot be written to.
    """
    with explained(path), whole_file(path) as file:
        _write_all(file, data)


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of files to the disk, if the system supports it (Windows does not)."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # nor do some network folders
            raise
    finally:
        os.close(handle)


def free_bytes(folder: Path) -> int:
    """Free space of the disk on which a folder is, or will be.

    Raises:
        OSError: The disk does not answer.
    """
    return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free


def make_folder(path: Path, *, is_new: bool = False) -> None:
    """Make a folder and its parents, writable for the group if the folder around it is.

    Args:
        path: The folder.
        is_new: True if the folder must not exist yet.

    Raises:
        OSError: It cannot be made.
    """
    if not path.parent.is_dir():
        make_folder(path.parent)
    try:
        path.mkdir()
    except FileExistsError:
        if is_new or not path.is_dir():
            raise
    else:
        share_with_group(path)


def share_with_group(path: Path) -> None:
    """Let the group write to a new file or folder if it may write to the folder around it.

    With the usual umask, only the user with the first run of a day could write to the folder of that day.
    """
    with suppress(OSError):
        around, own = path.parent.stat(), path.stat()
        if around.st_mode & stat.S_IWGRP and around.st_gid == own.st_gid and os.name != "nt":
            path.chmod(stat.S_IMODE(own.st_mode) | stat.S_IWGRP)


_ELSEWHERE: Final = "choose another place with --output or LABSEQ_DATA"
_ADVICE: Final = {
    errno.ENOSPC: f"the disk is full; free some space, or {_ELSEWHERE}",
    errno.EDQUOT: f"your disk quota is used up; free some space, or {_ELSEWHERE}",
    errno.EROFS: f"the disk is read-only; {_ELSEWHERE}",
    errno.ENOTDIR: f"a file is where a folder is needed; move it, or {_ELSEWHERE}",
    errno.EEXIST: f"a file is where a folder is needed; move it, or {_ELSEWHERE}",
    errno.ENOENT: "the folder is gone; do not move or delete a run while it is written",
    errno.EIO: f"the disk reports a fault; check it and its cable, or {_ELSEWHERE}",
}


@contextmanager
def explained(path: Path) -> Generator[None]:
    """Turn an ``OSError`` while writing ``path`` into a ``RecordingError`` that says what to do.

    Raises:
        RecordingError: The body raised an ``OSError``.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        advice = _ADVICE.get(error.errno or 0, f"check the disk, or {_ELSEWHERE}")
        if isinstance(error, PermissionError):
            advice = f"labseq has no permission to write there; {_whose(path)}{_ELSEWHERE}"
        raise RecordingError(path, f"cannot be written: {reason}", advice) from error


def _whose(path: Path) -> str:
    """Advice on who can give write permission, or "" if this user may write or that is unknown."""
    with suppress(OSError, NotImplementedError):
        existing = next(place for place in (path, *path.parents) if place.exists())
        owner = f"user {existing.stat().st_uid}"
        with suppress(KeyError):  # an account of another computer that shares the disk
            owner = existing.owner()
        if not os.access(existing, os.W_OK):
            who = f"{existing} belongs to {owner}"
            return f"{who}, who can let the group write with 'chmod -R g+w {existing}', or "
    return ""


MAX_LINE: Final = 16 << 20
"""Longest line of a file of JSON lines, in bytes."""


def check_ordinary(path: Path) -> None:
    """Raise for a pipe or a device, which could block for ever.

    Raises:
        OSError: It is a pipe or a device, or nothing is there.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "this is not an ordinary file")


def open_ordinary(path: Path) -> BufferedReader:
    """Open a file to read it.

    Raises:
        OSError: It cannot be read, or is a pipe or a device.
    """
    check_ordinary(path)
    return path.open("rb")


def read_file(path: Path, max_bytes: int = 16 << 20) -> bytes:
    """Read a whole file of limited size.

    Raises:
        RecordingError: It cannot be read, or is too large.
    """
    try:
        with open_ordinary(path) as file:
            n_bytes = os.fstat(file.fileno()).st_size
            if n_bytes > max_bytes:
                raise RecordingError(
                    path, f"is larger than {max_bytes >> 20} MiB", "restore it from a backup"
                )
            return file.read(n_bytes)
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(path, f"cannot be read: {reason}", "check the disk") from error


def is_there(path: Path) -> bool:
    """Whether there is anything at a path.

    Raises:
        OSError: The name is too long, or the answer cannot be found out. From Python 3.14 on ``Path.exists``
            hides such errors.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def lines_in(path: Path, start: int = 0, longest: int = MAX_LINE) -> Generator[bytes]:
    r"""The lines of a file from a byte on, with their ends. The last line may lack its "\n".

    Raises:
        RecordingError: It cannot be read, or a line is too long.
    """
    try:
        with open_ordinary(path) as file:
            file.seek(start)
            while line := file.readline(longest + 1):
                if len(line) > longest:
                    fault = f"has a line longer than {longest >> 20} MiB"
                    raise RecordingError(path, fault, "restore it from a backup")
                yield line
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}", "check the disk") from error


class LineLog:
    """An append-only file of JSON lines. Only lines that end with a newline count.

    A line that a killed process left unfinished is kept as a separate line. If an append fails in this
    process, the next one overwrites it.

    Args:
        path: The file, which is made if it does not exist.

    Raises:
        RecordingError: The file cannot be made or read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with explained(path), path.open("a+b", buffering=0) as file:
            self._length = file.seek(0, os.SEEK_END)
            if not self._length:
                share_with_group(path)
            file.seek(max(0, self._length - 1))
            if file.read(1) not in (b"", b"\n"):
                self._length += file.write(b"\n")

    def append(self, values: object, *, sync: bool) -> None:
        """Add a line. ``sync`` waits until it is on the disk.

        Raises:
            RecordingError: It could not be written. The file is unchanged.
        """
        line = dumps(values).encode() + b"\n"
        with explained(self.path), self.path.open("r+b", buffering=0) as file:
            start = min(self._length, file.seek(0, os.SEEK_END))
            try:
                file.seek(start)
                file.truncate()
                _write_all(file, line)
                if sync:
                    os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    file.truncate(start)
                raise
        self._length = start + len(line)


def _write_all(file: IO[bytes], data: bytes | memoryview) -> None:
    remaining = memoryview(data)
    while remaining:
        remaining = remaining[os.write(file.fileno(), remaining) :]


def read_lines(path: Path) -> tuple[list[dict[str, Any]], list[int]]:
    """Read a file of JSON lines, even if it is damaged.

    Returns:
        The complete lines, and the numbers (from 1) of damaged lines. An unfinished last line is in neither,
        because it was never reported as written. Both are empty if there is no file.

    Raises:
        RecordingError: The file exists but cannot be read.
    """
    if not path.exists():
        return [], []
    rows_or_none = [parse_object(line) for line in lines_in(path) if line.endswith(b"\n")]
    rows = [row for row in rows_or_none if row is not None]
    return rows, [number for number, row in enumerate(rows_or_none, start=1) if row is None]


class NewLines:
    """Reads the lines that are appended to a file of JSON lines.

    Args:
        path: The file, which need not exist yet.
        longest: Longest line, in bytes.
    """

    def __init__(self, path: Path, longest: int = MAX_LINE) -> None:
        self._path = path
        self._longest = longest
        self._at, self._inode = 0, 0

    def placed(self) -> Generator[tuple[int, dict[str, Any] | None]]:
        """The lines since the last call, as position in the file and values (None if damaged).

        Raises:
            RecordingError: The file cannot be read.
        """
        if not self._path.exists():
            return
        self._inode = self._path.stat().st_ino
        for line in lines_in(self._path, self._at, self._longest):
            if line.endswith(b"\n"):  # else it is still being written
                start, self._at = self._at, self._at + len(line)
                yield start, parse_object(line)

    def read(self) -> list[dict[str, Any]]:
        """The lines since the last call, without damaged ones.

        Raises:
            RecordingError: The file cannot be read.
        """
        return [values for _, values in self.placed() if values is not None]

    def is_replaced(self) -> bool:
        """Whether the file is no longer the one that was read, or has become shorter than what was read."""
        if not self._at:
            return False
        if not self._path.exists():
            return True
        about = self._path.stat()
        return about.st_ino != self._inode or about.st_size < self._at


PROFILES: Final = "hardware_profiles"
"""Name of the folders of hardware profiles."""
PLUGINS: Final = "plugins"
"""Folder of a lab's own plugins. Their code runs only if a file or an option names the folder."""
PLUGIN_PATH: Final = "LABSEQ_PLUGIN_PATH"
"""Environment variable with further folders of plugins."""
SEQUENCES: Final = "sequences"
"""Name of the folders of sequences."""


def packaged_dir(folder: str) -> Path:
    """The folder of the profiles or the sequences that come with labseq.

    In a wheel it is in ``labseq/config``, in a checkout at the top.
    """
    package = Path(__file__).resolve().parent
    packaged = package / "config" / folder
    return packaged if packaged.is_dir() else package.parent / folder


def packaged_profiles_dir() -> Path:
    """The folder of the profiles that come with labseq."""
    return packaged_dir(PROFILES)


def packaged_sequences_dir() -> Path:
    """The folder of the sequences that come with labseq."""
    return packaged_dir(SEQUENCES)


def profile_dir(profile: Path) -> Path:
    """The folder of the profile's file, for data of the profile such as its calibrations.

    For a profile that comes with labseq it is ./hardware_profiles, where a copy of the profile would be,
    because its file is used from other working folders as well.
    """
    is_packaged = profile.resolve().parent == packaged_profiles_dir().resolve()
    return Path(PROFILES).absolute() if is_packaged else profile.parent


def data_root() -> Path:
    """Default folder of runs: LABSEQ_DATA, else ``./data``."""
    return Path(os.environ.get("LABSEQ_DATA") or "data").expanduser()


def state_root() -> Path | None:
    """Folder of the data that labseq keeps for this user between runs.

    ``LABSEQ_STATE`` if set, else the platform's folder for state. None for a user without a home.
    """
    import platformdirs

    try:
        folder = os.environ.get("LABSEQ_STATE") or platformdirs.user_state_dir("labseq", appauthor=False)
        return Path(folder).expanduser()
    except RuntimeError:
        return None


def cache_root() -> Path:
    """Folder of labseq's cache for this user.

    ``LABSEQ_CACHE`` if set, else ``labseq`` in numba's ``NUMBA_CACHE_DIR`` if that is set, else the
    platform's folder for caches.

    Raises:
        RuntimeError: The user has no home.
    """
    if folder := os.environ.get("LABSEQ_CACHE"):
        return Path(folder).expanduser()
    if numba_folder := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(numba_folder) / "labseq"
    import platformdirs

    return Path(platformdirs.user_cache_dir("labseq", appauthor=False)).expanduser()


def devices_root() -> Path:
    """Folder of the locks and markers of the devices of this computer, for all users.

    ``LABSEQ_LOCKS`` if set, else ``/var/tmp/labseq``, which lasts longer than a power cut, or on Windows
    ``labseq`` in ProgramData.
    """
    if folder := os.environ.get("LABSEQ_LOCKS"):
        return Path(folder).expanduser().absolute()
    system = os.environ.get("PROGRAMDATA", r"C:\ProgramData") if os.name == "nt" else "/var/tmp"  # noqa: S108
    return Path(system) / "labseq"


FOR_ALL: Final = 0o666
"""Mode of files that every user may change, whatever this user's umask is."""


def make_shared(folder: Path) -> None:
    """Make a folder in which every user may make files, and delete only their own.

    Raises:
        OSError: It cannot be made.
    """
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):
            folder.chmod(0o1777)


def write_shared(path: Path, data: bytes) -> None:
    """Write a small file, in :func:`devices_root`, that other users may change but not replace.

    Raises:
        OSError: It cannot be written.
    """
    make_shared(path.parent)
    try:
        with whole_file(path) as file:
            file.write(data)
        path.chmod(FOR_ALL)
    except PermissionError:
        with path.open("r+b", buffering=0) as file:
            file.write(data)
            file.truncate()
