"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


@contextmanager
def whole_file(path: Path) -> Generator[IO[bytes]]:
    """Write a file that gets its name only when it is whole and on the disk.

    Until then an older file of that name stays as it is; where a link stands, the file that it
    leads to is replaced. What is no ordinary file, such as a pipe, is written to directly.

    Args:
        path: The file.

    Raises:
        OSError: It cannot be written; nothing is left of it.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    real = Path(os.path.realpath(path))
    part = real.with_name(f"{real.name}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(real)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
