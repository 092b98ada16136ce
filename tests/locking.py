"""Another process that holds a lock."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

HOLD = """
import sys
from pathlib import Path
from labseq.processes import Lock
lock = Lock(Path(sys.argv[1]), sys.argv[2])
assert lock.take() is None
print("held", flush=True)
input()
"""


@contextmanager
def held_elsewhere(path: Path, what: str) -> Generator[subprocess.Popen[bytes]]:
    """A process that holds a lock within the block, and ends without releasing it."""
    command = [sys.executable, "-c", HOLD, str(path), what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        yield child
