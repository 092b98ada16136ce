"""Where profiles, sequences and data are; files written whole; locks."""

from __future__ import annotations

import errno
import json
import os
import platform
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from filelock import BaseFileLock


@contextmanager
def whole_file(path: Path, *, alone: bool = False) -> Generator[IO[bytes]]:
    """Write a file that gets its name only when it is whole and on the disk.

    Until then an older file of that name stays as it is; where a link stands, the file that it
    leads to is replaced. What is no ordinary file, such as a pipe, is written to directly.

    Args:
        path: The file.
        alone: Whether to refuse while another process writes the same file in this way; what is read
            in the block is then still true when the file gets its name.

    Raises:
        FileExistsError: ``alone``, and another process writes it; ``filename`` is what it writes to, which
            a process that was killed leaves behind.
        OSError: It cannot be written; nothing is left of it.
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
            file.close()  # Windows renames no open file
            part.replace(real)
        except BaseException:
            with suppress(OSError):  # of a full disk, which has been told
                file.close()
            with suppress(OSError):
                part.unlink(missing_ok=True)
            raise


PROFILES: Final = "hardware_profiles"
"""Name of the folders of hardware profiles."""
SEQUENCES: Final = "sequences"
"""Name of the folders of sequences."""


def packaged_dir(folder: str) -> Path:
    """The folder of the profiles or the sequences that come with labseq.

    In a wheel it lies in ``labseq/config``, in a checkout at the top.
    """
    here = Path(__file__).resolve().parent
    packaged = here / "config" / folder
    return packaged if packaged.is_dir() else here.parent / folder


def packaged_profiles_dir() -> Path:
    """The folder of the profiles that come with labseq."""
    return packaged_dir(PROFILES)


def packaged_sequences_dir() -> Path:
    """The folder of the sequences that come with labseq."""
    return packaged_dir(SEQUENCES)


def profile_dir(profile: Path) -> Path:
    """The folder in which what belongs to a profile is kept: its own.

    Of an installed profile it is ./hardware_profiles, where a copy of it would stand: what is installed
    is everybody's, may be read-only, and goes with the next version.
    """
    folder = profile.resolve().parent
    is_installed = folder == Path(__file__).resolve().parent / "config" / PROFILES
    return Path(PROFILES).absolute() if is_installed else profile.parent


def data_root() -> Path:
    """Where runs are kept if nothing else is said: LABSEQ_DATA, else ``./data``."""
    return Path(os.environ.get("LABSEQ_DATA") or "data").expanduser()


_NO_LOCKS: Final = frozenset({errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP})
_FOR_ALL: Final = 0o666
"""Other users may lock the same file, whatever this user's mask is."""


@dataclass(frozen=True, slots=True)
class Holder:
    """Who holds a lock.

    Attributes:
        what: What it does, for example "the run data/2026-01-02/0001_compact"; "" if nobody knows.
        pid: Its process; 0 if nobody knows.
        host: Its computer.
        since_utc: Since when, ISO 8601, UTC.
    """

    what: str
    pid: int
    host: str
    since_utc: str

    def __str__(self) -> str:
        if not self.pid:
            return "a process that has not said what it does"
        return f"{self.what} (process {self.pid} on {self.host}, since {_local(self.since_utc)})"


class Lock:
    """A lock of the system on a file: whoever holds it loses it with its process.

    Beside the file stands ``<file>.holder``, which says who holds it.

    Args:
        path: The file; it is made if there is none, and its folder, and it stays.
        what: What the holder does.
    """

    def __init__(self, path: Path, what: str) -> None:
        self.path = path
        self._lock: BaseFileLock | None = None
        self._about = path.with_name(f"{path.name}.holder")
        self._holder = Holder(
            what, os.getpid(), platform.node(), datetime.now(UTC).isoformat(timespec="seconds")
        )

    def take(self) -> Holder | None:
        """Take it if it is free; who holds it if it is not.

        Raises:
            OSError: The file cannot be made; or the folder knows no locks, see :func:`knows_no_locks`.
        """
        from filelock import FileLock, SoftFileLock, Timeout  # takes 0.05 s to import

        self.path.parent.mkdir(parents=True, exist_ok=True)
        lock: Any = FileLock(self.path, timeout=0, mode=_FOR_ALL, thread_local=False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the package, where it makes do with less than a lock
                lock.acquire()
        except Timeout:
            return self._other()
        except NotImplementedError as error:
            raise OSError(errno.ENOSYS, str(error)) from error
        if isinstance(lock, SoftFileLock):  # it would outlive its holder
            lock.release()
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        self._lock = lock
        self.describe(self._holder.what)
        return None

    def describe(self, what: str) -> None:
        """Say what is done meanwhile; what cannot be written is not said."""
        self._holder = replace(self._holder, what=what)
        with suppress(OSError), whole_file(self._about) as file:
            file.write(json.dumps(asdict(self._holder)).encode())

    def release(self) -> None:
        """Free it; legal at any time."""
        if self._lock is not None:
            with suppress(OSError):
                self._about.unlink(missing_ok=True)
            self._lock.release()
            self._lock = None

    def _other(self) -> Holder:
        try:
            values: dict[str, Any] = json.loads(self._about.read_bytes())
            return Holder(
                str(values["what"]), int(values["pid"]), str(values["host"]), str(values["since_utc"])
            )
        except (OSError, ValueError, TypeError, KeyError):
            return Holder("", 0, "", "")


def knows_no_locks(error: OSError) -> bool:
    """Whether a lock failed because its folder, perhaps one of the network, has none to give."""
    return error.errno in _NO_LOCKS


def _local(time_utc: str) -> str:
    try:
        return f"{datetime.fromisoformat(time_utc).astimezone():%Y-%m-%d %H:%M:%S}"
    except ValueError:
        return time_utc
