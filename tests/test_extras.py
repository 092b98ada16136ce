"""Without an extra, whatever needs it says what is missing, and what to install."""

from __future__ import annotations

import ast
import contextlib
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from typing import Any, cast

import h5py
import pytest
from labseq_frames.files import BadFramesError, load
from labseq_nidaqmx.library import import_package
from labseq_optuna.scanner import OptunaScanner, OptunaSettings
from labseq_pylablib.library import DCAM, load as load_pylablib
from labseq_pylon.library import load_pypylon
from labseq_slm.outputs import Display, PngFile
from labseq_slm.settings import SlmSettings

import labseq.testing
from labseq import messages
from labseq.builtin.patterns import read_drawing
from labseq.campaigns.certificates import make_certificates
from labseq.cluster import connect
from labseq.data.export import check_export
from labseq.errors import LabseqError
from labseq.model import ScanSpace
from labseq.pictures.figures import check_place
from labseq.recording.read_hdf5 import load_filter
from labseq.web.serve import check_packages
from labseq.wire import require_packages

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


def compressed() -> h5py.Dataset:
    file = h5py.File("a.h5", "w", driver="core", backing_store=False)
    return file.create_dataset("frames", data=[0], chunks=True, compression="gzip")


NEEDS: dict[tuple[str, str, str], Callable[[], object]] = {
    # extra, distribution, module that is not there -> what needs it
    ("analysis", "pandas", "pandas"): lambda: check_export("parquet", Path("a.parquet")),
    ("analysis", "pyarrow", "pyarrow"): lambda: check_export("parquet", Path("a.parquet")),
    ("analysis", "xarray", "xarray"): lambda: check_export("netcdf", Path("a.nc")),
    ("analysis", "h5netcdf", "h5netcdf"): lambda: check_export("netcdf", Path("a.nc")),
    ("campaign", "distributed", "distributed"): lambda: connect("tcp://127.0.0.1:9", None),
    ("campaign", "cryptography", "cryptography"): lambda: make_certificates(Path("keys")),
    ("compress", "hdf5plugin", "hdf5plugin"): lambda: load_filter(Path("shot.h5"), compressed()),
    ("frames", "tifffile", "tifffile"): lambda: load("tifffile", "tifffile", Path("a.tif")),
    ("frames", "pillow", "PIL.Image"): lambda: load("PIL.Image", "Pillow", Path("a.png")),
    ("nidaqmx", "nidaqmx", "nidaqmx"): lambda: import_package("lines"),
    ("optuna", "optuna", "optuna"): lambda: OptunaScanner(OptunaSettings(), ScanSpace((), 1)),
    ("plot", "matplotlib", "matplotlib"): lambda: check_place(Path("a.png")),
    ("plot", "pillow", "PIL"): lambda: read_drawing(ROOT / "docs" / "_static" / "plan_kagome.png", "#"),
    ("pylablib", "pylablib", "pylablib"): lambda: load_pylablib("camera", DCAM, ""),
    ("pylon", "pypylon", "pypylon.pylon"): lambda: load_pypylon("camera"),
    ("remote", "pyzmq", "zmq"): require_packages,
    ("remote", "msgpack", "msgpack"): require_packages,
    ("slm", "slmsuite", "slmsuite"): lambda: Display("static_tweezers", SlmSettings()).open(),
    ("slm", "pyglet", "pyglet"): lambda: Display("static_tweezers", SlmSettings()).open(),
    ("slm", "pillow", "PIL.Image"): lambda: PngFile("static_tweezers", Path("a.png")).open(),
    ("testing", "hypothesis", "hypothesis"): lambda: labseq.testing.CameraContract,
    ("testing", "pytest", "pytest"): lambda: labseq.testing.CameraContract,
    ("web", "starlette", "starlette"): check_packages,
    ("web", "uvicorn", "uvicorn"): check_packages,
    ("web", "httptools", "httptools"): check_packages,
    ("web", "uvloop", "uvloop"): check_packages,
    ("web", "pillow", "PIL"): check_packages,
}


def print_errors() -> None:
    """The error of each case, as JSON, in a process of its own: threads of other tests use these packages."""
    errors = dict[str, str]()
    for (extra, distribution, module), need in NEEDS.items():
        kept = sys.modules.get(module)
        sys.modules[module] = cast("Any", None)
        try:
            need()
        except (LabseqError, BadFramesError, ModuleNotFoundError) as error:
            errors[f"{extra}-{distribution}"] = str(error)
        del sys.modules[module]
        if kept is not None:
            sys.modules[module] = kept
    print(json.dumps(errors))


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    code = "from tests.test_extras import print_errors; print_errors()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, cwd=tmp_path_factory.mktemp("extras")
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", NEEDS, ids=lambda case: "-".join(case[:2]))
def test_what_to_install(case: tuple[str, str, str], errors: dict[str, str]) -> None:
    extra, distribution, _ = case
    reported = errors[f"{extra}-{distribution}"]
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


def distribution_name(requirement: str) -> str:
    return re.sub("[-_.]+", "-", re.split(r"[\[;>=<!~ (]", requirement)[0]).lower()


def base_modules() -> set[str]:
    """Import names of what every installation has: labseq's dependencies and theirs."""
    waiting, base = [*map(distribution_name, PROJECT["dependencies"])], set[str]()
    while waiting:
        distribution = waiting.pop()
        if distribution not in base:
            base.add(distribution)
            with contextlib.suppress(PackageNotFoundError):  # one for another system or Python
                waiting += [
                    distribution_name(one) for one in requires(distribution) or () if "extra ==" not in one
                ]
    return {
        module
        for module, distributions in packages_distributions().items()
        if base & {distribution_name(name) for name in distributions}
    }


OF_EXTRAS = {("labseq", "web"), ("labseq", "testing"), ("plugins", "labseq_bridges")}


def test_a_module_imports_what_only_an_extra_has_when_it_needs_it() -> None:
    """The pages, the support for tests and the bridges are nothing without theirs, and are imported late."""
    plugins = {path.stem for path in (ROOT / "plugins").iterdir()}
    allowed = base_modules() | plugins | {*sys.stdlib_module_names, "labseq"}
    wrong = list[str]()
    for path in (*(ROOT / "labseq").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")):
        if path.relative_to(ROOT).parts[:2] in OF_EXTRAS:
            continue
        for node in ast.parse(path.read_text("utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            wrong += [f"{path}:{node.lineno}: {name}" for name in names if name.split(".")[0] not in allowed]
    assert not wrong


WITHOUT_EXTRAS = '''
import sys

class Without:
    """Finds what another finder finds, except what is refused."""
    def __init__(self, finder):
        self._finder = finder
    def __getattr__(self, name):
        return getattr(self._finder, name)
    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in refused else self._finder.find_spec(name, path, target)

refused = set(sys.argv[1].split())
sys.meta_path[:] = map(Without, sys.meta_path)
from labseq.cli import main
for line in sys.stdin.read().splitlines():
    try:
        main(line.split())
    except SystemExit as leaving:
        print(f"exit {leaving.code or 0}: {line}", file=sys.stderr)
'''
# `plan` comes after `waveform`: it chooses plain Python for all kernels that follow
WORKS = """\
check compact_225
run compact_225 --shots 2 --seed 1
run lifetime --seed 1
runs
show 1
show 1 --shots --timing
show 2 --scan survival:before,after --fit exponential
export 1 --output shots.csv
replay 1
doctor
waveform random:20x20@0.75 --target compact_225
plan random:20x20@0.75 --target compact_225
bench planners --loadings 2
devices virtual
safe virtual
plugins
explain psca
schema sequence --output schema.json
new sequence mine
"""
NEEDS_AN_EXTRA = """\
plot 1
export 1 --to parquet
web
"""


def test_without_extras_every_command_works_that_can(tmp_path: Path) -> None:
    """In a process in which nothing can be imported but what every installation has."""
    refused = {*packages_distributions()} - base_modules() - {*sys.stdlib_module_names, "labseq"}
    refused -= {path.name for path in (ROOT / "plugins").iterdir()}
    assert {"matplotlib", "pandas", "pytest", "starlette"} <= refused
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS, " ".join(refused)],
        input=WORKS + NEEDS_AN_EXTRA, capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    codes = [line for line in done.stderr.splitlines() if line.startswith("exit ")]
    expected = [f"exit 0: {line}" for line in WORKS.splitlines()]
    expected += [f"exit 2: {line}" for line in NEEDS_AN_EXTRA.splitlines()]
    assert codes == expected, done.stdout + done.stderr
    for extra in ("plot", "analysis", "web"):
        assert f"labseq[{extra}]" in done.stderr
