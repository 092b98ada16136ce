"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


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
