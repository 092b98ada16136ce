"""Times from the death of a server of devices, or of its client, to the devices' outputs being off.

``python -m tests.remote.kills --repeats 10``. A shutter on a serial line, a card and a radio,
simulated in processes of their own, as in ``tests.benchmarks.time_to_off``; one process serves them, another
one has opened them and turned them on.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from tests.plugins.card_process import PLUGIN
from tests.plugins.outputs_rig import Outputs, outputs
from tests.remote.conftest import free_port

NAMES = ("shutter", "fifo", "radio")
TONES = "{centre: 15 MHz, step: 1.5 MHz}"
PROFILE = """\
labseq: 1
name: outputs
grid: {{rows: 3, cols: 4, spacing: 4.49 um, row_frequency: {tones}, column_frequency: {tones}}}
camera: {{use: virtual}}
static_tweezers:
  use: soapy
  device: simulated,speed=1,buffer=0.02,patience=0,record=1000000,folder={folder}/radio0
  sample_rate: 1.2 MHz
  row_frequency: {{centre: 100 MHz, step: 60 kHz}}
  column_frequency: {{centre: 100 MHz, step: 60 kHz}}
mobile_tweezers:
  use: spcm_process
  card: simulated@{folder}/fifo0
  mode: fifo
  sample_rate: 50 MHz
  fill: 0.1 s
  trigger: software
  speed: 0.015 um/ms
  rf: {{row_band: [10 MHz, 20 MHz], column_band: [10 MHz, 20 MHz]}}
devices:
  shutter:
    use: serial
    port: {folder}/port
    write_ends_with: "\\n"
    read_ends_with: "\\n"
    commands:
      open: {{send: OPEN, reply: OK}}
      close: {{send: CLOSE, reply: OK, repeatable: true}}
    safe_state: [close]
detector: {{use: threshold}}
plugin_folders: [plugins]
"""
CLIENT = """
import sys
from labseq.kernels.kernel import load_kernels
from labseq.model import Plan
from labseq.motion import tone_program
from labseq.assembly.lab import construct
from labseq.assembly.profile import resolve_profile
from labseq.guard import StopFlag
from labseq.sequencer.clock import RealClock

hardware = resolve_profile(sys.argv[1])
kinds = {"mobile_tweezers", "static_tweezers", "device"}
chosen = {name: one for name, one in hardware.chosen.items() if one.entry.kind in kinds}
made, _ = construct(chosen, hardware.context(RealClock(StopFlag())), 1)
for device in made.values():
    device.open()
mobile = made["mobile_tweezers"]
plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, 1), (0, 3)])] * 50)
mobile.warm()
mobile.prepare(tone_program(plan, hardware.grid, hardware.motion, 50))
made["static_tweezers"].start()
made["shutter"].command("open")
mobile.play()
print("on", flush=True)
sys.stdin.read()
"""


@contextmanager
def _process(*command: str, until: str) -> Generator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(
        [sys.executable, *command], stdin=pipe, stdout=pipe, text=True, env=environment
    )
    try:
        assert process.stdout is not None
        assert any(until in line for line in process.stdout), f"it ended before it printed '{until}'"
        yield process
    finally:
        process.kill()
        process.communicate()


def _profiles(folder: Path, port: int) -> None:
    (folder / "plugins").mkdir()
    (folder / "plugins" / "card.py").write_text(PLUGIN, encoding="utf-8")
    served = PROFILE.format(folder=folder, tones=TONES)
    (folder / "served.yaml").write_text(served, encoding="utf-8")
    at = f"use: remote, address: 'tcp://127.0.0.1:{port}', device: "
    remote = f"""\
labseq: 1
name: client
grid: {{rows: 3, cols: 4, spacing: 4.49 um, row_frequency: {TONES}, column_frequency: {TONES}}}
camera: {{use: virtual}}
static_tweezers: {{{at} static_tweezers}}
mobile_tweezers: {{{at} mobile_tweezers, speed: 0.015 um/ms, \
rf: {{row_band: [10 MHz, 20 MHz], column_band: [10 MHz, 20 MHz]}}}}
devices: {{shutter: {{{at} shutter}}}}
detector: {{use: threshold}}
"""
    (folder / "client.yaml").write_text(remote, encoding="utf-8")


def _times(victim: str) -> dict[str, float]:
    """Kill the server or the client; how long each device stays on, in seconds."""
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port(12)
        _profiles(folder, port)
        (folder / "radio0").mkdir()
        with outputs(folder, NAMES, driven=False) as devices:
            devices._repeat = 0
            serve = ("-m", "labseq", "serve-devices", str(folder / "served.yaml"), "--plain")
            with (
                _process(*serve, "--bind", f"tcp://127.0.0.1:{port}", until="serves") as server,
                _process("-c", CLIENT, str(folder / "client.yaml"), until="on") as client,
            ):
                states = devices.off_since()
                assert set(states.values()) == {None}, states
                begun_s = time.monotonic()
                (server if victim == "server" else client).kill()
                return _until_off(devices, begun_s)


def _until_off(devices: Outputs, begun_s: float) -> dict[str, float]:
    off_s = devices.off_since()
    while None in off_s.values() and time.monotonic() < begun_s + 20.0:
        time.sleep(0.05)
        off_s = devices.off_since()
    return {name: since_s - begun_s for name, since_s in off_s.items() if since_s is not None}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    for victim in ("server", "client"):
        found = [_times(victim) for _ in range(options.repeats)]
        for name in NAMES:
            times = sorted(1e3 * one[name] for one in found if name in one)
            worst = f"{times[len(times) // 2]:7.0f} {times[-1]:7.0f} ms" if times else ""
            print(
                f"kill -9 of the {victim}: {name:8} off after {worst} (median, worst); "
                f"not off: {options.repeats - len(times)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
