"""The program that runs the firmware, compiled when it is first needed."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from labseq.plugin import DeviceError, cache_root

SOURCE: Final = Path(__file__).with_name("runner.c")
FIRMWARE: Final = Path(__file__).parents[1] / "firmware" / "labseq_ttl.hex"
PACKAGES: Final = "gcc libc6-dev libsimavr-dev libelf-dev"
"""Debian packages that it takes."""

COMPILE_TIMEOUT_S: Final = 120.0
_LIBRARIES: Final = ("-lsimavr", "-lelf", "-lutil")


def runner(device: str) -> Path:
    """The compiled program; it stays in labseq's cache.

    Args:
        device: Name of the box, for messages.

    Raises:
        DeviceError: It cannot be compiled; says what to install.
    """
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:24]
    program = cache_root() / "ttl" / digest / "runner"
    if not program.is_file():
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            raise _missing(device, "there is no C compiler")
        try:
            _compile(compiler, program)
        except subprocess.CalledProcessError as error:
            first = next((line for line in error.stderr.splitlines() if "error" in line), error.stderr[:200])
            raise _missing(device, first) from error
        except (OSError, subprocess.TimeoutExpired) as error:
            raise _missing(device, str(error)) from error
    return program


def _compile(compiler: str, program: Path) -> None:
    program.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=program.parent) as folder:
        made = Path(folder) / "runner"
        command = [compiler, "-O2", "-std=gnu11", str(SOURCE), "-o", str(made), *_LIBRARIES]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=COMPILE_TIMEOUT_S)  # noqa: S603 - a compiler, on our own file
        os.replace(made, program)  # noqa: PTH105 - whole or not at all, also if another process does the same


def _missing(device: str, reason: str) -> DeviceError:
    text = f"the firmware cannot be simulated: {reason}"
    hint = f"`apt-get install --no-install-recommends {PACKAGES}`, or set `simulated_by: python`"
    return DeviceError(device, f"{text}; {hint}")
