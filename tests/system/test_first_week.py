"""A first week with labseq as users spend it: a physicist, a developer, an analyst with plain h5py."""

import json
import re
import socketserver
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.cli import main

ROOT = Path(__file__).parents[2]

LIFETIME = """
labseq: 1
name: lifetime
profile: virtual
scan:
  shot.hold.duration: [100 ms, 10 s, 20 s, 40 s, 70 s]
repeats: 2
record_frames: none
shot:
  - load: {duration: 500 ms}
  - name: before
    image: {exposure: 45 ms}
  - name: hold
    wait: {duration: 1 s}
  - name: after
    image: {exposure: 45 ms}
"""

TWO_PARAMETERS = """
labseq: 1
name: two_parameters
profile: virtual
target: {pattern: compact, rows: 10, cols: 10}
planner: {use: psca}
scan:
  planner.degree_of_parallelism: [3, 7]
  shot.sort.window: [15 ms, 60 ms]
record_frames: none
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - name: sort
    rearrange: {cycles: 1}
  - image: {exposure: 45 ms}
"""

TCP_CAMERA = '''
"""A camera behind a TCP port."""

import socket

import numpy as np

from labseq.plugin import CameraDriver, CameraFacts, DeviceError, ExposureResult, Settings, hookimpl, wait_for

LABSEQ_API = 1


class Address(Settings):
    host: str = "127.0.0.1"
    port: int


class TcpCamera(CameraDriver):
    def __init__(self, settings, context):
        super().__init__(context)
        self._settings, self._link = settings, None

    @property
    def facts(self):
        return CameraFacts(1e-3, max_exposure_s=10.0, frame_shape=(512, 512), triggers=("software",))

    def describe(self):
        return {"address": f"{self._settings.host}:{self._settings.port}"}

    def _connect(self):
        try:
            self._link = socket.create_connection((self._settings.host, self._settings.port), timeout=2.0)
        except OSError as error:
            raise DeviceError(self._name, f"{error}; check `host` and `port`") from error
        self._lines = self._link.makefile("rb")

    def _disconnect(self):
        if self._link is not None:
            self._lines.close()
            self._link.close()
            self._link = None

    def _ask(self, request):
        self._link.sendall(request.encode() + b"\\n")
        return self._lines.readline().split()

    def _start(self, series):
        self._ask(f"arm {series.n_frames} {series.exposure_s:g}")

    def _fire(self):
        self._ask("fire")

    def _take(self, timeout_s):
        answer = wait_for(lambda max_s: self._ask(f"read {max_s:g}") or None, timeout_s, self._clock)
        if answer is None:
            return None
        number, height, width = map(int, answer)
        pixels = np.frombuffer(self._lines.read(2 * height * width), "<u2").reshape(height, width)
        return ExposureResult(number, pixels.astype(np.uint16))

    def _stop(self):
        if self._link is not None:
            self._ask("stop")


@hookimpl
def labseq_register(registry):
    registry.camera("tcp", TcpCamera, Address)
'''


class CameraServer(socketserver.StreamRequestHandler):
    """The camera: counts its frames from the arming on, and answers one line at a time."""

    def handle(self) -> None:
        armed, fired, read = 0, 0, 0
        rng = np.random.default_rng(5)
        for line in self.rfile:
            match line.decode().split():
                case ["arm", n, _]:
                    armed, fired, read = int(n), 0, 0
                    answer = "ok"
                case ["fire"]:
                    fired += fired < armed
                    answer = "ok"
                case ["read", _] if read < fired:
                    pixels = rng.poisson(100.0, (512, 512)).astype("<u2")
                    self.wfile.write(f"{read} 512 512\n".encode() + pixels.tobytes())
                    read += 1
                    continue
                case ["read", _]:
                    answer = ""
                case _:
                    answer = "ok"
            self.wfile.write(answer.encode() + b"\n")


@pytest.fixture
def camera_port() -> Iterator[int]:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), CameraServer) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        yield server.server_address[1]
        server.shutdown()


class Desk:
    """A folder to work in, and the command line."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def labseq(self, *words: str) -> str:
        """What a command prints on stdout; it must succeed."""
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as leaving:
            main(list(words))
        out, err = self._capsys.readouterr()
        assert leaving.value.code in (0, None), (words, err)
        return out

    def summary(self, *words: str) -> dict[str, Any]:
        summary = json.loads(self.labseq(*words, "--json"))
        assert isinstance(summary, dict)
        return summary


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Desk:
    monkeypatch.chdir(tmp_path)
    return Desk(capsys)


def python_of(tutorial: str) -> str:
    """The first Python block of a tutorial."""
    text = (ROOT / "docs" / "tutorials" / f"{tutorial}.md").read_text(encoding="utf-8")
    found = re.search(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert found is not None
    return found[1]


def shot_files(run: Path) -> list[Path]:
    return sorted(run.glob("shots/*.h5"))


def newest_run() -> Path:
    return max(Path("data").glob("*/*"))


def test_a_physicist(desk: Desk) -> None:
    """A first run, a scan of two parameters, a lifetime."""
    desk.labseq("check", str(ROOT / "sequences" / "compact_225.yaml"))
    desk.labseq("run", str(ROOT / "sequences" / "compact_225.yaml"), "--shots", "2", "--seed", "1")
    assert "100.0 %" in desk.labseq("show", "--shots")

    Path("two.yaml").write_text(TWO_PARAMETERS)
    desk.labseq("run", "two.yaml", "--seed", "1")
    rows = desk.labseq("show", "--scan", "filling").splitlines()
    assert all(any(window in row for row in rows) for window in ("15 ms", "60 ms"))
    desk.labseq("plot", "--scan", "filling", "-o", "map.png")
    assert Path("map.png").read_bytes().startswith(b"\x89PNG")

    Path("lifetime.yaml").write_text(LIFETIME)
    desk.labseq("run", "lifetime.yaml", "--seed", "4")
    printed = desk.labseq("show", "--scan", "survival:before,after", "--fit", "exponential")
    (found,) = re.findall(r"decay +(\d+\.?\d*)\((\d+)\) s", printed)
    assert float(found[0]) == pytest.approx(33.0, abs=3.0)
    listed = desk.labseq("runs")
    assert re.findall(r"/000\d_(\w[\w-]*)", listed) == ["compact-225", "two_parameters", "lifetime"]


def test_a_developer(desk: Desk, camera_port: int, pretend_installed: Callable[[Path], None]) -> None:
    """A planner, a step and a TCP camera, each one file; then a package."""
    desk.labseq("new", "sequence", "first")
    for name, plugin in (("mine", python_of("planner")), ("dark", python_of("step")), ("tcp", TCP_CAMERA)):
        Path("plugins", f"{name}.py").write_text(plugin)
    sequence = Path("first.yaml").read_text().replace("500 ms", "1 ms")
    Path("first.yaml").write_text(sequence + "  - dark: {duration: 1 ms}\n")
    camera = f"profile.camera={{use: tcp, port: {camera_port}}}"
    settings = ["--set", "planner={use: mine}", "--set", camera, "--set", "shots=1"]
    desk.labseq("check", "first.yaml", *settings)
    desk.labseq("run", "first.yaml", *settings)
    (path,) = shot_files(newest_run())
    with h5py.File(path) as file:
        frames: Any = file["entry/camera/camera/frames"]
        mean = frames[()].mean()
    assert mean == pytest.approx(100.0, rel=0.01)

    desk.labseq("new", "camera", "yourcam", "--package")
    pretend_installed(Path("labseq-yourcam"))
    assert "yourcam" in desk.labseq("plugins")
    desk.labseq("new", "step", "shade", "--package")
    pretend_installed(Path("labseq-shade"))
    elsewhere = Path("elsewhere/second.yaml")
    elsewhere.parent.mkdir()
    text = sequence.replace("plugin_folders: [plugins]", "")
    elsewhere.write_text(text + "  - shade: {duration: 1 ms}\n")
    desk.labseq("check", str(elsewhere))


def test_an_analyst(desk: Desk) -> None:
    """Filling after each cycle and survival between two images, each in six lines of plain h5py."""
    desk.labseq("run", str(ROOT / "sequences" / "compact_225.yaml"), "--shots", "1", "--seed", "1")
    (path,) = shot_files(newest_run())
    with h5py.File(path) as file:
        entry: Any = file["entry"]
        names, occupancy = entry["detection/images"]["name"], entry["detection/occupancy"][()]
        target = entry["target/fill"][()] == 1
        filling = {name.decode(): sites[target].mean() for name, sites in zip(names, occupancy, strict=True)}
    assert filling["rearrange_cycle_0"] > 0.95 > filling["step_1_image"]

    Path("lifetime.yaml").write_text(LIFETIME)
    desk.labseq("run", "lifetime.yaml", "--seed", "4", "--set", "shot.hold.duration=33 s")
    survivals: list[float] = []
    for path in shot_files(newest_run()):
        with h5py.File(path) as file:
            entry = file["entry"]
            names = list(entry["detection/images"]["name"])
            occupancy = entry["detection/occupancy"][()] == 1
            before, after = (occupancy[names.index(name)] for name in (b"before", b"after"))
            survivals.append((before & after).sum() / before.sum())
    assert np.mean(survivals) == pytest.approx(np.exp(-1), abs=0.04)
