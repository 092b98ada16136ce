"""Each device of a profile served by a process of its own, and a run in another one.

``python -m tests.remote.apart`` runs `compact_225` on `bench` so, and compares the data with those of plain
`bench`; then it kills (SIGKILL) or stops (SIGSTOP) each server and the run in the middle of a shot. It prints
the exit code and the message of the run, and when each device was safe: by the run's event log and by the
reports of the servers.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import yaml

import labseq
from labseq.plain import now
from tests.remote.conftest import free_port
from tests.session.small_runs import table

BENCH: Final = Path(__file__).parents[2] / "hardware_profiles" / "bench.yaml"
SERVED: Final = {
    "simulation": ("simulation",),
    "camera": ("camera", "trap_camera"),
    "static": ("static_tweezers",),
    "mobile": ("mobile_tweezers",),
    "lines": ("lines", "shutter"),
}
"""Server -> the devices that it serves."""
SHOT_S: Final = 4.0
"""How long after the begin of a shot a process is killed at most, in seconds."""
OF_THE_EXPERIMENT: Final = (
    *("role", "channels", "rf", "pick_up", "drop_off", "speed", "speed_profile", "overhead_per_cycle"),
    *("max_tweezers", "max_row_tones", "max_column_tones", "eject_slots"),
)
"""What the profile of the experiment says of a device; the rest belongs to its driver."""


@dataclass
class Server:
    """A process that serves devices of a profile.

    Attributes:
        devices: Their names.
        host: Where it listens.
        port: Its first port.
        key: Name of its key; "" without keys.
        prefix: A command to start it with.
        profile: The profile.
        process: The process.
        lines: When it printed what.
    """

    devices: Sequence[str]
    host: str
    port: int
    key: str = ""
    prefix: Sequence[str] = ()
    profile: Path = BENCH
    process: subprocess.Popen[str] | None = None
    lines: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])

    @property
    def remote(self) -> dict[str, str]:
        """How profiles name it."""
        key = {"server_key": self.key} if self.key else {}
        return {"use": "remote", "address": f"tcp://{self.host}:{self.port}", **key}

    def start(self, simulation: Server) -> None:
        """Start it; its devices act on the simulation of a server."""
        command = [*self.prefix, sys.executable, "-m", "labseq", "serve-devices", str(self.profile)]
        command += ["--bind", self.remote["address"], *([] if self.key else ["--plain"])]
        command += [f"--device={name}" for name in self.devices]
        if simulation is not self:
            command += ["--set", f"profile.simulation={json.dumps(simulation.remote)}"]
        self.lines.clear()
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, args=[self.process], daemon=True).start()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.lines.append((time.monotonic(), line.strip()))

    def await_line(self, text: str, limit_s: float = 300.0) -> None:
        """Wait until it has printed something."""
        until_s = time.monotonic() + limit_s
        while not any(text in line for _, line in self.lines):
            assert self.process is not None
            assert self.process.poll() is None, f"the server of {self.devices} has ended"
            assert time.monotonic() < until_s, f"the server of {self.devices} has not printed '{text}'"
            time.sleep(0.01)

    def end(self) -> None:
        """End it."""
        if self.process is not None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            self.process.wait()


def client_profile(servers: Collection[Server]) -> str:
    """The profile of the experiment: that of the servers, with all devices elsewhere."""
    text = next(iter(servers)).profile.read_text(encoding="utf-8")
    profile = yaml.safe_load(text.replace(" on: [", " 'on': ["))  # which is `true` in YAML 1.1
    at = {name: server.remote for server in servers for name in server.devices}

    def remote(name: str, settings: dict[str, Any]) -> dict[str, Any]:
        kept = {key: value for key, value in settings.items() if key in OF_THE_EXPERIMENT}
        return {**at[name], "device": name, "simulated": True, **kept}

    roles = {"camera", "static_tweezers", "mobile_tweezers", "lines", "simulation"}
    for name in roles & profile.keys():
        profile[name] = remote(name, profile[name])
    profile["devices"] = {name: remote(name, one) for name, one in profile["devices"].items()}
    return yaml.safe_dump(profile, sort_keys=False)


@contextmanager
def serving_apart(folder: Path, servers: Mapping[str, Server]) -> Generator[None]:
    """Start servers, that of the simulation first, and write ``client.yaml`` for a run with them."""
    (folder / "client.yaml").write_text(client_profile(servers.values()), encoding="utf-8")
    simulation = next(iter(servers.values()))
    try:
        for server in servers.values():
            server.start(simulation)
            server.await_line("serves ")
        yield
    finally:
        for server in servers.values():
            server.end()


def events(run: Path) -> list[dict[str, Any]]:
    """The events of a run so far."""
    try:
        lines = (run / "events.jsonl").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines if line.endswith("}")]
    except FileNotFoundError:
        return []


class Client:
    """A run in a process of its own."""

    def __init__(self, folder: Path, n_shots: int, prefix: Sequence[str] = ()) -> None:
        self._root = Path(tempfile.mkdtemp(dir=folder))
        command = [*prefix, sys.executable, "-m", "labseq", "run", "compact_225", "--seed", "1"]
        command += ["--profile", str(folder / "client.yaml"), "--shots", str(n_shots)]
        command += ["--output", str(self._root)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=pipe, text=True)

    @property
    def run(self) -> Path:
        """The folder of its run."""
        return next(self._root.glob("*/*"), self._root)

    def events(self) -> list[dict[str, Any]]:
        """What it has reported so far."""
        return events(self.run)

    def await_shot(self) -> None:
        """Wait until it has begun a shot."""
        while "shot_started" not in [one["event"] for one in self.events()]:
            assert self.process.poll() is None, self.process.communicate()[1]
            time.sleep(0.01)

    def end(self) -> tuple[int, str]:
        """Wait for its end: its exit code, and what it printed on stderr."""
        _, errors = self.process.communicate(timeout=120.0)
        return self.process.returncode, " ".join(errors.split())


def identical(folder: Path, n_shots: int, prefix: Sequence[str] = ()) -> bool:
    """Whether the same seed gives the same data as plain `bench`."""
    client = Client(folder, n_shots, prefix)
    ended = client.end()
    assert ended[0] == 0, ended
    options: dict[str, Any] = {"seed": 1, "shots": n_shots, "output": folder / "plain"}
    with labseq.Session.open("compact_225", profile=str(BENCH), **options) as session:
        plain = session.run()
    without_profile = [
        [one[:2] + one[3:] for one in table(run)] for run in (plain, labseq.open_run(client.run))
    ]
    return without_profile[0] == without_profile[1]


def act(servers: dict[str, Server], folder: Path, victim: str, number: signal.Signals) -> None:
    """Kill or stop a server or the run, and print what follows."""
    client = Client(folder, 50)
    client.await_shot()
    time.sleep(random.uniform(0.0, SHOT_S))
    hit = client.process if victim == "client" else servers[victim].process
    assert hit is not None
    begun_s, begun_utc = time.monotonic(), now()
    hit.send_signal(number)
    if victim == "client" and number == signal.SIGSTOP:
        time.sleep(2.0)
        hit.send_signal(signal.SIGCONT)
    code, message = client.end()
    print(
        f"\n{number.name} to {victim}: exit code {code} after {time.monotonic() - begun_s:.2f} s: {message}"
    )
    print_safe_states(client, begun_utc)
    if victim != "client" and number == signal.SIGSTOP:
        hit.send_signal(signal.SIGCONT)
        print(f"  {time.monotonic() - begun_s:6.2f} s the server goes on")
    time.sleep(2.0)
    print_reports(servers, begun_s)
    if victim != "client" and hit.poll() is not None:  # a watchdog ends a server that stands still
        servers[victim].start(servers["simulation"])
        servers[victim].await_line("serves ")


def print_safe_states(client: Client, begun_utc: datetime) -> None:
    """Print when the devices were safe, by the run's event log."""
    safe = [one for one in client.events() if one["event"] == "safe_state"]
    if not safe:
        return
    latest_s = max(one["values"].get("after_s", 0.0) for one in safe)  # then they are reported
    noticed_s = (datetime.fromisoformat(safe[0]["t_utc"]) - begun_utc).total_seconds() - latest_s
    print(f"  {noticed_s:6.2f} s run: begins to make the devices safe")
    for values in [one["values"] for one in safe]:
        at_s = noticed_s + values.get("after_s", math.nan)
        print(f"  {at_s:6.2f} s run: {values['device']}: {'safe' if values['ok'] else values['error']}")


def print_reports(servers: Mapping[str, Server], begun_s: float) -> None:
    """Print what the servers have reported since then."""
    for name, server in servers.items():
        for at_s, line in server.lines:
            if at_s > begun_s:
                print(f"  {at_s - begun_s:6.2f} s server of {name}: {line}", flush=True)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=int, default=2, help="of the runs that are compared; 0: none")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--victims", nargs="*", default=[*SERVED, "client"])
    parser.add_argument("--signals", nargs="*", default=["SIGKILL", "SIGSTOP"])
    options = parser.parse_args()
    first = free_port(40)
    at = {name: first + 8 * n for n, name in enumerate(SERVED)}
    servers = {name: Server(devices, "127.0.0.1", at[name]) for name, devices in SERVED.items()}
    with tempfile.TemporaryDirectory() as name, serving_apart(Path(name), servers):
        if options.shots:
            same = identical(Path(name), options.shots)
            print(f"{options.shots} shots: {'identical' if same else 'DIFFERENT'}", flush=True)
        for number in options.signals:
            for victim in options.victims * options.repeats:
                act(servers, Path(name), victim, signal.Signals[number])


if __name__ == "__main__":
    main()
