"""What some tests need beyond the group ``test``: native libraries, tools, and heavy packages.

A test names its needs, ``@pytest.mark.needs("pypylon")``; where one is missing the test is skipped, and the
last lines of the run count these tests. With LABSEQ_REQUIRE_ALL=1 it fails instead.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

EMCCD_FRAMES = Path(
    os.environ.get("LABSEQ_EMCCD_DATA") or Path(__file__).parents[2] / "shared" / "data" / "emccd"
)
"""Folder of the measured frames that the EMCCD model is compared with."""


@dataclass(frozen=True)
class Need:
    """Something that is not on every machine.

    Attributes:
        is_here: Looks for it.
        install: How to get it.
    """

    is_here: Callable[[], bool]
    install: str


def _package(module: str) -> Need:
    return Need(lambda: find_spec(module) is not None, "uv sync --all-extras --all-groups")


def _compiles(compiler: str, suffix: str, header: str) -> bool:
    """True if a compiler is installed and finds a header, which its library's package may lack."""
    if shutil.which(compiler) is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / f"probe{suffix}"
        source.write_text(f"#include <{header}>\n", encoding="utf-8")
        command = [compiler, "-fsyntax-only", str(source)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


NEEDS = {
    "pypylon": _package("pypylon"),
    "pylablib": _package("pylablib"),
    "hdf5plugin": _package("hdf5plugin"),
    "nidaqmx": _package("nidaqmx"),
    "pyarrow": _package("pyarrow"),
    "ruff": _package("ruff"),
    "browser": Need(
        lambda: (
            find_spec("playwright") is not None and any(map(shutil.which, ("chromium", "chromium-browser")))
        ),
        "uv sync --all-extras --all-groups; apt-get install chromium",
    ),
    "libaravis": Need(lambda: find_library("aravis-0.8") is not None, "apt-get install libaravis-0.8-0"),
    "aravis-tools": Need(
        lambda: shutil.which("arv-fake-gv-camera-0.8") is not None, "apt-get install aravis-tools"
    ),
    "soapy-module": Need(
        lambda: _compiles("c++", ".cpp", "SoapySDR/Device.hpp") and find_library("SoapySDR") is not None,
        "apt-get install g++ libsoapysdr0.8 libsoapysdr-dev",
    ),
    "firmware": Need(
        lambda: _compiles("cc", ".c", "simavr/sim_avr.h") and _compiles("cc", ".c", "libelf.h"),
        "apt-get install gcc libc6-dev libsimavr-dev libelf-dev",
    ),
    "avr-gcc": Need(
        lambda: all(map(shutil.which, ("avr-gcc", "make"))), "apt-get install gcc-avr avr-libc make"
    ),
    "c-compiler": Need(lambda: _compiles("cc", ".c", "stdio.h"), "apt-get install gcc libc6-dev"),
    "downloads": Need(
        lambda: bool(os.environ.get("LABSEQ_WHEEL")), "LABSEQ_WHEEL=1, which fetches all that labseq needs"
    ),
    "emccd-frames": Need(
        EMCCD_FRAMES.is_dir, "LABSEQ_EMCCD_DATA=FOLDER, with files of github.com/fatmac78/EMCCD-calibration"
    ),
}


@cache
def is_here(name: str) -> bool:
    """True if what a test needs is on this machine."""
    return NEEDS[name].is_here()
