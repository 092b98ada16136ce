"""Servers of virtual devices, in this process, on loopback."""

from __future__ import annotations

import socket
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from labseq_remote.settings import RemoteSettings

import labseq.remote.control
import labseq.remote.gate
from labseq.remote.server import Server, Serving, serving

PROFILE = """\
labseq: 1
name: served
grid: {rows: 6, cols: 7, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
lines: {use: virtual, channels: {cooling: {channel: 2, on: [load]}}}
devices:
  instrument: {use: virtual, commands: [open, set], values: {power: 1.0}}
detector:
  {use: threshold, frame: [80, 96], centre_px: [39.5, 47.5], pixel_size: 0.35 um, region: 5, threshold: 1630}
simulation: {use: virtual, image: {frame: [80, 96], centre_px: [39.5, 47.5]}}
"""


def free_port(n: int = 1) -> int:
    """The first of some ports that are free, one after the other."""
    for _ in range(100):
        with socket.socket() as first:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
        if port + n < 65_536 and all(_is_free(port + i) for i in range(n)):
            return port
    raise AssertionError("there are no free ports")


def _is_free(port: int) -> bool:
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class Served:
    """A server, what it has told, and the settings of clients."""

    def __init__(self, server: Server, port: int, told: list[str]) -> None:
        self.server = server
        self.port = port
        self.told = told

    def settings(self, device: str, *, port: int = 0, **others: Any) -> RemoteSettings:
        """For a client."""
        about = {"address": f"tcp://127.0.0.1:{port or self.port}", "device": device}
        return RemoteSettings.model_validate({**about, **others})


@contextmanager
def served(
    folder: Path, profile: str = PROFILE, *, plain: bool = True, devices: tuple[str, ...] = ()
) -> Generator[Served]:
    """A server of a profile."""
    path = folder / "served.yaml"
    path.write_text(profile, encoding="utf-8")
    told: list[str] = []
    for _ in range(5):
        port = free_port(12)
        try:
            how = Serving(f"tcp://127.0.0.1:{port}", devices, plain=plain)
            with serving(str(path), (), how, told.append) as server:
                yield Served(server, port, told)
            return
        except OSError:
            continue


@pytest.fixture(scope="session", autouse=True)
def _patient() -> Generator[None]:
    """Computers that run tests stand still for longer than those of a lab, and drivers that are dropped stay
    connected, because tests do not collect garbage.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("labseq.plugin.wire.LOST_S", 2.0)
        patch.setattr(labseq.remote.control, "LOST_S", 2.0)
        patch.setattr(labseq.remote.control, "MAX_SESSIONS", 10_000)
        patch.setattr(labseq.remote.gate, "_connection_limit", lambda: 300)
        yield


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Generator[Served]:
    """A server of virtual devices, without keys."""
    with served(tmp_path_factory.mktemp("served")) as one:
        yield one


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the key of this computer, which knows itself by the name 127.0.0.1."""
    from labseq.wire import new_keys

    folder = tmp_path / "keys"
    monkeypatch.setenv("LABSEQ_KEYS", str(folder))
    _, public = new_keys("here", folder)
    (folder / "known" / "here.key").write_bytes(public.read_bytes())
    return folder
