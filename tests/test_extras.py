"""Without an extra, whatever needs it says what is missing, and what to install."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from labseq_andor.library import load_pylablib
from labseq_frames.files import BadFramesError, load
from labseq_optuna.scanner import OptunaScanner, OptunaSettings
from labseq_pylon.library import load_pypylon

import labseq.testing
from labseq import messages
from labseq.builtin.patterns import read_drawing
from labseq.campaign import make_keys
from labseq.cluster import connect
from labseq.errors import LabseqError
from labseq.model import ScanSpace
from labseq.pictures.figures import check_place
from labseq.recording.export import check_export
from labseq.recording.hdf5 import load_filter
from labseq.web.serve import check_packages
from labseq.wire import require_packages

ROOT = Path(__file__).parents[1]
EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]


def compressed() -> h5py.Dataset:
    file = h5py.File("a.h5", "w", driver="core", backing_store=False)
    return file.create_dataset("frames", data=[0], chunks=True, compression="gzip")


NEEDS: dict[tuple[str, str, str], Callable[[], object]] = {
    # extra, distribution, module that is not there -> what needs it
    ("analysis", "pandas", "pandas"): lambda: check_export("parquet", Path("a.parquet")),
    ("analysis", "pyarrow", "pyarrow"): lambda: check_export("parquet", Path("a.parquet")),
    ("analysis", "xarray", "xarray"): lambda: check_export("netcdf", Path("a.nc")),
    ("analysis", "h5netcdf", "h5netcdf"): lambda: check_export("netcdf", Path("a.nc")),
    ("andor", "pylablib", "pylablib.devices.Andor.AndorSDK2"): lambda: load_pylablib("camera"),
    ("campaign", "distributed", "distributed"): lambda: connect("tcp://127.0.0.1:9", None),
    ("campaign", "cryptography", "cryptography"): lambda: make_keys(Path("keys")),
    ("compress", "hdf5plugin", "hdf5plugin"): lambda: load_filter(Path("shot.h5"), compressed()),
    ("frames", "tifffile", "tifffile"): lambda: load("tifffile", "tifffile", Path("a.tif")),
    ("frames", "pillow", "PIL.Image"): lambda: load("PIL.Image", "Pillow", Path("a.png")),
    ("optuna", "optuna", "optuna"): lambda: OptunaScanner(OptunaSettings(), ScanSpace((), 1)),
    ("plot", "matplotlib", "matplotlib"): lambda: check_place(Path("a.png")),
    ("plot", "pillow", "PIL"): lambda: read_drawing(ROOT / "docs" / "_static" / "plan_kagome.png", "#"),
    ("pylon", "pypylon", "pypylon.pylon"): lambda: load_pypylon("camera"),
    ("remote", "pyzmq", "zmq"): require_packages,
    ("remote", "msgpack", "msgpack"): require_packages,
    ("testing", "hypothesis", "hypothesis"): lambda: labseq.testing.CameraContract,
    ("testing", "pytest", "pytest"): lambda: labseq.testing.CameraContract,
    ("web", "starlette", "starlette"): check_packages,
    ("web", "uvicorn", "uvicorn"): check_packages,
    ("web", "httptools", "httptools"): check_packages,
    ("web", "uvloop", "uvloop"): check_packages,
}


@pytest.mark.parametrize("case", NEEDS, ids=lambda case: "-".join(case[:2]))
def test_what_to_install(case: tuple[str, str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    extra, distribution, module = case
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises((LabseqError, BadFramesError, ModuleNotFoundError)) as caught:
        NEEDS[case]()
    reported = str(caught.value)
    assert f"labseq[{extra}]" in reported
    assert "install" in reported
    assert distribution in reported.lower()


def test_every_package_of_every_extra_is_tried() -> None:
    def name(requirement: str) -> str:
        return re.split("[;>=<]", requirement)[0].strip().removesuffix("-lightweight")

    listed = {(extra, name(package)) for extra, packages in EXTRAS.items() for package in packages}
    assert {case[:2] for case in NEEDS} == listed


@pytest.mark.parametrize(("pip", "command"), [(object(), "pip"), (None, "uv pip")])
def test_the_hint_names_a_tool_that_installs_into_this_environment(
    monkeypatch: pytest.MonkeyPatch, pip: object, command: str
) -> None:
    monkeypatch.setattr(messages, "find_spec", lambda _: pip)
    assert messages.install_hint("plot") == f"{command} install 'labseq[plot]'"
