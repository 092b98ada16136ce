"""Benchmarks: a served device in a process of its own, over loopback, without and with keys.

The device does nothing, so that the times are those of the messages: what a call takes more than locally.
`pytest -s tests/benchmarks/test_remote.py --benchmark-enable --numprocesses=0` prints 99th percentiles, too.
The same through sockets of ZeroMQ alone is what labseq can come near to, but not below.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_remote.drivers import RemoteCamera, RemoteDevice, RemoteHardware, RemoteMobileTweezers

from labseq import wire
from labseq.model import MotionSpec, SiteGrid, TargetPattern
from labseq.motion import tone_program
from labseq.plugin import Context, ToneProgram
from tests.remote.conftest import free_port

PLUGIN = """
import numpy as np
from labseq.plugin import Camera, Frame, Device, MobileTweezers, hookimpl
LABSEQ_API = 1
PICTURE = np.random.default_rng(0).poisson(530, (512, 512)).astype(np.uint16)
PICTURE.flags.writeable = False

class Still:
    def __init__(self, settings, context): pass
    def open(self): pass
    def close(self): pass
    def safe_state(self): pass
    def describe(self): return {}

class StillCamera(Still, Camera):
    def arm(self, n_frames, exposure_s, trigger): pass
    def trigger(self): pass
    def read(self, timeout_s): return Frame(PICTURE, 1e-3, 0.0)

class StillTweezers(Still, MobileTweezers):
    def prepare(self, program): return program.total_duration_s
    def play(self): pass
    def wait(self, timeout_s): pass

class StillDevice(Still, Device):
    def command(self, name, **arguments): pass
    def read(self, name): return 1.0

@hookimpl
def labseq_register(registry):
    registry.camera("still", StillCamera)
    registry.mobile_tweezers("still", StillTweezers)
    registry.device("still", StillDevice)
"""
ALONE = """
import sys, zmq
socket = zmq.Context().socket(zmq.ROUTER)
if len(sys.argv) > 3:
    socket.curve_server, socket.curve_secretkey = True, sys.argv[3].encode()
socket.bind(sys.argv[1])
reply = [bytes(64), *([bytes(512 * 512 * 2)] if sys.argv[2] == "frame" else [])]
while True:
    socket.send_multipart([socket.recv_multipart()[0], *reply], copy=False)
"""
PROFILE = """\
labseq: 1
name: still
plugin_folders: [.]
grid: {rows: 20, cols: 20, spacing: 4.49 um}
camera: {use: still}
static_tweezers: {use: virtual}
mobile_tweezers: {use: still}
detector: {use: threshold}
devices: {instrument: {use: still}}
"""


@pytest.fixture(scope="module", params=["plain", "keys"])
def address(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Generator[dict[str, Any]]:
    folder: Path = tmp_path_factory.mktemp(request.param)
    (folder / "still.py").write_text(PLUGIN, encoding="utf-8")
    (folder / "still.yaml").write_text(PROFILE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LABSEQ_KEYS", str(folder / "keys"))
        patch.setenv("LABSEQ_LOCKS", str(folder / "locks"))
        _, public = wire.new_keys("here", folder / "keys")
        (folder / "keys" / "known" / "here.key").write_bytes(public.read_bytes())
        place = f"tcp://127.0.0.1:{free_port(8)}"
        plain = request.param == "plain"
        command = [
            sys.executable,
            "-m",
            "labseq",
            "serve-devices",
            str(folder / "still.yaml"),
            "--bind",
            place,
        ]
        command += ["--plain"] if plain else []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert any("serves" in line for line in process.stdout)
                yield {"address": place, **({} if plain else {"server_key": "here"})}
            finally:
                process.terminate()


def opened(address: dict[str, Any], role: type[Any], device: str) -> Any:
    from labseq_remote.settings import RemoteSettings

    made: RemoteHardware = role(RemoteSettings(device=device, **address), Context(device))
    made.open()
    return made


def measure(benchmark: Any, call: Callable[..., Any], *args: Any, rounds: int) -> None:
    benchmark.pedantic(call, args=args, rounds=rounds, warmup_rounds=rounds // 20)
    if benchmark.stats is not None:  # else it was only tried
        times = np.quantile(benchmark.stats.stats.data, (0.5, 0.99))
        print("\n{}: p50 {:.3f} ms, p99 {:.3f} ms".format(benchmark.name, *(1e3 * times)))


def test_small_call(address: dict[str, Any], benchmark: Any) -> None:
    device = opened(address, RemoteDevice, "instrument")
    measure(benchmark, device.read, "power", rounds=3000)
    device.close()


def test_frame(address: dict[str, Any], benchmark: Any) -> None:
    camera = opened(address, RemoteCamera, "camera")
    measure(benchmark, camera.read, 1.0, rounds=1000)
    camera.close()


def test_tone_program_of_30_batches(address: dict[str, Any], benchmark: Any) -> None:
    tweezers = opened(address, RemoteMobileTweezers, "mobile_tweezers")
    measure(benchmark, tweezers.prepare, program_of_30_batches(), rounds=1000)
    tweezers.close()


@pytest.mark.parametrize("what", ["small", "frame"])
@pytest.mark.parametrize("keys", [False, True], ids=["plain", "keys"])
def test_zeromq_alone(keys: bool, what: str, benchmark: Any) -> None:
    public, secret = zmq.curve_keypair()
    port = free_port()
    command = [sys.executable, "-c", ALONE, f"tcp://127.0.0.1:{port}", what]
    command += [secret.decode()] if keys else []
    with subprocess.Popen(command) as process, zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        if keys:
            socket.curve_publickey, socket.curve_secretkey = zmq.curve_keypair()
            socket.curve_serverkey = public
        socket.connect(f"tcp://127.0.0.1:{port}")

        def call() -> None:
            socket.send(bytes(64))
            socket.recv_multipart(copy=False)

        try:
            measure(benchmark, call, rounds=1000)
        finally:
            process.kill()


def program_of_30_batches() -> ToneProgram:
    grid = SiteGrid()
    fill = np.zeros(grid.shape, np.bool_)
    fill[2:17, 2:17] = True
    planner = PscaPlanner(PscaSettings(degree_of_parallelism=7), Context(grid=grid))
    occupancy = np.random.default_rng(1).random(grid.shape) < 0.75
    plan = planner.plan(occupancy, TargetPattern(fill, np.zeros_like(fill)))
    return tone_program(plan, grid, MotionSpec(), 30)
