"""Compiling the SoapySDR module of the simulated radio, once for each version of its source."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from labseq.plugin import DeviceError, cache_root

SOURCE: Final = Path(__file__).with_name("capture.cpp")
NEEDS: Final = "install them with `apt-get install g++ libsoapysdr-dev`"

_INCLUDES: Final = ("/usr/include", "/usr/local/include", "/opt/homebrew/include")


def can_build() -> bool:
    """Whether a compiler and the headers of SoapySDR are installed; a quick check."""
    return _compiler() is not None and _include() is not None


def build_module(name: str = "static_tweezers") -> Path:
    """Compile the module into labseq's cache, unless it is there; returns its folder.

    Raises:
        DeviceError: The compiler or the headers are missing, or it does not compile.
    """
    source = SOURCE.read_bytes()
    digest = hashlib.sha256(source + platform.platform().encode()).hexdigest()[:16]
    folder = cache_root() / "soapy" / digest
    if not folder.exists():
        _compile(name, folder)
    return folder


def _compile(name: str, folder: Path) -> None:
    compiler, include = _compiler(), _include()
    if compiler is None or include is None:
        missing = "no C++ compiler" if compiler is None else "no headers of SoapySDR"
        text = f"the simulated radio must be compiled, but there are {missing} here; {NEEDS}"
        raise DeviceError(name, text)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as work:
        part = Path(work) / folder.name
        part.mkdir()
        flags = ["-O2", "-std=c++14", "-shared", "-fPIC", f"-I{include}", f"-L{include.parent / 'lib'}"]
        output = part / "libcapture.so"
        command = [compiler, *flags, "-o", str(output), str(SOURCE), "-lSoapySDR"]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603
        if done.returncode != 0:
            text = f"the simulated radio does not compile: {_first_error(done.stderr)}; {NEEDS}"
            raise DeviceError(name, text)
        try:
            part.rename(folder)
        except OSError:  # another process was first
            if not folder.exists():
                raise


def _compiler() -> str | None:
    return shutil.which(os.environ.get("CXX") or "g++")


def _include() -> Path | None:
    return next((Path(place) for place in _INCLUDES if (Path(place) / "SoapySDR/Device.hpp").exists()), None)


def _first_error(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if "error" in line] or [output.strip()]
    return lines[0][:300]
