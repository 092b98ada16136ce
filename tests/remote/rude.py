"""What a client with a key that sends garbage costs another one: ``python -m tests.remote.rude [SECONDS]``.

Calls of a client are timed while another one sends garbage as fast as it is answered, and while it does not,
in turns of two seconds, because the load of the computer changes. Both use the same device.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from labseq_remote.drivers import RemoteDevice
from labseq_remote.settings import RemoteSettings

from labseq import wire
from labseq.guard import StopFlag
from labseq.plugin import Context
from labseq.sequencer.clock import RealClock
from tests.remote.conftest import PROFILE, free_port

TURN_S = 2.0
GARBAGE = """
import itertools, os, sys, msgpack, zmq
from pathlib import Path
from labseq import wire
keys, port, n_waiting = wire.find_keys(wire.keys_root()), int(sys.argv[1]), int(sys.argv[2])
server = wire.read_public(wire.keys_root() / "known" / "keys.key")
sockets = []
for place in (port, port + 5):
    sockets += [wire.client_socket(keys, server, 0.05) for _ in range(4)]
    for socket in sockets[-4:]:
        socket.connect(wire.endpoint("127.0.0.1", place))
large = msgpack.packb([[] for _ in range(1 << 19)])
garbage = [[b"\\xc1"], [os.urandom(200)], [large], [msgpack.packb(7)], [b"\\x80"] * 200]
for socket in sockets:
    for _ in range(n_waiting):
        socket.send_multipart(garbage[0])
print("ready", flush=True)
for number in itertools.count():
    for socket in sockets:
        try:
            socket.recv_multipart()
            socket.send_multipart(garbage[number % len(garbage)])
        except zmq.Again:  # it is not read at present
            pass
"""


def started(command: list[str], **variables: str) -> subprocess.Popen[str]:
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **variables})


def timed(device: RemoteDevice, rude: subprocess.Popen[str], seconds: float) -> dict[bool, list[float]]:
    """Times of calls, in ms, while the other client is stopped, and while it sends."""
    times: dict[bool, list[float]] = {False: [], True: []}
    end_s, is_rude = time.monotonic() + seconds, True
    while time.monotonic() < end_s:
        is_rude = not is_rude
        rude.send_signal(signal.SIGCONT if is_rude else signal.SIGSTOP)
        time.sleep(0.1)
        turn_s = time.monotonic() + TURN_S
        while time.monotonic() < turn_s:
            start_s = time.perf_counter()
            device.read("power")
            times[is_rude].append(1e3 * (time.perf_counter() - start_s))
    assert rude.poll() is None, "the rude client has ended"
    return times


def main(seconds: float) -> None:
    folder = Path(tempfile.mkdtemp())
    os.environ["LABSEQ_KEYS"] = str(folder / "keys")
    publics = {name: wire.new_keys(name, folder / name)[1].read_bytes() for name in ("keys", "rude")}
    for name, known in itertools.product(publics, publics):
        (folder / name / "known" / f"{known}.key").write_bytes(publics[known])
    (folder / "served.yaml").write_text(PROFILE, encoding="utf-8")
    port = free_port(8)
    address = f"tcp://127.0.0.1:{port}"
    command = [
        sys.executable,
        "-m",
        "labseq",
        "serve-devices",
        str(folder / "served.yaml"),
        "--bind",
        address,
    ]
    server = started(command)
    assert server.stdout is not None
    assert any("control at" in line for line in server.stdout)
    settings = RemoteSettings(device="instrument", address=address, server_key="keys")
    device = RemoteDevice(settings, Context("laser", clock=RealClock(StopFlag())))
    device.open()
    rude = started([sys.executable, "-c", GARBAGE, str(port), "2"], LABSEQ_KEYS=str(folder / "rude"))
    try:
        assert rude.stdout is not None
        rude.stdout.readline()
        times = timed(device, rude, seconds)
        device.close()
    finally:
        rude.kill()
        server.terminate()
    for is_rude, one in times.items():
        p50, p99 = np.quantile(one, (0.5, 0.99))
        how = "with" if is_rude else "without"
        print(f"{how} garbage: {p50:.2f} ms (p50), {p99:.2f} ms (p99) of {len(one)} calls")
    ratio = np.quantile(times[True], 0.99) / np.quantile(times[False], 0.99)
    print(f"p99 ratio {ratio:.2f}, load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
